"""Tests of the streaks that carry an expected error, against enumerations of all courses of a run."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from evedrop.model import process as parts_of_runs
from evedrop.model.process import Floats, Process
from evedrop.model.theory import rare_events
from evedrop.model.theory.covariances import NOBODY, Outcomes, theoretical_traces
from evedrop.model.theory.rare_events import RARE, Streaks, rare_in_slots, streaks
from tests.examples import mostly_long

PLANE = Process(
    np.array([[1.1, 0.3], [0.0, 0.7]]), np.array([[0.5, 0.1], [0.1, 0.3]]), np.array([[9.0, 1.0], [1.0, 4.0]])
)
STABLE = Process(np.array([[0.9]]), np.array([[1.0]]), np.array([[1.0]]))
LEGITIMATE = Outcomes.legitimate(0.8, 0.3)
MISLED = Outcomes.eavesdropper(0.7, 0.4, 0.9, 0.3)
SMART = Outcomes.eavesdropper(0.7, 0.4, 1.0, 0.0)
LOST, MISLEADING, FIRST = range(3)


def enumerated(process: Process, outcomes: Outcomes, slots: int) -> tuple[Floats, Floats]:
    """The numbers and carried errors of streaks, (3, slots, slots): kind, slot of the streak, slot of the run.

    From every course that a run can take.
    """
    number, carried = np.zeros((2, 3, slots, slots))
    sigma = [process.initial_covariance]
    for _ in range(1, slots):
        sigma.append(process.A @ sigma[-1] @ process.A.T + process.Q)
    odds = {name: getattr(outcomes, name) for name in ("predicted", "decoded", "state", "misled")}
    for unused in (False, True):
        for course in itertools.product(odds, repeat=slots - 1):
            weight = outcomes.initial if unused else 1.0 - outcomes.initial
            weight *= math.prod(odds[outcome] for outcome in course)
            P = process.initial_covariance * unused
            kind, length = (FIRST, 0) if unused else (None, 0)
            for k in range(slots):
                if k:
                    outcome = course[k - 1]
                    length += 1
                    moved = process.A @ P @ process.A.T
                    if outcome == "state":
                        P, kind = np.zeros_like(P), None
                    elif outcome == "misled":
                        P, kind, length = 2.0 * process.A @ sigma[k - 1] @ process.A.T, MISLEADING, 0
                    elif outcome == "predicted":
                        P = moved + process.Q
                        kind, length = (LOST, 0) if kind is None else (kind, length)
                    else:
                        P = moved
                if kind is not None:
                    number[kind, length, k] += weight
                    carried[kind, length, k] += weight * float(np.trace(P))
    return number, carried


def found_in(process: Process, outcomes: Outcomes, slots: int) -> Streaks:
    """The streaks of a run that has them."""
    result = streaks(process, outcomes, slots)
    assert result is not None
    return result


@pytest.mark.parametrize("process", [PLANE, STABLE], ids=["plane", "stable"])
@pytest.mark.parametrize(
    "outcomes", [LEGITIMATE, MISLED, SMART, NOBODY], ids=["legitimate", "misled", "smart", "nobody"]
)
def test_streaks_are_those_of_all_courses_of_a_run(process: Process, outcomes: Outcomes) -> None:
    """Numbers and carried errors agree with the enumeration of every course of six slots, kind by kind and slot by slot."""
    streaks_ = found_in(process, outcomes, 6)
    number, carried = (of.sum(axis=2) for of in enumerated(process, outcomes, 6))
    assert streaks_.number == pytest.approx(number, rel=1e-12, abs=1e-15)
    assert streaks_.carried == pytest.approx(carried, rel=1e-12, abs=1e-15)
    assert streaks_.total == pytest.approx(carried.sum(), rel=1e-12)


@pytest.mark.parametrize("process", [PLANE, STABLE], ids=["plane", "stable"])
@pytest.mark.parametrize("trials", mostly_long([10, 40, 200, 3000, 10**5], [40, 3000]))
@pytest.mark.parametrize(
    "outcomes", [LEGITIMATE, MISLED, SMART, NOBODY], ids=["legitimate", "misled", "smart", "nobody"]
)
def test_the_rare_events_of_a_slot_are_those_of_all_courses_of_a_run(
    process: Process, outcomes: Outcomes, trials: int
) -> None:
    """Rare in a slot: what streaks of a kind carry that are at least as long as too few trials are expected to have."""
    number, carried = enumerated(process, outcomes, 6)
    at_least = (
        np.cumsum(number[:, ::-1], axis=1)[:, ::-1] * trials
    )  # expected trials in a streak of this length or a longer one
    rare = np.where(at_least < RARE * (1.0 - 1e-12), carried, 0.0).sum(axis=(0, 1)) / carried.sum(axis=(0, 1))
    assert rare_in_slots(process, outcomes, 6, trials) == pytest.approx(rare, rel=1e-9, abs=2e-9)


def test_rare_events_of_slots_are_unknown_for_a_genie_and_for_too_much_work() -> None:
    """Neither wrong nor endless."""
    assert rare_in_slots(PLANE, Outcomes.genie(0.9, 0.5), 6, 100) is None
    assert rare_in_slots(STABLE, NOBODY, 2**20, 100) is None


@pytest.mark.parametrize("outcomes", [LEGITIMATE, MISLED, SMART, Outcomes.legitimate(0.8, 0.0)])
def test_streaks_do_not_depend_on_the_parts_of_a_run(monkeypatch: pytest.MonkeyPatch, outcomes: Outcomes) -> None:
    """A long run is computed in parts, whose end is kept; streaks longer than a part make it keep more."""
    whole = found_in(STABLE, outcomes, 700)
    monkeypatch.setattr(parts_of_runs, "SLOTS_AT_ONCE", 7)
    monkeypatch.setattr(rare_events, "SLOTS_AT_ONCE", 7)
    parts = found_in(STABLE, outcomes, 700)
    assert whole.number.shape[1] > 7
    assert np.array_equal(parts.number, whole.number)
    np.testing.assert_allclose(parts.carried, whole.carried, rtol=1e-12)
    assert parts.total == pytest.approx(whole.total, rel=1e-12)


@pytest.mark.parametrize("outcomes", [LEGITIMATE, MISLED, SMART], ids=["legitimate", "misled", "smart"])
def test_streaks_of_a_long_run_carry_the_whole_expectation(outcomes: Outcomes) -> None:
    """Over several blocks of powers, all but the fraction that is left out is carried; the numbers fall with the length."""
    streaks_ = found_in(STABLE, outcomes, 3000)
    assert streaks_.total == pytest.approx(float(theoretical_traces(STABLE, outcomes, 3000).sum()), rel=1e-12)
    assert streaks_.carried.sum() == pytest.approx(streaks_.total, rel=2e-9)
    assert np.all(np.diff(streaks_.number) <= 0.0)


def test_the_fraction_is_of_streaks_that_too_few_trials_meet() -> None:
    """The fraction falls with the trials, and `trials_for` gives the number at which it reaches a level."""
    streaks_ = found_in(PLANE, SMART, 200)
    fractions = [streaks_.fraction(trials) for trials in (1, 10, 100, 10_000, 10**9)]
    assert fractions == sorted(fractions, reverse=True)
    assert fractions[0] > 0.1
    assert fractions[-1] < 0.001
    for level in (0.2, 0.05, 0.001):
        trials = int(streaks_.trials_for(level))
        assert streaks_.fraction(trials) <= level < streaks_.fraction(trials - 20)


def test_a_small_fraction_is_not_rounded_away() -> None:
    """A fraction above 1e-9 is told as it is; less than that is what `streaks` leaves out, and counts as nothing."""
    number = np.array([[1.0, 1e-6], [0.0, 0.0], [0.0, 0.0]])
    for rare, fraction in ((5e-4, 5e-4), (2e-9, 2e-9), (5e-10, 0.0)):
        carried = np.array([[1.0 - rare, rare], [0.0, 0.0], [0.0, 0.0]])
        assert Streaks(number, carried, 1.0).fraction(100) == pytest.approx(fraction, rel=1e-6)


def test_the_fraction_of_an_initial_covariance_that_no_trial_misses_packets_of() -> None:
    """A first packet that one trial in a thousand loses carries nearly all of the error if nothing else does."""
    process = Process(np.array([[0.5]]), np.array([[1e-9]]), np.array([[1.0]]))
    streaks_ = found_in(process, Outcomes.plain(0.999), 50)
    assert streaks_.fraction(19_000) > 0.99
    assert streaks_.fraction(20_001) < 0.01
    assert streaks_.trials_for(0.05) == 20_000.0


def test_a_receiver_without_error_has_no_rare_events() -> None:
    """A perfect link has no error that anything could carry."""
    streaks_ = found_in(STABLE, Outcomes.plain(1.0), 20)
    assert (streaks_.total, streaks_.fraction(1), streaks_.trials_for(0.05)) == (0.0, 0.0, 1.0)


def test_a_number_of_trials_beyond_double_precision_is_infinite() -> None:
    """A start that grows faster than its streak dies out is carried by a streak that no number of trials meets."""
    process = Process(np.array([[1e3]]), np.array([[1.0]]), np.array([[1.0]]))
    streaks_ = found_in(process, Outcomes.plain(1.0 - 1e-5), 70)
    assert streaks_.fraction(10**9) > 0.99
    assert streaks_.trials_for(0.05) == math.inf


def test_streaks_are_unknown_where_they_cannot_be_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A genie, an error beyond double precision, and a misled receiver in too long a run have none."""
    assert streaks(STABLE, Outcomes.genie(0.7, 0.4), 5) is None
    assert streaks(PLANE, NOBODY, 10_000) is None
    monkeypatch.setattr(rare_events, "LARGEST_RUN", 19)
    assert streaks(PLANE, MISLED, 5) is None
    assert streaks(PLANE, MISLED, 4) is not None
    assert streaks(PLANE, SMART, 5) is not None


@pytest.mark.parametrize("trials", [1, 3, 100])
def test_what_happens_in_every_trial_is_not_rare(trials: int) -> None:
    """However few trials there are: a receiver without packets has the same streak in each of them."""
    carried = streaks(PLANE, NOBODY, 30)
    assert carried is not None
    assert carried.fraction(trials) == 0.0
    assert carried.trials_for(0.1) == 1.0
