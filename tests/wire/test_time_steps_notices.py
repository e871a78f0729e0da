"""What the view of a wire says about its messages: lines of events, states of lanes, and fractions of losses."""

from __future__ import annotations

import numpy as np
import pytest

from evedrop.wire.panels import loss_of
from evedrop.wire.records import WireFate
from evedrop.wire.time_steps import (
    DELIVERED,
    OUTCOMES,
    CutWatcher,
    LaneState,
    NoticeWatcher,
    WireSteps,
    legend,
    loss_state_of,
    state_of,
)
from tests.wire.wire_rows import plan_of, robot_plan


def steps_of(*counts: dict[WireFate, int]) -> WireSteps:
    """Steps of one link."""
    made = np.zeros((len(counts), 2, len(OUTCOMES)), np.int64)
    for k, count in enumerate(counts):
        for fate, number in count.items():
            made[k, 0, OUTCOMES.index(fate)] = number
    return WireSteps(0, made, np.zeros((len(counts), 2, 3), np.int64), np.zeros((2, 3)))


def test_losses_of_the_wire_itself_are_told_once() -> None:
    """For each reason, and as errors: they are not what the file asked for."""
    steps = steps_of(
        {WireFate.HELD_UP: 3}, {WireFate.HELD_UP: 3, WireFate.REFUSED: 1}, {WireFate.LOST: 4, WireFate.CONGESTED: 1}
    )
    watcher = NoticeWatcher(["scan"], 0.2)
    lines = watcher.watch(steps)
    assert [(round(line.seconds, 6), line.level) for line in lines if "does not cross" in line.text] == [
        (0.0, "ERROR"),
        (0.2, "ERROR"),
        (0.4, "ERROR"),
    ]
    assert "scan: the first message that does not cross: not taken by readers" in [line.text for line in lines]
    assert not [line for line in watcher.watch(steps) if "does not cross" in line.text]


def test_frequent_stretches_get_few_lines() -> None:
    """A link that fails for a second out of two gets a few lines in an hour, not thousands."""
    watcher = NoticeWatcher(["scan"], 0.2)
    lines = watcher.watch(steps_of(*([{WireFate.DELIVERED: 5}] * 5 + [{WireFate.LOST: 5}] * 5) * 1800))
    assert 2 <= len(lines) < 200


def test_pairs_of_sides_are_cut_when_all_their_links_are() -> None:
    """Otherwise the links are named; a link without messages stays as it was."""
    plan = plan_of(("up", "a", "b", {}), ("down", "b", "a", {}), ("tap", "a", "c", {}))
    watcher = CutWatcher(plan.links)
    counts = np.zeros((4, len(OUTCOMES)), np.int64)
    counts[0, OUTCOMES.index(WireFate.CUT)] = counts[1, DELIVERED] = counts[2, DELIVERED] = 5
    watcher.watch(counts)
    assert watcher.cut() == ["up"]
    counts[:] = 0
    counts[1, OUTCOMES.index(WireFate.CUT)] = 5
    watcher.watch(counts)
    assert watcher.cut() == ["a|b"]


@pytest.mark.parametrize(
    ("heard", "lost", "text"),
    [(0, 0, "silent"), (7, 0, "0 % lost"), (7, 7, "100 % lost"), (1000, 213, "21 % lost"), (1000, 13, "1.3 % lost"),
     (100_000, 7, "0.007 % lost"), (1000, 999, "99.9 % lost")],
)  # fmt: skip
def test_fractions_are_rounded_but_never_to_nothing_or_all(heard: int, lost: int, text: str) -> None:
    """A link that lost one message of many has not lost 0 %."""
    counts = np.zeros(len(OUTCOMES), np.int64)
    counts[DELIVERED], counts[OUTCOMES.index(WireFate.LOST)] = heard - lost, lost
    assert loss_of(counts) == text


def test_a_lane_tells_how_much_was_lost() -> None:
    """Half of the messages is most of them; those that were still under way when the wire ended count for nothing."""
    for delivered, lost, underway, state in (
        (9, 1, 0, LaneState.SOME), (3, 2, 0, LaneState.SOME), (2, 2, 0, LaneState.MOST), (0, 5, 0, LaneState.MOST),
        (9, 1, 20, LaneState.SOME), (2, 2, 20, LaneState.MOST), (4, 0, 20, LaneState.DELIVERED),
    ):  # fmt: skip
        counts = steps_of({WireFate.DELIVERED: delivered, WireFate.LOST: lost, WireFate.UNDERWAY: underway}).counts
        assert state_of(counts[0, 0]) is state, (delivered, lost, underway)


def test_the_fraction_of_a_link_counts_every_message() -> None:
    """For whatever reason it was not delivered; a silent link has no fraction."""
    for stretch, state in (
        ({}, LaneState.QUIET), ({WireFate.DELIVERED: 3}, LaneState.DELIVERED),
        ({WireFate.DELIVERED: 3, WireFate.REFUSED: 2}, LaneState.SOME),
        ({WireFate.DELIVERED: 2, WireFate.CUT: 1, WireFate.LOST: 1}, LaneState.MOST),
    ):  # fmt: skip
        assert loss_state_of(steps_of(stretch).counts[0, 0]) is state


def test_the_main_reason_decides_on_a_lane() -> None:
    """Also for a full queue and for losses of the wire's own; the legend has the queue only for links with a rate."""
    expected = {
        WireFate.CORRUPTED: LaneState.SOME, WireFate.OVERFLOW: LaneState.FULL, WireFate.CUT: LaneState.CUT,
        WireFate.REFUSED: LaneState.OWN, WireFate.HELD_UP: LaneState.OWN, WireFate.TOO_MANY_KEYS: LaneState.OWN,
        WireFate.CONGESTED: LaneState.OWN,
    }  # fmt: skip
    for fate, state in expected.items():
        assert state_of(steps_of({WireFate.DELIVERED: 9, WireFate.LOST: 1, fate: 3}).counts[0, 0]) is state
    assert state_of(steps_of({WireFate.UNDERWAY: 3}).counts[0, 0]) is LaneState.QUIET
    assert "queue" not in legend(robot_plan())
    assert "steel: queue full" in legend(plan_of(("a", "b", "c", {"rate": 1000.0})))
