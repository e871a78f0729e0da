"""The leak in bits of a run: what is counted, compared with theory, and where it is not known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.cli.api import compare, montecarlo
from evedrop.model.metrics.standard_error import z_of
from evedrop.model.receiver import Action
from evedrop.model.theory.leaked_bits import LeakedBits
from evedrop.scenario.loading import load
from evedrop.score.leak import HeardBits, HeardBitsStream, LeakTally, leak_is_known
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode

ALONE = Plan(workers=1)


def leak_of(scenario: str, folder: Path, receiver: str, **changes: Any) -> Any:
    """The entry of a study."""
    return montecarlo(scenario, out=folder, plan=ALONE, expect=[], **changes).summary["secrecy"][receiver]["leak"]


@pytest.mark.thorough
def test_the_bits_of_a_run_are_those_of_its_innovations(tmp_path: Path) -> None:
    """From the recorded rows: b_k where an innovation was received; states are counted instead. Theory agrees."""
    some: dict[str, Any] = {"slots": 120, "trials": 40, "record_trials": 40}
    results = montecarlo("eavesdroppers", out=tmp_path / "run", plan=ALONE, expect=[], **some)
    scenario = load("eavesdroppers", some)
    bits = LeakedBits(scenario.process.process).next(120)
    total, clear = np.zeros(40), 0
    for row in results.trials.to_pylist():
        if row["peer"] == "smart" and row["action"] != "dropped":
            hidden = row["sent"] == "innovation"
            total[row["trial"]] += bits[row["slot"]] if hidden else 0.0
            clear += not hidden
    leak = results.summary["secrecy"]["smart"]["leak"]
    assert leak["bits"] == pytest.approx(total.mean() / 120, rel=1e-12)
    assert leak["standard_error"] == pytest.approx(np.std(total / 120, ddof=1) / np.sqrt(40), rel=1e-9)
    assert leak["clear_fraction"] == pytest.approx(clear / 40 / 120, rel=1e-12)
    mu_e, mu_d = scenario.quality["smart"], scenario.encoding.mu_d
    assert leak["expected_bits"] == pytest.approx(mu_e * (1.0 - mu_d) * bits.mean(), rel=1e-12)
    assert leak["z"] == pytest.approx(z_of(total / 120, leak["expected_bits"]), rel=1e-6)
    assert abs(leak["z"]) < 4.5


@pytest.mark.parametrize(("scheme", "clear"), [("plain", 0.9), ("cipher", 0.0), ("withholding", 0.54)])
def test_other_schemes_reveal_states_or_nothing(tmp_path: Path, scheme: str, clear: float) -> None:
    """Plain and withholding only states, the cipher nothing."""
    encoding: dict[str, Any] = {"scheme": scheme, **({"state_probability": 0.6} if scheme == "withholding" else {})}
    eve = {"eve": {"strategy": "naive", "link": {"quality": 0.9}}}
    leak = leak_of("eavesdroppers", tmp_path / "run", "eve", slots=100, trials=50, encoding=encoding, eavesdroppers=eve)
    assert leak["bits"] == leak["expected_bits"] == 0.0
    assert leak["clear_fraction"] == pytest.approx(clear, abs=0.03)


def test_a_schedule_of_probabilities_leaks_slot_by_slot() -> None:
    """Where μ_d differs from slot to slot, so do the fractions of states and innovations."""
    chances = [1.0, 0.2, 0.9, 0.0]
    encoding = {"scheme": "innovation", "state_probability": chances}
    scenario = load("eavesdroppers", {"slots": 4, "encoding": encoding, "expect": []})
    bits = LeakedBits(scenario.process.process).next(4)
    expected = HeardBitsStream(scenario).of(range(4))["smart"].expected
    assert expected is not None
    np.testing.assert_allclose(expected, scenario.quality["smart"] * (1.0 - np.array(chances)) * bits, rtol=1e-12)


def test_trials_in_parts_have_the_same_bits() -> None:
    """However slots and trials are divided; trials that were cut short at different slots have no metric."""
    random = np.random.default_rng(5)
    action = random.choice([Action.LOST, Action.STATE, Action.DISCARDED], (30, 8)).astype(np.uint8)
    nu = random.random((30, 8)) < 0.5
    by_type = np.stack([np.full(30, np.inf), random.random(30)], axis=1)
    expected_bits = random.random(30)
    whole = LeakTally(8)
    whole.add_slots(action, nu, HeardBits(by_type, expected_bits))
    parts = []
    for trials in (slice(0, 3), slice(3, 8)):
        part = LeakTally(trials.stop - trials.start)
        for rows in (slice(0, 7), slice(7, 30)):
            part.add_slots(action[rows, trials], nu[rows, trials], HeardBits(by_type[rows], expected_bits[rows]))
        parts.append(part)
    summary, expected = LeakTally.merged(parts).summary, whole.summary
    assert summary is not None
    assert expected is not None
    assert summary.expected_bits == pytest.approx(expected.expected_bits)
    assert (summary.bits, summary.clear_fraction, summary.standard_error) == (
        expected.bits,
        expected.clear_fraction,
        expected.standard_error,
    )
    short = LeakTally(2)
    short.add_slots(action[:5, :2], nu[:5, :2], HeardBits(by_type[:5], expected_bits[:5]))
    assert LeakTally.merged([*parts, short]).summary is None


def test_where_it_is_not_known(tmp_path: Path) -> None:
    """The estimator, late packets, a plant, schemes whose packets depend on those before, and modes without packets."""
    assert not leak_is_known(load("eavesdroppers"), "legitimate")
    for scenario in ("heated-room", "acknowledged"):
        assert HeardBitsStream(load(scenario)).of(range(3)) == {}, scenario
    assert list(HeardBitsStream(load("late")).of(range(3))) == ["hasty"]  # it accepts no late packets
    assert not leak_is_known(load("late", {"eavesdroppers.hasty.window": 3}), "hasty")
    pattern = {"eve": {"strategy": "naive", "link": {"loss": {"model": "pattern", "outcomes": "110"}}}}
    leak = leak_of("eavesdroppers", tmp_path / "pattern", "eve", slots=60, trials=5, eavesdroppers=pattern)
    assert leak["bits"] > 0.0
    assert leak["expected_bits"] is leak["z"] is None
    covariances = montecarlo(
        "eavesdroppers",
        slots=20,
        trials=5,
        out=tmp_path / "modes",
        plan=Plan(Mode.COVARIANCE_ONLY, workers=1),
        expect=[],
    )
    assert covariances.summary["secrecy"]["smart"]["leak"] is None


@pytest.mark.thorough
def test_a_comparison_has_the_leak_of_schemes_and_pairs(tmp_path: Path) -> None:
    """Per packet for a scheme, whatever the link, and per slot for a pair, as in the summary; a dash where it is not known."""
    schemes = ["plain", "cipher", "innovation", "twin-track"]
    result = compare(
        "bayesian", schemes=schemes, adversaries=["naive"], slots=40, trials=30, out=tmp_path / "run", plan=ALONE
    )
    leaks = result.as_dict()["schemes"]
    assert leaks["plain"]["leak"] == {"clear_fraction": 1.0, "bits": None}
    assert leaks["cipher"]["leak"] == {"clear_fraction": 0.0, "bits": 0.0}
    assert leaks["twin-track"]["leak"] is None
    scenario = load("bayesian", {"slots": 40})
    mu_d, bits = scenario.encoding.mu_d, LeakedBits(scenario.process.process).next(40)
    assert leaks["innovation"]["leak"]["clear_fraction"] == pytest.approx((1.0 + 39 * mu_d) / 40)
    assert leaks["innovation"]["leak"]["bits"] == pytest.approx(bits.sum() / 39)
    rows = {row["scheme"]: row for row in result.table.to_pylist()}
    pair = leaks["innovation"]["against"]["naive"]["secrecy"]["leak"]
    assert rows["innovation"]["leaked_bits"] == pair["bits"] > 0.0
    assert rows["innovation"]["leaked_bits_theory"] == pair["expected_bits"]
    assert abs(pair["z"]) < 4.5
    assert rows["twin-track"]["leaked_bits"] is None
