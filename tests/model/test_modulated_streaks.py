"""Streaks behind links with a memory, of a genie, and with a μ_d for each slot, against enumerations of all courses of a run."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from evedrop.model import modulated as module
from evedrop.model.links import loss_of
from evedrop.model.links.chain import Chain
from evedrop.model.modulated import ModulatedCovariance, modulated_streaks
from evedrop.model.process import Floats, Process
from evedrop.model.slot.link_distribution import LinkDistribution, Segment
from evedrop.model.theory.covariances import NOBODY, Outcomes, OutcomesAt, theoretical_traces
from evedrop.model.theory.leak import RemainingCovariances
from evedrop.model.theory.rare_events import Streaks, streaks
from tests.model.theory.test_rare_events import FIRST, LEGITIMATE, LOST, MISLEADING, MISLED, PLANE, SMART

BURSTS = Chain(np.array([[0.8, 0.2], [0.5, 0.5]]), np.array([5.0, 2.0]) / 7.0, np.array([0.9, 0.3]))
STEADY = Chain(np.ones((1, 1)), np.ones(1), np.array([0.7]))
MU_D = (1.0, 0.2, 0.8, 0.5)
SLOTS = len(MU_D)
AT: dict[str, Callable[[float], OutcomesAt]] = {
    "legitimate": lambda mu_d: lambda mu: Outcomes.legitimate(mu, mu_d),
    "suspicious": lambda mu_d: lambda mu: Outcomes.eavesdropper(mu, mu_d, 0.9, 0.3),
    "genie": lambda mu_d: lambda mu: Outcomes.genie(mu, mu_d),
}


def enumerated(process: Process, chain: Chain, outcomes_in: Callable[[int], OutcomesAt]) -> tuple[Floats, Floats]:
    """The numbers and carried errors of `Streaks`, (3, SLOTS) each, from every course of the link's states and of outcomes."""
    number, carried = np.zeros((3, SLOTS)), np.zeros((3, SLOTS))
    sigma, remaining = [process.initial_covariance], RemainingCovariances(process)
    M = [np.zeros_like(process.Q), *(remaining.next(1)[0] for _ in range(1, SLOTS))]
    for _ in range(1, SLOTS):
        sigma.append(process.A @ sigma[-1] @ process.A.T + process.Q)
    names = ("predicted", "decoded", "state", "misled", "leaked")
    for states in itertools.product(range(len(chain.stationary)), repeat=SLOTS):
        odds = [outcomes_in(k)(float(chain.quality[s])) for k, s in enumerate(states)]
        likely = chain.stationary[states[0]] * np.prod([chain.transitions[pair] for pair in itertools.pairwise(states)])
        for unused in (False, True):
            for course in itertools.product(names, repeat=SLOTS - 1):
                weight = likely * (odds[0].initial if unused else 1.0 - odds[0].initial)
                weight *= np.prod([getattr(odd, name) for odd, name in zip(odds[1:], course, strict=True)])
                P, kind, length = process.initial_covariance * unused, FIRST if unused else None, 0
                for k in range(SLOTS):
                    if k:
                        outcome, moved = course[k - 1], process.A @ P @ process.A.T
                        length += 1
                        if outcome == "state":
                            P, kind = np.zeros_like(P), None
                        elif outcome == "misled":
                            P, kind, length = 2.0 * process.A @ sigma[k - 1] @ process.A.T, MISLEADING, 0
                        elif outcome == "decoded":
                            P = moved
                        else:
                            P = moved + (process.Q if outcome == "predicted" else M[k])
                            kind, length = (LOST, 0) if kind is None else (kind, length)
                    if kind is not None:
                        number[kind, length] += weight
                        carried[kind, length] += weight * float(np.trace(P))
    return number, carried


def found_in(link: LinkDistribution, at: OutcomesAt, slots: int, process: Process = PLANE) -> Streaks:
    """The streaks of a run that has them."""
    total = float(ModulatedCovariance(process, link, at).next_traces(slots).sum())
    result = modulated_streaks(process, link, at, slots, total)
    assert result is not None
    return result


@pytest.mark.parametrize("reader", AT)
@pytest.mark.parametrize("chain", [BURSTS, STEADY], ids=["bursts", "steady"])
def test_streaks_are_those_of_all_courses_of_a_run(chain: Chain, reader: str) -> None:
    """Kind by kind and length by length, with a μ_d for each slot and with one for all."""
    link, mean = LinkDistribution.steady(chain), AT[reader](0.5)
    for slots_at in (lambda k: AT[reader](MU_D[min(k, SLOTS - 1)]), None):
        total = float(ModulatedCovariance(PLANE, link, mean, slots_at).next_traces(SLOTS).sum())
        result = modulated_streaks(PLANE, link, mean, SLOTS, total, slots_at)
        assert result is not None
        number, carried = enumerated(PLANE, chain, slots_at or (lambda _: mean))
        assert result.number == pytest.approx(number, rel=1e-9, abs=1e-15)
        assert result.carried == pytest.approx(carried, rel=1e-9, abs=1e-15)
        assert result.carried.sum() == pytest.approx(total, rel=1e-9)


@pytest.mark.parametrize(
    "outcomes", [LEGITIMATE, MISLED, SMART, NOBODY], ids=["legitimate", "misled", "smart", "nobody"]
)
def test_independent_losses_have_the_streaks_of_the_closed_form(outcomes: Outcomes) -> None:
    """A chain of one state, in a longer run."""
    result = modulated_streaks(
        PLANE,
        LinkDistribution.steady(STEADY),
        lambda _: outcomes,
        40,
        float(theoretical_traces(PLANE, outcomes, 40).sum()),
    )
    closed = streaks(PLANE, outcomes, 40)
    assert result is not None
    assert closed is not None
    for trials in (1, 30, 1000):
        assert result.fraction(trials) == pytest.approx(closed.fraction(trials), rel=1e-6, abs=1e-8)
    assert result.trials_for(0.01) == closed.trials_for(0.01)


def test_a_link_that_changes_during_the_run() -> None:
    """In the slot of a change the new chain begins in its stationary distribution; all of the error is carried."""
    better = Chain(np.array([[0.9, 0.1], [0.1, 0.9]]), np.array([0.5, 0.5]), np.array([1.0, 0.6]))
    link = LinkDistribution(
        (
            *LinkDistribution.steady(BURSTS).segments,
            Segment(20, better, 0.9, np.ones(1)),
            Segment(99, BURSTS, 1.0, np.ones(1)),
        )
    )
    at = AT["suspicious"](0.4)
    streaks = found_in(link, at, 60)
    assert streaks.carried.sum() == pytest.approx(streaks.total, rel=2e-9)
    assert np.all(np.diff(streaks.number) <= 0.0)


def test_a_link_that_stops_turning_bad() -> None:
    """Its chain has a single state from then on; the streaks are those of a chain with the same losses and two states."""
    loses = {"model": "gilbert-elliott", "p": 0.1, "r": 0.4, "good": 0.2, "bad": 0.9}
    before, after = (loss_of({**loses, "p": p}).chain for p in (0.1, 0.0))
    assert before is not None
    assert after is not None
    assert len(before.stationary) > len(after.stationary)
    two = Chain(np.full((2, 2), 0.5), np.full(2, 0.5), np.repeat(after.quality, 2))
    at, first = AT["suspicious"](0.4), LinkDistribution.steady(before).segments[0]
    for chains, equal in (((before, after), (before, two)), ((after, before), (two, before))):
        result, same = (
            found_in(LinkDistribution((replace(first, chain=one), Segment(50, other, 1.0, np.ones(1)))), at, 90)
            for one, other in (chains, equal)
        )
        assert result.number == pytest.approx(same.number, rel=1e-12, abs=1e-18)
        assert result.carried == pytest.approx(same.carried, rel=1e-12, abs=1e-18)
        assert result.carried.sum() == pytest.approx(result.total, rel=2e-9)


def test_bursts_make_rare_events_rarer_and_larger() -> None:
    """Of two links with the same mean loss, the one with long bursts has more of its error in streaks that trials miss."""
    at, process = AT["legitimate"](0.6), Process(np.eye(1), np.eye(1), np.eye(1))
    long = Chain(np.array([[0.99, 0.01], [0.09, 0.91]]), np.array([0.9, 0.1]), np.array([1.0, 0.0]))
    alike = replace(STEADY, quality=np.array([0.9]))
    fractions = [found_in(LinkDistribution.steady(chain), at, 100, process).fraction(20) for chain in (long, alike)]
    assert fractions[0] > 5.0 * fractions[1] > 0.0


def test_what_is_not_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Late packets, outages, errors beyond double precision, and more numbers than are allowed."""
    at, link = AT["legitimate"](0.5), LinkDistribution.steady(BURSTS)
    late = LinkDistribution((replace(link.segments[0], arrived=np.array([0.5, 1.0])),))
    away = replace(link, outages=((3, 5, True),))
    for schedule in (late, away):
        assert modulated_streaks(PLANE, schedule, at, 9, 1.0) is None
    assert modulated_streaks(PLANE, link, at, 9, float("inf")) is None
    total = found_in(link, at, 9).total
    for name, most in (("_LARGEST_RUN", 9 * 4 * 2 - 1), ("MOST_NUMBERS", 9 * 4 * 2 * 3)):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, most)
            assert modulated_streaks(PLANE, link, at, 9, total) is None


def test_a_packet_that_is_delayed_into_a_later_slot_is_lost() -> None:
    """Without a window: the streaks are those behind a link that loses it, and carry all of the error."""
    lossy = Chain(BURSTS.transitions, BURSTS.stationary, 0.6 * BURSTS.quality)
    at = AT["suspicious"](0.4)
    delayed = found_in(LinkDistribution((Segment(0, BURSTS, 1.0, np.array([0.6])),)), at, 40)
    lost = found_in(LinkDistribution.steady(lossy), at, 40)
    np.testing.assert_allclose(delayed.number, lost.number, rtol=1e-12)
    np.testing.assert_allclose(delayed.carried, lost.carried, rtol=1e-12)
    assert delayed.carried.sum() == pytest.approx(delayed.total, rel=2e-9)
