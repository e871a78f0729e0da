"""Theory behind links that change, delay packets or lose their receivers: against the distribution of the last packet's age."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from evedrop.model.delays import delay_of
from evedrop.model.links import loss_of
from evedrop.model.links.loss_model import Fate
from evedrop.model.modulated import ModulatedCovariance, limit_of, modulated_streaks
from evedrop.model.process import Process
from evedrop.model.slot.link import NEVER, Change, LinkSchedule, ReceiverOutage
from evedrop.model.slot.link_distribution import distribution_of, stretches
from evedrop.model.theory.covariances import Outcomes
from evedrop.scenario.theory import Expectation

WALK = Process(np.eye(1), np.array([[0.3]]), np.array([[2.0]]))
SLOTS = 60


def aged(quality: Callable[[int], float], there: Callable[[int], float], window: int) -> list[float]:
    """E P_k of a random walk every packet of which is the state: noise since the newest packet that is there.

    quality: of a slot; there: probability that a packet is there after so many slots, of those that come through.
    """
    Q, sigma = 0.3, 2.0
    totals = []
    for k in range(SLOTS):
        missing, total = 1.0, 0.0
        for j in range(k, -1, -1):
            arrived = quality(j) * there(min(k - j, window))
            total += missing * arrived * Q * (k - j)
            missing *= 1.0 - arrived
        totals.append(total + missing * (sigma + Q * k))
    return totals


def traces(schedule: LinkSchedule) -> np.ndarray:
    """What theory says."""
    return Expectation(WALK, distribution_of(schedule), Outcomes.plain).traces(SLOTS)


PLAIN: dict[str, Any] = {"loss": {"model": "bernoulli", "quality": 0.6}}
DELAYS = (
    {"model": "constant", "value": 2.0},
    {"model": "normal", "mean": 1.5, "standard_deviation": 1.0},
    {"model": "pareto", "least": 0.4, "shape": 1.2},
)


@pytest.mark.parametrize("window", [0, 1, 5])
@pytest.mark.parametrize("delay", DELAYS, ids=lambda delay: delay["model"])
def test_late_packets(delay: dict[str, Any], window: int) -> None:
    """With delays, reordering and corruption, the expectation and its limit, to 1e-12."""
    schedule = LinkSchedule({**PLAIN, "delay": delay, "reorder": 0.2, "corrupt": 0.1}, window)
    model = delay_of(delay)
    there = [0.2 + 0.8 * (model.arrived(lag) or 0.0) for lag in range(window + 1)]
    expected = aged(lambda _: 0.6 * 0.9, lambda lag: there[lag], window)
    np.testing.assert_allclose(traces(schedule), expected, rtol=1e-12)
    link = distribution_of(schedule)
    assert link is not None
    settled = Expectation(WALK, link, Outcomes.plain).traces(900)[-1]
    assert limit_of(WALK, link, Outcomes.plain) == pytest.approx(settled, rel=1e-9)


def test_links_that_change() -> None:
    """Other qualities and other delays from some slot on, and a cut in between."""
    later = {"loss": {"model": "bernoulli", "quality": 0.9}}
    schedule = LinkSchedule(
        PLAIN, 0, (Change(15, later), Change(20, cut=True), Change(30, cut=False), Change(40, PLAIN))
    )

    def quality(k: int) -> float:
        return 0.0 if 20 <= k < 30 else 0.9 if 15 <= k < 40 else 0.6

    np.testing.assert_allclose(traces(schedule), aged(quality, lambda _: 1.0, 0), rtol=1e-12)


def test_a_quality_that_differs_from_slot_to_slot() -> None:
    """A link whose ends move apart, by the model's probability for every slot."""
    moving = {
        "model": "distance",
        "sender": [0.0, 0.0],
        "receiver": [[0, 30.0, 0.0], [50, 300.0, 0.0]],
        "reference_snr": 80.0,
        "exponent": 3.0,
        "threshold": 10.0,
    }
    qualities = loss_of(moving).quality_at(range(SLOTS))
    expected = aged(lambda k: float(qualities[k]), lambda _: 1.0, 0)
    np.testing.assert_allclose(traces(LinkSchedule({"loss": moving})), expected, rtol=1e-12)


@pytest.mark.parametrize("keeps", [True, False])
@pytest.mark.parametrize(("start", "stop"), [(0, 5), (10, 25), (30, NEVER)])
def test_a_receiver_that_goes_away(start: int, stop: int, keeps: bool) -> None:
    """Its last estimate is carried on, or it starts from 0 and Σ."""
    schedule = LinkSchedule(PLAIN, 0, (), (ReceiverOutage(start, stop, Fate.DOWN, keeps),))
    if keeps:
        expected = aged(lambda k: 0.0 if start <= k < stop else 0.6, lambda _: 1.0, 0)
    else:
        expected = aged(lambda _: 0.6, lambda _: 1.0, 0)[:start]
        for k in range(start, SLOTS):
            heard = max(0, k - stop + 1)
            newest = sum(0.4**age * 0.6 * 0.3 * age for age in range(heard))
            expected.append(newest + 0.4**heard * (2.0 + 0.3 * k))
    np.testing.assert_allclose(traces(schedule), expected, rtol=1e-12)


def test_a_chain_with_delays_is_a_chain_of_two_ends() -> None:
    """Bursts whose states are alike are not bursts, also with late packets; and a new chain begins in its own link."""
    alike = {"loss": {"model": "gilbert-elliott", "p": 0.1, "r": 0.3, "good": 0.4, "bad": 0.4}}
    delay = {"delay": {"model": "normal", "mean": 1.5, "standard_deviation": 1.0}}
    np.testing.assert_allclose(
        traces(LinkSchedule({**alike, **delay}, 4)), traces(LinkSchedule({**PLAIN, **delay}, 4)), rtol=1e-12
    )
    changed = LinkSchedule(PLAIN, 0, (Change(20, alike), Change(30, PLAIN)))
    np.testing.assert_allclose(traces(changed), traces(LinkSchedule(PLAIN)), rtol=1e-12)


def test_a_change_that_leaves_the_losses_alone_leaves_their_chain_alone() -> None:
    """A burst outlasts a cut of one slot. A chain with another parameter starts afresh. Checked slot by slot, in every state."""
    bursts = {"loss": {"model": "gilbert-elliott", "p": 0.02, "r": 0.05}}
    other = {"loss": {"model": "gilbert-elliott", "p": 0.04, "r": 0.1}}
    changes = (Change(20, cut=True), Change(21, cut=False), Change(30, {**bursts, "corrupt": 0.1}), Change(40, other))
    link = distribution_of(LinkSchedule(bursts, 0, changes))
    assert link is not None
    pi, good = np.array([5.0, 2.0]) / 7.0, np.array([1.0, 0.0])
    states, expected = np.zeros(2), []
    for k in range(SLOTS):
        T = np.array([[0.98, 0.02], [0.05, 0.95]]) if k < 40 else np.array([[0.96, 0.04], [0.1, 0.9]])
        before = pi * states.sum() if k == 40 else states @ T
        arrives = good * (0.0 if k == 20 else 0.9 if 30 <= k < 40 else 1.0)
        states = (1.0 - arrives) * (before + 0.3 * pi if k else 2.0 * pi)
        expected.append(float(states.sum()))
    np.testing.assert_allclose(ModulatedCovariance(WALK, link, Outcomes.plain).next_traces(SLOTS), expected, rtol=1e-12)
    streaks = modulated_streaks(WALK, link, Outcomes.plain, SLOTS, sum(expected))
    assert streaks is not None
    assert streaks.carried.sum() == pytest.approx(sum(expected), rel=2e-9)


def test_slots_may_be_asked_for_in_any_pieces() -> None:
    """The same numbers."""
    schedule = LinkSchedule({**PLAIN, "delay": DELAYS[1]}, 3, (Change(17, {**PLAIN, "delay": DELAYS[0]}),))
    link = distribution_of(schedule)
    assert link is not None
    stream = ModulatedCovariance(WALK, link, Outcomes.plain)
    parts = [stream.next_traces(count) for count in (1, 16, 1, 1, 20, 21)]
    assert np.array_equal(np.concatenate(parts), traces(schedule))


@pytest.mark.parametrize(
    "schedule",
    [
        LinkSchedule({**PLAIN, "rate": 0.5, "queue": 5}),
        LinkSchedule({**PLAIN, "delay": {"model": "trace", "values": [1.0]}}, 2),
        LinkSchedule({**PLAIN, "delay": DELAYS[0]}, 2, (), (ReceiverOutage(3, 5, Fate.DOWN),)),
        LinkSchedule({"loss": {"model": "trace", "outcomes": "110", "random_start": True}}),
        LinkSchedule({"loss": {"model": "pattern", "outcomes": "110"}}),
    ],
    ids=["queue", "recorded delays", "away while packets are under way", "memory", "no limit"],
)
def test_what_theory_does_not_know(schedule: LinkSchedule) -> None:
    """There is no number then."""
    assert distribution_of(schedule) is None
    assert np.isnan(traces(schedule)).all()
    assert math.isnan(Expectation(WALK, None, Outcomes.plain).limit)


def test_of_two_changes_in_a_slot_both_count_from_there_on() -> None:
    """The settings of the first and the cut of the second are one stretch."""
    other = {"loss": {"model": "bernoulli", "quality": 0.2}}
    schedule = LinkSchedule(PLAIN, 0, (Change(15, other), Change(15, cut=True)))
    assert stretches(schedule) == [(0, PLAIN, False), (15, other, True)]
