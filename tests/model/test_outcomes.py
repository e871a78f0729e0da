"""The outcomes of a slot by scheme and strategy, against the table of docs/mathematics/."""

from __future__ import annotations

from typing import Any

import pytest

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.outcomes import eavesdropper_outcomes, legitimate_outcomes
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.theory.covariances import Outcomes
from tests.builders import UNSTABLE

MU, MU_D = 0.8, 0.25


def scheme(name: str) -> Scheme:
    """With its example parameters, but for μ_d."""
    parameters = {
        entry: MU_D if entry == "state_probability" else value for entry, value in SCHEMES[name].parameters.items()
    }
    return scheme_of(UNSTABLE, {"scheme": name, **parameters})


def parts(outcomes: Outcomes) -> dict[str, float]:
    """The outcomes of a slot that have a probability, rounded."""
    entries = {
        name: round(getattr(outcomes, name), 12) for name in ("predicted", "state", "misled", "decoded", "leaked")
    }
    return {name: value for name, value in entries.items() if value}


STATES = {"predicted": 0.2, "state": 0.8}
LEGITIMATE = {
    "plain": STATES,
    "innovation": {"predicted": 0.2, "state": 0.2, "decoded": 0.6},
    "cipher": STATES,
    "encrypted-schedule": STATES,
    "twin-track": STATES,
    "acknowledged": STATES,
    "open-loop": STATES,
    "quantised-schedule": None,
    "random-code": None,
    "scheduled": None,
    "threshold-code": None,
}


@pytest.mark.parametrize("name", LEGITIMATE)
def test_the_legitimate_estimator_has_a_closed_form_where_slots_are_alike(name: str) -> None:
    """At the quality of its link."""
    result = legitimate_outcomes(scheme(name))
    if result is None:
        assert LEGITIMATE[name] is None
    else:
        assert parts(result(MU)) == LEGITIMATE[name]
        assert parts(result(0.0)) == {"predicted": 1.0}
        # In slot 0 every packet is the state; the secret of twin tracks tells the state without any packet.
        assert result(MU).initial == pytest.approx(0.0 if name == "twin-track" else 0.2)


def test_withholding_is_a_worse_link() -> None:
    """With probability p a packet is sent: the outcomes of μp."""
    result = legitimate_outcomes(scheme_of(UNSTABLE, {"scheme": "withholding", "state_probability": 0.5}))
    assert result is not None
    assert parts(result(MU)) == {"predicted": 0.6, "state": 0.4}


MISLED = {"predicted": 0.2, "state": 0.2, "misled": 0.6}
SMART = {"predicted": 0.8, "state": 0.2}
EAVESDROPPERS: list[tuple[str, str, dict[str, Any], dict[str, float] | None]] = [
    ("innovation", "naive", {}, MISLED),
    ("innovation", "smart", {}, SMART),
    ("innovation", "genie", {}, {"predicted": 0.2, "state": 0.2, "leaked": 0.6}),
    ("innovation", "suspicious", {"use_state": 0.5, "use_innovation": 0.1}, {"predicted": 0.84, "state": 0.1, "misled": 0.06}),
    ("innovation", "colluding", {"reads_as": "smart"}, SMART),
    ("innovation", "replay-informed", {"learns_at": 4, "reads_as": "smart"}, None),
    ("innovation", "likelihood", dict(STRATEGIES["likelihood"].parameters), None),
    ("innovation", "bayesian", {}, None),
    ("plain", "naive", {}, STATES),
    ("plain", "colluding", {"reads_as": "naive"}, STATES),
    ("plain", "genie", {}, None),
    ("twin-track", "naive", {}, None),
    ("cipher", "smart", {}, None),
]  # fmt: skip


@pytest.mark.parametrize(("name", "strategy", "parameters", "expected"), EAVESDROPPERS)
def test_an_eavesdropper_has_a_closed_form_where_one_slot_decides(
    name: str, strategy: str, parameters: dict[str, Any], expected: dict[str, float] | None
) -> None:
    """By what it does with a state and with an innovation; None where no closed form is known."""
    result = eavesdropper_outcomes(scheme(name), strategy, parameters)
    assert (None if result is None else parts(result(MU))) == expected


def test_a_constant_estimate_errs_alike_whatever_is_sent() -> None:
    """It never uses a packet."""
    for name in ("innovation", "plain", "cipher", "twin-track"):
        result = eavesdropper_outcomes(scheme(name), "constant", {})
        assert result is not None
        assert parts(result(MU)) == {"predicted": 1.0}
