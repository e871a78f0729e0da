"""A link and the messages of a key: their numbers, and which reason for a loss comes first."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evedrop.system.world import world
from evedrop.wire.journal import WireJournal
from evedrop.wire.records import WireFate
from evedrop.wire.running_link import Decision, RunningLink
from tests.wire.wire_at_work import DEAD, LOSSY, PERFECT, both_ways, link, plan_of
from tests.wire.wire_links import key_fates

LARGEST = 100


@pytest.fixture
def lossy(tmp_path: Path) -> Iterator[RunningLink]:
    """A link that loses 40 %, and queues what comes faster than 1000 bytes a second."""
    plan = both_ways({**LOSSY, "rate": 1000.0, "queue": 50}, largest=LARGEST)
    with WireJournal(tmp_path, plan) as journal:
        yield RunningLink(plan.links[0], plan, journal)


def test_the_reasons_have_an_order(lossy: RunningLink) -> None:
    """Its queue, its size, a loop, a cut, and then the models; whatever it is, the next message has the next number."""
    decide = lossy.lane("put", "scan", lossless=False)
    fates = key_fates(lossy.link, "scan", "put", 7)
    due = [fates.next()[0] for _ in range(100)]
    assert decide(0.0, 40)[:2] == (0, due[0])
    lossy.cut = lossy.looped = True
    assert decide(0.0, LARGEST + 1)[:2] == (1, WireFate.OVERFLOW)
    assert decide(1.0, LARGEST + 1)[:2] == (2, WireFate.TOO_LARGE)
    assert decide(2.0, 1)[:2] == (3, WireFate.LOOPED)
    lossy.looped = False
    assert decide(3.0, 1)[:2] == (4, WireFate.CUT)
    lossy.cut = False
    assert [decide(4.0 + n, 1)[:2] for n in range(95)] == [(5 + n, fate) for n, fate in enumerate(due[5:])]


def test_what_is_lossless_is_not_cut_but_does_not_go_round(lossy: RunningLink) -> None:
    """Nor does a queue hold it up; it is numbered all the same."""
    lossy.change(DEAD)
    decide = lossy.lane("put", "stop", lossless=True)
    lossy.cut = True
    assert [decide(0.0, LARGEST) for _ in range(3)] == [(n, WireFate.DELIVERED, 0.0, False) for n in range(3)]
    assert decide(0.0, LARGEST + 1) == (3, WireFate.TOO_LARGE, 0.0, False)
    lossy.looped = True
    assert decide(0.0, 1) == (4, WireFate.LOOPED, 0.0, False)


SLOW: dict[str, Any] = {
    "loss": {"model": "bernoulli", "quality": 1.0},
    "delay": {"model": "constant", "value": 0.25},
    "duplicate": 1.0,
}
"""A link that holds every message back and delivers it twice."""


def test_a_message_waits_for_those_before_it(tmp_path: Path) -> None:
    """Its delay, then the bytes in the queue and its own at the link's rate; the queue is full beyond its bytes, not at them."""
    plan = both_ways({**SLOW, "rate": 1000.0, "queue": 100}, largest=LARGEST)
    with WireJournal(tmp_path, plan) as journal:
        decide = RunningLink(plan.links[0], plan, journal).lane("put", "scan", lossless=False)
        sent = [
            decide(now, size) for now, size in ((5.0, 50), (5.0, 50), (5.0, 50), (5.05, 50), (9.0, LARGEST), (9.0, 1))
        ]
    assert [decision[:2] for decision in sent] == [
        (0, 0),
        (1, 0),
        (2, WireFate.OVERFLOW),
        (3, 0),
        (4, 0),
        (5, WireFate.OVERFLOW),
    ]
    assert [decision[2] for decision in sent] == pytest.approx([0.3, 0.35, 0.0, 0.35, 0.35, 0.0])
    assert [decision[3] for decision in sent] == [True, True, False, True, True, False]


@pytest.mark.parametrize(("rate", "sent_at"), [(2000.0, 101.0), (500.0, 102.2), (10_000.0, 101.0), (0.0, 101.0)])
def test_what_waits_at_a_change_of_the_rate_passes_at_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate: float, sent_at: float
) -> None:
    """Its bytes fill the queue until then, and no later message overtakes it; without a rate, the queue is never full."""
    now = [100.0]
    monkeypatch.setattr(world(), "monotonic", lambda: now[0])
    plan = both_ways({**PERFECT, "rate": 1000.0, "queue": 1000}, largest=1000)
    with WireJournal(tmp_path, plan) as journal:
        state = RunningLink(plan.links[0], plan, journal)
        decide = state.lane("put", "scan", lossless=False)
        assert decide(now[0], 1000)[:3] == (0, 0, 1.0)
        state.change({**PERFECT, "rate": rate, "queue": 1000})
        assert decide(now[0], 100)[1] == (WireFate.OVERFLOW if rate else 0)
        room_at = 100.0 + 100 / rate if rate else 100.1
        assert decide(room_at - 0.01, 100)[1] == (WireFate.OVERFLOW if rate else 0)
        fate, delay = decide(room_at + 0.001, 100)[1:3]
        assert fate == 0
        assert delay == pytest.approx(max(0.0, sent_at - room_at - 0.001), abs=1e-9)


def test_a_higher_rate_holds_at_once_for_keys_of_which_none_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where a key that waits was forgotten meanwhile, which keeps its order."""
    now = [100.0]
    monkeypatch.setattr(world(), "monotonic", lambda: now[0])
    slow, fast = ({**PERFECT, "rate": rate, "queue": 100_000} for rate in (1e3, 1e6))
    plan = both_ways(slow, largest=100_000)
    with WireJournal(tmp_path, plan) as journal:
        state = RunningLink(plan.links[0], plan, journal)
        scan, pose = (state.lane("put", key, lossless=False) for key in ("scan", "pose"))
        assert scan(now[0], 60_000)[1:3] == (0, 60.0)
        state.change(fast)
        now[0] = 101.0
        assert pose(now[0], 1000)[2] == pytest.approx(0.001)
        state.forget("put", "scan")
        scan = state.lane("put", "scan", lossless=False)
        assert scan(now[0], 1000)[2] == pytest.approx(59.0)


def test_a_higher_rate_after_a_lower_one_makes_room_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The messages that overflowed while the link was slow are the last ones that do."""
    now = [100.0]
    monkeypatch.setattr(world(), "monotonic", lambda: now[0])
    fast, slow = ({**PERFECT, "rate": rate, "queue": 256_000} for rate in (2e6, 1e3))
    plan = both_ways(fast, largest=10_000)
    overflowed = []
    with WireJournal(tmp_path, plan) as journal:
        state = RunningLink(plan.links[0], plan, journal)
        decide = state.lane("put", "scan", lossless=False)
        for n in range(800):
            now[0] = 100.0 + n / 20
            state.change(slow if 200 <= n < 400 else fast)
            if decide(now[0], 6000)[1] == WireFate.OVERFLOW:
                overflowed.append(n)
    assert overflowed
    assert {*overflowed} <= {*range(200, 402)}


def test_what_is_not_delivered_has_no_delay_and_no_copy(tmp_path: Path) -> None:
    """Whatever the reason; and a link without a rate has no queue."""
    plan = both_ways(SLOW, largest=LARGEST)
    with WireJournal(tmp_path, plan) as journal:
        state = RunningLink(plan.links[0], plan, journal)
        decide = state.lane("put", "scan", lossless=False)
        assert [decide(0.0, LARGEST) for _ in range(2)] == [(n, WireFate.DELIVERED, 0.25, True) for n in range(2)]
        assert decide(0.0, LARGEST + 1) == (2, WireFate.TOO_LARGE, 0.0, False)
        state.looped = True
        assert decide(0.0, 1) == (3, WireFate.LOOPED, 0.0, False)
        state.looped, state.cut = False, True
        assert decide(0.0, 1) == (4, WireFate.CUT, 0.0, False)
        state.cut = False
        state.change({**SLOW, **DEAD})
        assert decide(0.0, 1) == (5, WireFate.LOST, 0.0, False)


def test_other_settings_hold_from_the_next_message_on(tmp_path: Path) -> None:
    """Of every key that is in use, for its model and for the rate; the journal has the number of that message."""
    plan = both_ways(SLOW)
    with WireJournal(tmp_path, plan) as journal:
        state = RunningLink(plan.links[0], plan, journal)
        scan, pose = (state.lane("put", key, lossless=False) for key in ("scan", "pose"))
        for _ in range(3):
            scan(0.0, 10)
        slower = {**SLOW, "delay": {"model": "constant", "value": 1.0}, "duplicate": 0.0, "rate": 10.0, "queue": 1000}
        state.change(slower)
        assert [scan(0.0, 10), pose(0.0, 10)] == [(3, 0, 2.0, False), (0, 0, 3.0, False)]
        state.change(SLOW)
        assert scan(0.0, 10) == (4, 0, 1.25, True)  # the message before waits on
        messages = [
            [change.at for change in journal.history.changes_of("robot-base", key, "put")] for key in ("scan", "pose")
        ]
    assert [at[-2:] for at in messages] == [[3, 4], [0, 1]]


def test_a_key_that_comes_after_a_change_has_the_new_settings_alone(lossy: RunningLink) -> None:
    """From its first message on, each time that the settings change; the keys before it had others."""
    some = {WireFate.LOST, WireFate.DELIVERED}
    before = lossy.link.settings
    changes = [(before, some), (DEAD, {WireFate.LOST}), (PERFECT, {WireFate.DELIVERED}), (before, some)]
    for n, (settings, fates) in enumerate(changes):
        lossy.change(settings)
        keys = [f"key/{n}/{at}" for at in range(20)]
        expected = [key_fates(link("robot", "base", settings), key, "put", 7).next()[0] for key in keys]
        assert [lossy.lane("put", key, lossless=False)(float(n), 1)[1] for key in keys] == expected
        assert {*expected} == fates


def test_two_who_ask_for_a_key_share_its_messages(lossy: RunningLink) -> None:
    """They have one sequence of numbers, with one sequence of fates."""
    fates = key_fates(lossy.link, "scan", "put", 7)
    two = [lossy.lane("put", "scan", lossless=False) for _ in range(2)]
    decisions = [two[n % 2](float(n), 1)[:2] for n in range(20)]
    assert decisions == [(n, fates.next()[0]) for n in range(20)]


@pytest.mark.parametrize("lossless", [False, True])
def test_a_key_that_was_forgotten_goes_on(lossy: RunningLink, lossless: bool) -> None:
    """With the next number, and its fate; other keys and kinds have numbers of their own."""
    decide = lossy.lane("put", "scan", lossless)
    before = [decide(float(n), 1) for n in range(50)]
    lossy.forget("put", "scan")
    lossy.change({**LOSSY, "rate": 1000.0, "queue": 60})
    decide = lossy.lane("put", "scan", lossless)
    decisions = before + [decide(float(n), 1) for n in range(50, 100)]
    fates = key_fates(lossy.link, "scan", "put", 7)
    assert [decision[:2] for decision in decisions] == [(n, 0 if lossless else fates.next()[0]) for n in range(100)]
    assert lossy.lane("query", "scan", lossless)(0.0, 1)[0] == 0
    assert lossy.lane("put", "pose", lossless)(0.0, 1)[0] == 0


@pytest.mark.parametrize("lossless_first", [False, True])
def test_histories_of_a_key_share_their_numbers_although_only_some_are_lossless(
    lossy: RunningLink, lossless_first: bool
) -> None:
    """`lossless` may name the history of one publisher of a key: those of the others have the fates of their numbers."""
    lossy.change(LOSSY)
    fates, decisions = key_fates(lossy.link, "map/@adv/pub", "put", 7), []
    for _ in range(2):
        keys = {lossless: f"map/@adv/pub/{lossless}/1/_" for lossless in (lossless_first, not lossless_first)}
        lanes = {lossless: lossy.lane("put", key, lossless) for lossless, key in keys.items()}
        decisions += [lanes[lossless](0.0, 1)[:2] for lossless in [True, False, False] * 20]
        for key in keys.values():
            lossy.forget("put", key)
    due = [fates.next()[0] for _ in range(120)]
    assert decisions == [(n, due[n] if n % 3 else 0) for n in range(120)]


def test_an_ordered_link_delays_a_message_as_long_as_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The losses, and the delays of messages that no earlier one holds up, are those of the same link without an order."""
    now = [100.0]
    monkeypatch.setattr(world(), "monotonic", lambda: now[0])
    settings = {**LOSSY, "delay": {"model": "normal", "mean": 0.05, "standard_deviation": 0.02}}
    plan = plan_of(link("robot", "base", settings, ordered=True), link("base", "robot"))
    fates = key_fates(plan.links[0], "scan", "put", plan.seed)
    with WireJournal(tmp_path, plan) as journal:
        decide, latest = RunningLink(plan.links[0], plan, journal).lane("put", "scan", lossless=False), 0.0
        for n in range(200):
            now[0] = 100.0 + n / 100
            code, delay, _ = fates.next()
            due = max(latest, now[0] + delay)
            at, fate, waits, _ = decide(now[0], 1)
            assert (at, fate) == (n, code)
            assert waits == pytest.approx(due - now[0] if code == 0 else 0.0, abs=1e-9)
            latest = due if code == 0 else latest


def test_an_order_is_kept_until_its_last_message_is_due(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Although the key is forgotten, and used again, meanwhile."""
    now = [100.0]
    monkeypatch.setattr(world(), "monotonic", lambda: now[0])
    plan = plan_of(link("robot", "base", {**PERFECT, "delay": {"model": "constant", "value": 5.0}}, ordered=True))
    with WireJournal(tmp_path, plan) as journal:
        state = RunningLink(plan.links[0], plan, journal)
        state.lane("put", "scan", lossless=False)(now[0], 1)
        order = state.order("put", "scan")
        state.forget("put", "scan")
        assert order is not None
        assert state.order("put", "scan") is order
        state.lane("put", "scan", lossless=False)
        assert state.order("put", "scan") is order
        now[0] += 5.0
        state.forget("put", "scan")
        assert state.order("put", "scan") is None


def test_the_keys_of_a_history_are_numbered_together(lossy: RunningLink) -> None:
    """Whichever session they are of, and although one of them is forgotten; so do a change and the end of all of them."""
    first, second = "map/@adv/pub/aa/1/_", "map/@adv/pub/bb/1/_"
    lossy.change(LOSSY)
    fates = key_fates(lossy.link, "map/@adv/**", "put", 7)
    due = [fates.next()[0] for _ in range(40)]
    decide, other = lossy.lane("put", first, False), lossy.lane("put", second, False)
    decisions = [lane(0.0, 1) for _ in range(10) for lane in (decide, other)]
    lossy.forget("put", first)
    decisions += [other(0.0, 1) for _ in range(10)]
    lossy.forget("put", second)
    decide = lossy.lane("put", first, False)
    decisions += [decide(0.0, 1) for _ in range(10)]
    assert [decision[:2] for decision in decisions] == [*enumerate(due)]


@pytest.mark.parametrize("lossless", [False, True])
def test_a_key_that_only_the_journal_remembers_goes_on(lossy: RunningLink, tmp_path: Path, lossless: bool) -> None:
    """Its numbers need no memory of the link's, also for the settings that it has from its next message on."""
    decide = lossy.lane("put", "scan", lossless)
    journal = lossy._journal
    for n in range(50):
        journal.records.record(1.0, decide(float(n), 1)[0], -1, 0.0, journal.words.key_code("scan"), 0, 1, 0, 0, 0)
    journal.flush()
    lossy.forget("put", "scan")
    assert not lossy._numbers
    lossy.change(DEAD)
    decide = lossy.lane("put", "scan", lossless)
    assert [decide(100.0 + n, 1)[:2] for n in range(50)] == [(50 + n, 0 if lossless else 1) for n in range(50)]
    lossy.change(dict(lossy.link.settings))
    fates = key_fates(lossy.link, "scan", "put", 7)
    due = [fates.next()[0] for _ in range(150)]
    assert [decide(200.0 + n, 1)[1] for n in range(50)] == [0 if lossless else due[100 + n] for n in range(50)]


@pytest.mark.thorough
def test_threads_share_the_messages_of_a_key(tmp_path: Path) -> None:
    """Each number, with its fate, is given once, also while the settings change."""
    delays: dict[str, Any] = {
        "loss": {"model": "bernoulli", "quality": 1.0},
        "delay": {"model": "trace", "values": [n / 8 for n in range(40_000)]},
    }
    plan = both_ways(delays)
    decisions: list[list[Decision]] = [[], [], []]
    before = sys.getswitchinterval()
    with WireJournal(tmp_path, plan) as journal:
        state = RunningLink(plan.links[0], plan, journal)
        decide = state.lane("put", "scan", lossless=False)

        def take(into: list[Decision]) -> None:
            for _ in range(10_000):
                into.append(decide(0.0, 1))

        threads = [threading.Thread(target=take, args=(into,)) for into in decisions]
        sys.setswitchinterval(1e-6)
        try:
            for thread in threads:
                thread.start()
            changes = 0
            while any(thread.is_alive() for thread in threads):
                if (
                    sum(map(len, decisions)) >= 100 * changes
                ):  # as often as they like, changes would leave the threads no turn
                    changes += 1
                    state.change({**delays, "queue": changes})
                time.sleep(0.0)
        finally:
            sys.setswitchinterval(before)
    assert changes > 1
    assert sorted(decision for into in decisions for decision in into) == [(n, 0, n / 8, False) for n in range(30_000)]


def test_settings_that_stay_the_same_are_not_written_again(lossy: RunningLink, tmp_path: Path) -> None:
    """Every event gives every link its settings, and most links have them already."""
    history = tmp_path / "journal" / "history.jsonl"
    before = history.read_bytes()
    lossy.change(dict(lossy.link.settings))
    assert history.read_bytes() == before
    lossy.change(DEAD)
    assert history.read_bytes() != before
