"""The rules for classes: built-in classes keep them, an eavesdropper that breaks one is told which, and names are checked."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from evedrop.errors import UsageError
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.fixed_rules import Naive, Suspicious
from evedrop.model.links import LOSS_MODELS
from evedrop.model.links.loss_model import Bernoulli
from evedrop.model.receiver import Flags
from evedrop.model.registry import asked
from evedrop.model.schemes import SCHEMES
from evedrop.model.schemes.innovation import Innovation
from evedrop.scenario.conformance import eavesdroppers
from evedrop.scenario.conformance.eavesdroppers import EavesdropperChecks
from evedrop.scenario.conformance.examine import examined
from evedrop.scenario.conformance.links import LossChecks
from evedrop.scenario.conformance.problems import Problem, small
from evedrop.scenario.conformance.rules import Broken
from tests.examples import mostly_long
from tests.scenario.conformance.breaking import broken

EVERY = [
    (option, name)
    for option, names in (
        ("scheme", SCHEMES),
        ("eavesdropper", STRATEGIES),
        ("link", LOSS_MODELS),
        ("delay", DELAY_MODELS),
    )
    for name in names
]


SLOW = sorted({"reference", "tracker", *(name for name in STRATEGIES if STRATEGIES[name].costly)})
"""Eavesdroppers whose slot takes a hundred or a thousand times as long as another's: learners, and filters of many states."""


def keeps_every_rule(option: str, name: str) -> None:
    """Examine a built-in class, an eavesdropper together with a scheme that it is for."""
    schemes = {
        "reference": {"scheme": "acknowledged"},
        "clear-states": {"scheme": "partial-encryption"},
        "selective": {"scheme": "encrypted-schedule"},
        "tracker": {"scheme": "twin-track"},
    }
    for examined_ in examined({option: name, **(schemes.get(name, {}) if option == "eavesdropper" else {})}, {}):
        assert [verdict for verdict in examined_.verdicts if verdict.broken is not None] == [], examined_.title
        assert len(examined_.verdicts) >= 4


USUAL = [
    *(one for one in EVERY if one[0] in {"link", "delay"}),
    *(("scheme", name) for name in ("innovation", "encrypted-schedule", "twin-track")),
    *(("eavesdropper", name) for name in ("bayesian", "colluding", "suspicious")),
]
"""Schemes with and without acknowledgements and with an initial state of their own; readers of packets, and of losses."""


@pytest.mark.parametrize(("option", "name"), mostly_long(EVERY, USUAL))
def test_built_in_classes_keep_every_rule(option: str, name: str) -> None:
    """On the same small problems as anybody's own."""
    keeps_every_rule(option, name)


@pytest.mark.parametrize("name", mostly_long(SLOW, ["tracker"]))
def test_slow_eavesdroppers_keep_every_rule_for_a_while(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the same problems with fewer slots."""

    def shorter(slots: int = 0) -> list[Problem]:
        result = small(slots)
        return [replace(problem, batch=replace(problem.batch, slots=min(problem.slots, 12))) for problem in result]

    monkeypatch.setattr(eavesdroppers, "small", shorter)
    keeps_every_rule("eavesdropper", name)


class Forgetful(Suspicious):
    """Tosses a new coin for every slot that it is asked for, by how often it was asked."""

    tosses = 0

    def uses(self, k: int) -> Flags | None:
        """By the coin of another slot."""
        self.tosses += 1
        return super().uses((k + self.tosses // 12) % 9)


class Boastful(Naive):
    """Takes every packet, and tells theory that it takes half."""

    @classmethod
    def use_probabilities(cls, parameters: Any) -> tuple[float, float]:
        """Not so."""
        del parameters
        return 0.5, 0.5


@pytest.mark.parametrize(
    ("kind", "rule", "message"),
    [
        (Forgetful, "slots computed again", "Belief.memory"),
        (Boastful, "theory agrees with simulation", "correct use_probabilities, which must be the same in every slot"),
    ],
)
def test_an_eavesdropper_that_breaks_a_rule_is_told_which(kind: Any, rule: str, message: str) -> None:
    """As a scheme is."""
    parameters = dict(kind.parameters)
    name = {Forgetful: "suspicious", Boastful: f"{__name__}:Boastful"}.get(kind, "naive")
    checks = EavesdropperChecks(name, kind, parameters, Innovation, {"state_probability": 0.6})
    assert message in broken(checks.verdicts())[rule]


@pytest.mark.parametrize(
    ("names", "parameters", "message"),
    [
        ({"scheme": "inovation"}, {}, "--scheme inovation is unknown; expected MODULE:CLASS, or acknowledged, "),
        ({"scheme": "innovation"}, {"state_probability": 2.0}, "--scheme innovation: state_probability: is 2.0"),
        (
            {"scheme": "innovation"},
            {"threshold": 2},
            "--set threshold: is not a parameter of innovation; expected state_prob",
        ),
        (
            {"link": "pattern", "scheme": "plain"},
            {"x": 2},
            "--set x: is not a parameter of pattern, plain; expected outcomes",
        ),
        (
            {"eavesdropper": "smart", "scheme": "plain"},
            {},
            "asks for the key of schedule, and the scheme plain has no keys",
        ),
    ],
)
def test_what_cannot_be_checked_is_refused(names: dict[str, str], parameters: dict[str, Any], message: str) -> None:
    """Unknown names, unknown or wrong parameters, and keys that the scheme of the same command does not have."""
    with pytest.raises(UsageError) as caught:
        list(examined(names, parameters))
    assert message in str(caught.value)
    assert caught.value.exit_status == 2


class Chained(Bernoulli):
    """Says that its losses follow a number."""

    chain: Any = 3


class Anywhen(Naive):
    """Is told the state of no slot that there is."""

    @classmethod
    def betrayed(cls, parameters: Any) -> Any:
        """No slot."""
        del parameters
        return "three"


class Silent(Naive):
    """Returns None in place of a list of its parameters' mistakes."""

    @classmethod
    def mistakes(cls, given: Any) -> Any:
        """Nothing."""
        del given


def test_whatever_a_class_says_of_itself_is_a_verdict() -> None:
    """Nothing that it returns ends the check by an error; once shapes are wrong, no other rule is asked."""
    (verdict,) = LossChecks(Chained, {"quality": 0.9}).verdicts()
    assert verdict.rule == "shapes and types"
    assert "'int' object has no attribute 'transitions'" in str(verdict.broken)
    checks = EavesdropperChecks("anywhen", Anywhen, {}, Innovation, {"state_probability": 0.6})
    with pytest.raises(Broken, match=r"betrayed\(\) is 'three'; expected a slot"):
        checks.verdicts()
    assert asked(Silent, {"depth": 3}) == [
        (
            "depth",
            "cannot be checked: Silent.mistakes returned None; expected it to return a list of (entry, what is wrong)",
        )
    ]
