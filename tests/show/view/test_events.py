from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from evedrop.model.acknowledgements import AckFate
from evedrop.model.receiver import Codes
from evedrop.show.view.events import AckWatcher, Event, Watcher
from evedrop.show.view.scene import AckScene, Scene, Shown

LOST, STATE, SILENT, MISLED = 0, 1, 4, 5


def watch(codes: list[int], cuts: list[int], slots: int = 1000, role: str = "eavesdropper") -> list[Event]:
    """Events of a lane that is handed over in pieces."""
    shown = Shown("eve", role, "naive", 0.9)
    watcher = Watcher(shown, Scene("", "r", slots, 1, 2, 0.0, (shown,), 1.0))
    events: list[Event] = []
    bounds = [0, *sorted(cuts), len(codes)]
    for start, end in pairwise(bounds):
        part: Codes = np.array(codes[start:end], np.uint8)
        events += watcher.watch(start, part)
    return events


def test_stretch_is_told_when_long_and_when_over() -> None:
    """Three slots without a state are told in the third, with how many misled, and their end in the slot that ends them."""
    assert watch([STATE, LOST, MISLED, LOST, LOST, STATE], [3]) == [
        Event(2, "WARN", "eve took an innovation for the state, for the first time"),
        Event(3, "WARN", "eve lost synchronisation: 3 slots without a state, 1 misled"),
        Event(5, "INFO", "eve regained synchronisation after 4 slots"),
    ]


def test_silence_is_no_loss() -> None:
    """Where nothing was sent in some slots of a stretch, it is told in how many, and no packet is called lost."""
    codes = [STATE, SILENT, LOST, SILENT, STATE]
    assert watch(codes, [2])[0] == Event(
        3, "WARN", "eve lost synchronisation: 3 slots without a state, 2 of them silent"
    )
    assert watch(codes, [2], role="legitimate") == [
        Event(3, "WARN", "eve had no packet for 3 slots, 2 of them silent"),
        Event(4, "INFO", "eve regained synchronisation after 3 slots"),
    ]
    lost = watch([STATE, LOST, LOST, LOST, STATE], [], role="legitimate")
    assert lost[0] == Event(3, "WARN", "eve lost 3 packets in a row")


def test_a_stretch_ends_with_the_first_slot_of_a_piece() -> None:
    """Its end is told, and the next stretch begins from nothing."""
    codes = [STATE, LOST, LOST, LOST, STATE, LOST, LOST, STATE]
    assert (
        watch(codes, [4])
        == watch(codes, [])
        == [
            Event(3, "WARN", "eve lost synchronisation: 3 slots without a state"),
            Event(4, "INFO", "eve regained synchronisation after 3 slots"),
        ]
    )


def test_short_stretches_are_not_told() -> None:
    """One or two missed packets are everyday life."""
    assert watch([LOST, LOST, STATE] * 20, []) == []


@given(st.lists(st.sampled_from([LOST, STATE, 3, SILENT, MISLED]), min_size=1, max_size=80), st.data())
def test_pieces_do_not_matter(codes: list[int], data: st.DataObject) -> None:
    """However a lane is cut, the same events are found."""
    cuts = data.draw(st.lists(st.integers(0, len(codes)), max_size=6))
    assert watch(codes, cuts) == watch(codes, [])


def test_long_run_has_few_lines() -> None:
    """Long stretches over and over become everyday life too: a long run has some hundreds of lines."""
    lengths = np.random.default_rng(1).geometric(0.1, 10_000)
    codes = [code for length in lengths.tolist() for code in (*[LOST] * length, STATE)]
    assert 50 < len(watch(codes, [], len(codes))) < 1000


def watched_acks(fates: list[int], cuts: list[int], scene: Scene) -> list[Event]:
    """The events of acknowledgements, in pieces cut at these slots."""
    watcher, bounds = AckWatcher(scene), [0, *sorted(cuts), len(fates)]
    return [
        event
        for first, stop in pairwise(bounds)
        for event in watcher.watch(first, np.array(fates[first:stop], np.uint8))
    ]


def test_the_first_act_of_each_kind_and_long_waits_are_told() -> None:
    """Blocked acknowledgements are counted in the stretch; a forged one ends it, because the sensor got it."""
    eve = Shown("eve", "eavesdropper", "reference", 0.5)
    scene = Scene("", "r", 20, 1, 2, 0.0, (eve,), 1.0, acknowledgements=AckScene("flip", None))
    nothing, came, _, blocked, forged = (int(fate) for fate in list(AckFate)[:5])
    fates = [came, blocked, nothing, blocked, blocked, forged, came, forged, nothing, nothing, came]
    expected = [
        Event(1, "WARN", "an acknowledgement was blocked, for the first time"),
        Event(3, "WARN", "the sensor got no acknowledgement for 3 slots, 2 by the attack"),
        Event(5, "WARN", "an acknowledgement was forged, for the first time"),
        Event(5, "INFO", "the sensor got an acknowledgement again after 4 slots"),
    ]
    for cuts in ([], [3], [1, 2, 5, 6]):
        assert watched_acks(fates, cuts, scene) == expected


def test_a_long_run_has_few_lines_about_acknowledgements() -> None:
    """Long stretches over and over become everyday life."""
    eve = Shown("eve", "eavesdropper", "reference", 0.5)
    fates = [fate for length in np.random.default_rng(1).geometric(0.1, 10_000).tolist() for fate in (*[2] * length, 1)]
    scene = Scene("", "r", len(fates), 1, 2, 0.0, (eve,), 1.0, acknowledgements=AckScene("none", None))
    assert 50 < len(watched_acks(fates, [], scene)) < 1000
