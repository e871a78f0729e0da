"""A link as a whole, against a slot-by-slot reference that is written here, and against the distributions of its models."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.delays import DELAY_MODELS, ConstantDelay, delay_of
from evedrop.model.links.loss_model import Fate
from evedrop.model.process import Floats
from evedrop.model.slot.link import NEVER, Change, Fates, Link, LinkSchedule, ReceiverOutage, streams_of
from evedrop.model.slot.link_distribution import distribution_of
from evedrop.model.streams import Batch, Stream, normals, root_of_seed, stream_key, uniforms
from tests.examples import examples

ROOT = root_of_seed(77)
PLAIN = {"loss": {"model": "bernoulli", "quality": 0.8}}
BURSTS = {"loss": {"model": "gilbert-elliott", "p": 0.1, "r": 0.3, "good": 0.05, "bad": 0.9}}
FULL = {
    **PLAIN,
    "delay": {"model": "normal", "mean": 2.0, "standard_deviation": 1.5},
    "reorder": 0.1,
    "duplicate": 0.15,
    "corrupt": 0.05,
    "rate": 0.9,
    "queue": 6,
}
SCHEDULES = {
    "plain": LinkSchedule(PLAIN),
    "bursts": LinkSchedule(BURSTS),
    "everything": LinkSchedule(FULL, window=4),
    "changes": LinkSchedule(
        PLAIN, changes=(Change(9, BURSTS), Change(20, cut=True), Change(31, cut=False), Change(40, FULL)), window=3
    ),
    "outages": LinkSchedule(
        FULL, window=4, outages=(ReceiverOutage(10, 17, Fate.DOWN), ReceiverOutage(50, NEVER, Fate.PAUSED))
    ),
    "tied": LinkSchedule(BURSTS, correlation=("other", 0.6)),
}


def link(schedule: LinkSchedule, batch: Batch) -> Link:
    """A link with the streams of a seed."""
    return Link(schedule, "it", {name: stream_key(ROOT, name) for name in streams_of("it", schedule)}, batch)


def drawn(name: str, width: int, batch: Batch) -> np.ndarray:
    """Uniforms of a stream, (slots, width, R)."""
    words = Stream(stream_key(ROOT, name), batch.trial_range, width).words(range(batch.slots))
    return np.ascontiguousarray(uniforms(words).transpose(0, 2, 1))


def whole_of(fates: Fates) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Codes, delays of what is delivered, and second copies: a link without delays is one whose delays are all 0."""
    shape = fates.codes.shape
    delays = np.zeros(shape, int) if fates.delays is None else fates.delays
    again = np.zeros(shape, bool) if fates.again is None else fates.again
    return fates.codes, np.where(fates.codes == Fate.DELIVERED, delays, 0), again


def same(fates: Fates, other: Fates) -> bool:
    """Whether the fates are the same."""
    return all(np.array_equal(a, b) for a, b in zip(whole_of(fates), whole_of(other), strict=True))


@pytest.mark.parametrize("stop", [1, 20, 45])
@pytest.mark.parametrize("name", SCHEDULES)
def test_skipped_slots_are_as_good_as_read(name: str, stop: int) -> None:
    """A link that goes on later has the fates of one that read all slots before."""
    whole, later = (link(SCHEDULES[name], Batch(70, 6, 3)) for _ in range(2))
    whole.fates(range(stop))
    later.skip(stop)
    assert same(later.fates(range(stop, 70)), whole.fates(range(stop, 70)))


@pytest.mark.parametrize("name", SCHEDULES)
def test_a_link_like_another_is_one_of_its_own(name: str) -> None:
    """With other keys it has their fates, whatever becomes of the link that it was made from, and the other way round."""
    schedule, batch = SCHEDULES[name], Batch(70, 6, 3)
    keys = {stream: stream_key(root_of_seed(78), stream) for stream in streams_of("it", schedule)}
    first = link(schedule, batch)
    second = first.like(keys)
    expected = Link(schedule, "it", keys, batch).fates(range(70))
    assert same(first.fates(range(70)), link(schedule, batch).fates(range(70)))
    assert same(second.fates(range(70)), expected)


@pytest.mark.parametrize("name", SCHEDULES)
def test_bits_do_not_depend_on_pieces_or_on_the_batch(name: str) -> None:
    """However slots are asked for, and alone or among others, a trial's packets have the same fates."""
    schedule, batch = SCHEDULES[name], Batch(70, 6, 3)
    whole = link(schedule, batch).fates(range(70))
    channel = link(schedule, batch)
    parts = [channel.fates(range(a, b)) for a, b in ((0, 1), (1, 20), (20, 21), (21, 55), (55, 70))]
    assert np.array_equal(np.concatenate([part.codes for part in parts]), whole.codes)
    alone = link(schedule, Batch(70, 1, 5)).fates(range(70))
    assert same(alone, whole.part(trials=slice(2, 3)))


def reference(schedule: LinkSchedule, batch: Batch) -> tuple[np.ndarray, np.ndarray]:
    """Codes and delays of a link of independent losses, packet by packet from docs/mathematics/links.md, links."""
    codes, delays = np.zeros((batch.slots, batch.trials), int), np.zeros((batch.slots, batch.trials), int)
    losses, chances = drawn("link/it", 1, batch), drawn("fate/it", 3, batch)
    words = Stream(stream_key(ROOT, "delay/it"), batch.trial_range, 1).words(range(batch.slots))
    numbers = normals(words)[:, :, 0]
    setting, cut, free = dict(schedule.settings), False, 0.0
    for k in range(batch.slots):
        for change in schedule.changes:
            if change.at == k:
                setting = dict(change.settings) if change.settings is not None else setting
                cut = cut if change.cut is None else change.cut
        wait, full = 0.0, False
        if "rate" in setting:
            wait = max(0.0, free - k)
            full = wait * setting["rate"] > setting["queue"]
            wait = 0.0 if full else wait
            free = free if full else max(free, k) + 1.0 / setting["rate"]
        for r in range(batch.trials):
            delay = wait
            if "delay" in setting and not chances[k, 1, r] < setting.get("reorder", 0.0):
                delay += max(0.0, setting["delay"]["mean"] + setting["delay"]["standard_deviation"] * numbers[k, r])
            delays[k, r] = arrives = math.floor(delay)
            away = [outage.reason for outage in schedule.outages if k < outage.stop and k + arrives >= outage.start]
            stops = (
                (full, Fate.OVERFLOW),
                (cut, Fate.CUT),
                (losses[k, 0, r] >= setting["loss"]["quality"], Fate.LOST),
                (chances[k, 0, r] < setting.get("corrupt", 0.0), Fate.CORRUPTED),
                (arrives > schedule.window, Fate.LATE),
                (bool(away), away[0] if away else Fate.DOWN),
                (k + arrives >= batch.slots, Fate.UNDERWAY),
            )
            codes[k, r] = next((fate for stopped, fate in stops if stopped), Fate.DELIVERED)
    return codes, delays


@pytest.mark.parametrize(
    "schedule",
    [
        LinkSchedule(PLAIN),
        LinkSchedule(FULL, window=4),
        LinkSchedule(FULL, window=0),
        LinkSchedule(
            FULL, 3, (Change(12, {**FULL, "rate": 0.3, "queue": 2}), Change(30, cut=True), Change(40, cut=False))
        ),
        LinkSchedule(FULL, 4, (), (ReceiverOutage(0, 4, Fate.PAUSED), ReceiverOutage(20, 33, Fate.DOWN))),
        LinkSchedule(PLAIN, 0, (Change(5, {"loss": {"model": "bernoulli", "quality": 0.1}}), Change(6, PLAIN))),
    ],
)
def test_fates_are_those_of_the_reference(schedule: LinkSchedule) -> None:
    """The fate of a packet, in the documented order, from the documented streams."""
    batch = Batch(80, 7, 11)
    fates = link(schedule, batch).fates(range(80))
    codes, delays = reference(schedule, batch)
    assert np.array_equal(fates.codes, codes)
    if fates.delays is not None:
        delivered = codes == Fate.DELIVERED
        assert np.array_equal(fates.delays[delivered], delays[delivered])


def test_two_events_of_the_same_losses_in_turn_are_one() -> None:
    """In the slot in which one ends the other begins: no slot has other losses, so the chain goes on, as in theory."""
    settings_ = {"loss": {"model": "gilbert-elliott", "p": 0.01, "r": 0.02}}
    once = LinkSchedule(PLAIN, changes=(Change(20, settings_),))
    twice = LinkSchedule(PLAIN, changes=(Change(20, settings_), Change(60, PLAIN), Change(60, settings_)))
    batch = Batch(100, 50)
    assert same(link(once, batch).fates(range(100)), link(twice, batch).fates(range(100)))
    distribution = distribution_of(twice)
    assert distribution is not None
    assert [segment.continues for segment in distribution.segments] == [False, False, True]


@settings(deadline=None, max_examples=examples(30))
@given(at=st.integers(1, 59), kind=st.sampled_from(["cut", "loss", "all"]), name=st.sampled_from(sorted(SCHEDULES)))
def test_a_change_known_late_is_one_known_early(at: int, kind: str, name: str) -> None:
    """Amended in the middle of what was planned, a link goes on as one that knew of the change from the start."""
    schedule, batch = SCHEDULES[name], Batch(60, 3)
    change = {"cut": Change(at, cut=True), "loss": Change(at, BURSTS), "all": Change(at, FULL)}[kind]
    earlier = tuple(change for change in schedule.changes if change.at < at)
    knowing = LinkSchedule(
        schedule.settings, schedule.window, (*earlier, change), schedule.outages, schedule.correlation
    )
    expected = link(knowing, batch).fates(range(60))
    channel = link(schedule, batch)
    start = at - at % 7
    before = channel.fates(range(start)) if start else None
    planned = channel.planned(range(start, 60)).part(slice(0, at - start))
    rest = channel.amended(at, [change])
    parts = [part.codes for part in (before, planned, rest) if part is not None]
    assert np.array_equal(np.concatenate(parts), expected.codes)


@pytest.mark.parametrize("name", SCHEDULES)
def test_changes_that_were_applied_are_not_kept(name: str) -> None:
    """A link whose settings change for weeks needs no more memory for it, and has the fates of one that knew all changes."""
    schedule, batch = SCHEDULES[name], Batch(400, 3)
    losses: list[Mapping[str, Any] | None] = [BURSTS, FULL, None]
    made = [
        Change(at, losses[at % 3], [None, True, False][at // 3 % 3]) for at in range(2, 400) if at % 16 not in {3, 4}
    ]
    knowing = LinkSchedule(schedule.settings, schedule.window, tuple(made), schedule.outages, schedule.correlation)
    expected, channel = link(knowing, batch).fates(range(400)), link(schedule, batch)
    fates = channel.planned(range(16))
    codes = []
    for k in range(400):
        if k and k % 16 == 0:
            fates = channel.planned(range(k, k + 16))
        if changes := [change for change in made if change.at == k]:
            fates = channel.amended(k, changes)
            assert len(channel._changes) <= 16
        codes.append(fates.codes[-(16 - k % 16)])
    assert np.array_equal(np.array(codes), expected.codes)


def test_correlation_ties_losses_and_leaves_each_link_alone() -> None:
    """Of links alike the correlation of the losses is the strength, at 1 they are identical, and the rate stays."""
    batch, q = Batch(400, 500), 0.7
    settings_ = {"loss": {"model": "bernoulli", "quality": q}}
    key = {"link/it": stream_key(ROOT, "link/other")}
    other = Link(LinkSchedule(settings_), "it", key, batch).fates(range(400)).in_time
    for strength in (0.0, 0.35, 1.0):
        schedule = LinkSchedule(settings_, correlation=("other", strength))
        in_time = link(schedule, batch).fates(range(400)).in_time
        assert abs(in_time.mean() - q) < 5 * math.sqrt(q * (1 - q) / in_time.size)
        correlation = np.corrcoef(in_time.ravel(), other.ravel())[0, 1]
        assert abs(correlation - strength) < 5 / math.sqrt(in_time.size)
    assert np.array_equal(in_time, other)


SPECS: dict[str, dict[str, Any]] = {
    "constant": {"model": "constant", "value": 1.5},
    "normal": {"model": "normal", "mean": 2.0, "standard_deviation": 1.0},
    "pareto": {"model": "pareto", "least": 0.7, "shape": 1.8},
    "trace": {"model": "trace", "values": [0.5, 2.0, 1.25]},
}


@pytest.mark.parametrize("name", DELAY_MODELS)
def test_delays_have_the_distribution_they_say(name: str) -> None:
    """The fraction of packets that are there after each lag is as the model says, within 5 standard errors."""
    batch = Batch(300, 300)
    schedule = LinkSchedule({"loss": {"model": "bernoulli", "quality": 1.0}, "delay": SPECS[name]}, window=20)
    fates = link(schedule, batch).fates(range(300))
    assert fates.delays is not None
    model = delay_of(SPECS[name])
    for lag in range(8):
        expected, fraction = model.arrived(lag), float((fates.delays <= lag).mean())
        if expected is None:
            assert name == "trace"
            assert fraction == pytest.approx([1 / 3, 2 / 3, 1, 1, 1, 1, 1, 1][lag], abs=1e-9)
        else:
            assert abs(fraction - expected) <= 5 * math.sqrt(expected * (1 - expected) / fates.delays.size) + 1e-12


@pytest.mark.parametrize(
    ("model", "given_", "entries"),
    [
        ("constant", {"value": -1.0}, ["value"]),
        ("normal", {"mean": math.nan, "standard_deviation": "wide"}, ["mean", "standard_deviation"]),
        ("pareto", {"least": 1.0, "shape": 0.0}, ["shape"]),
        ("trace", {"values": []}, ["values"]),
        ("trace", {"values": [1.0, -2.0]}, ["values.1"]),
    ],
)
def test_wrong_delays_are_named(model: str, given_: dict[str, Any], entries: list[str]) -> None:
    """Each wrong parameter, with what was expected."""
    mistakes = DELAY_MODELS[model].mistakes(given_)
    assert [entry for entry, _ in mistakes] == entries
    assert all("expected" in sentence for _, sentence in mistakes)


class Returns(ConstantDelay):
    """A delay model that returns what a test wants."""

    parameters = MappingProxyType[str, Any]({})
    result: ClassVar[Any] = None

    def __init__(self) -> None:
        super().__init__(1.0)

    def delays(self, first: int, numbers: Floats) -> Any:
        """Whatever the test wants."""
        return super().delays(first, numbers) if self.result is None else self.result


@pytest.mark.parametrize(
    ("result", "says"),
    [
        (np.full((4, 3), -5.0), r"delays\(\) gave -5.0; expected slots, 0 or more"),
        (np.array([[1.0, 2.0, np.nan]] * 4), r"delays\(\) gave nan; expected"),
        (np.ones((4, 2)), r"gave float64 of shape \(4, 2\); expected an array of float64, shape \(4, 3\)"),
        (np.ones((4, 3), np.int64), r"gave int64 of shape \(4, 3\); expected"),
        ([1.0], "gave list; expected an array"),
    ],
)
def test_delays_of_a_class_that_is_not_built_in_are_checked(
    result: Any, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As whole slots, what is no number would be a packet that is late for ever."""
    schedule = LinkSchedule({**PLAIN, "delay": {"model": f"{__name__}:Returns"}}, window=2)
    fates = link(schedule, Batch(4, 3)).fates(range(4))
    assert fates.delays is not None
    assert (fates.delays == 1).all()
    monkeypatch.setattr(Returns, "result", result)
    with pytest.raises(ValueError, match=says):
        link(schedule, Batch(4, 3)).fates(range(4))


def test_fates_of_packets_that_are_not_sent() -> None:
    """Silenced in a copy; a packet that is not sent has no second copy either, and all others keep their fates."""
    codes = np.array([[Fate.DELIVERED, Fate.LOST, Fate.DELIVERED]], np.uint8)
    again = np.array([[True, False, True]])
    sent = np.array([True, False, False])
    for delays, in_time in ((None, [True, False, False]), (np.array([[1, 0, 0]], np.uint32), [False, False, False])):
        for copies in (None, again.copy()):
            whole = Fates(codes.copy(), delays, copies)
            silenced = whole.copied()
            silenced.silence(0, sent)
            assert silenced.codes.tolist() == [[Fate.DELIVERED, Fate.UNSENT, Fate.UNSENT]]
            assert silenced.in_time[0].tolist() == in_time
            assert copies is None or (silenced.again is not None and silenced.again.tolist() == [[True, False, False]])
            assert np.array_equal(whole.codes, codes)
            assert copies is None or np.array_equal(copies, again)


def test_an_outage_of_other_slots_loses_nothing() -> None:
    """Before it and after it; all packets of its own slots are lost to it."""
    course = LinkSchedule(
        {"loss": {"model": "bernoulli", "quality": 1.0}}, outages=(ReceiverOutage(10, 12, Fate.DOWN),)
    )
    channel = link(course, Batch(20, 2))
    codes = [channel.fates(slots).codes for slots in (range(10), range(10, 12), range(12, 20))]
    assert [sorted(set(part.ravel().tolist())) for part in codes] == [[Fate.DELIVERED], [Fate.DOWN], [Fate.DELIVERED]]


def test_the_longest_waits_are_not_short_ones() -> None:
    """Waits of more slots than 32 bits can count: only the first packet arrives."""
    channel = link(
        LinkSchedule({"loss": {"model": "bernoulli", "quality": 1.0}, "rate": 1e-12, "queue": 9}), Batch(5, 1)
    )
    with np.errstate(all="raise"):
        fates = channel.fates(range(5))
    assert fates.codes.ravel().tolist() == [Fate.DELIVERED, *[Fate.LATE] * 4]
    assert fates.delays is not None
    assert fates.delays[1:].min() == 2**32 - 1
