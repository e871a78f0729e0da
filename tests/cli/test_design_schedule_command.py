"""`evedrop design --schedule` as it is typed: keys, numbers, text, refusals."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest

from evedrop.cli.api import design_schedule
from evedrop.model.theory.covariances import Outcomes
from evedrop.model.theory.schedules import SlotRecursion
from evedrop.scenario.loading import load
from tests.builders import UNSTABLE
from tests.conftest import Evedrop
from tests.golden.pages import Golden

SMART = 'eavesdroppers={smart={strategy="smart",link={quality=0.85}}}'
MIXED = 'eavesdroppers={smart={strategy="smart",link={quality=0.85}},wise={strategy="bayesian",link={quality=0.85}}}'
NAIVE = 'eavesdroppers={n={strategy="naive",link={quality=0.5}}}'
BURSTS = 'legitimate.link={loss={model="gilbert-elliott",p=0.1,r=0.5}}'
SHORT = ("--schedule", "8", "--max-trace", "0.004")


def test_json(evedrop: Evedrop) -> None:
    """Exactly the promised keys; the legitimate error within Ω in every slot; what has no closed form is named."""
    done = evedrop("design", "numerical", *SHORT, "--set", MIXED, "--json")
    assert (done.status, done.err) == (0, "")
    schedules = json.loads(done.out, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
    assert list(schedules) == ["eavesdroppers", "left_out"]
    assert schedules["left_out"] == {"wise": "bayesian"}
    smart = schedules["eavesdroppers"]["smart"]
    assert list(smart) == ["best", "constant", "grid", "exact"]
    best = smart["best"]
    assert list(best) == ["mu_d", "legitimate", "eavesdropper", "value"]
    assert {len(best[key]) for key in ("mu_d", "legitimate", "eavesdropper")} == {8}
    assert max(best["legitimate"]) <= 0.004 * (1 + 1e-9)
    assert best["value"] == pytest.approx(sum(best["eavesdropper"]))
    assert best["value"] > smart["constant"]["value"]


def test_for_people(evedrop: Evedrop) -> None:
    """One row for each slot, what is gained, how far the search went, and the line that carries it out."""
    done = evedrop("design", "numerical", "--schedule", "4", "--max-trace", "0.004", "--set", MIXED)
    smart = {"smart": {"strategy": "smart", "link": {"quality": 0.85}}}
    designed = design_schedule("numerical", 4, max_trace=0.004, changes={"eavesdroppers": smart})
    assert (done.status, done.err) == (0, "")
    for words in (
        "against smart: the sum is",
        "the best constant μ_d",
        "legitimate error",
        "best schedule",
        "wise (bayesian)",
    ):
        assert words in done.out, words
    line = next(line for line in done.out.splitlines() if line.startswith("state_probability = "))
    changes = {"encoding": {"scheme": "innovation", **tomllib.loads(line)}, "slots": 4}
    assert load("numerical", changes).encoding.state_probabilities == designed.schedules["smart"].best.mu_d


def test_in_python() -> None:
    """The same from Python; blocks and a weight without Ω."""
    result = design_schedule(
        "numerical", 9, weight=0.5, block=4, changes={"process.initial_covariance": [[1, 0], [0, 1]]}
    )
    best = result.schedules["smart"].best
    assert best.mu_d[1] == best.mu_d[4]
    assert best.mu_d[5] == best.mu_d[8]
    expected = SlotRecursion(UNSTABLE, lambda mu_d: Outcomes.legitimate(0.9, mu_d), 9)
    assert best.legitimate == pytest.approx(expected.traces(np.array([best.mu_d]))[0].tolist())


@pytest.mark.parametrize(
    "words",
    [
        ("--schedule", "1", "--max-trace", "1"),
        ("--schedule", "101", "--max-trace", "1"),
        (*SHORT, "--block", "8"),
        (*SHORT, "--block", "0"),
        (*SHORT, "--weight", "2"),
        (*SHORT, "--weight", "0.2", "0.3"),
        (*SHORT, "--states", "4"),
        ("--schedule", "8"),
        ("--schedule", "8", "--max-trace", "inf"),
        ("--schedule", "8", "--max-trace", "nan"),
        ("--schedule", "8", "--max-trace", "1e-4"),
        (*SHORT, "--policy"),
        (*SHORT, "--set", BURSTS),
        (*SHORT, "--set", 'encoding={scheme="cipher"}', "--set", NAIVE),
        (*SHORT, "--set", 'eavesdroppers={wise={strategy="bayesian",link={quality=0.85}}}'),
    ],
    ids=str,
)  # fmt: skip
def test_refusals(evedrop: Evedrop, words: tuple[str, ...], golden: Golden) -> None:
    """A design that does not exist is refused, with the bound and the remedy."""
    words = words if "--set" in words else (*words, "--set", SMART)
    done = evedrop("design", "numerical", *words)
    assert (done.status, done.out) == (2, "")
    golden("design", done.err)
