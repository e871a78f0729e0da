"""Messages that come later than they were sent: delays, doubles, queues, what comes late, and the end of a wire."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pytest
import zenoh
from zenoh.ext import CacheConfig, HistoryConfig, MissDetectionConfig, RecoveryConfig
from zenoh.ext import declare_advanced_publisher as advanced_publisher
from zenoh.ext import declare_advanced_subscriber as advanced_subscriber

from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.plan import Side, WireEvent
from evedrop.wire.records import AGAIN, Kind, WireFate
from evedrop.wire.steering import WireConductor
from tests.conftest import wait_until
from tests.wire.test_publications import reader, ready
from tests.wire.wire_at_work import ANYWHERE, LOSSY, PERFECT, at_work, both_ways, is_declared, link, plan_of

READY = link("robot", "base", keys="ready", name="ready")
BLOCK = zenoh.CongestionControl.BLOCK


def slow(seconds: float) -> Mapping[str, Any]:
    """A link that holds everything back."""
    return {**PERFECT, "delay": {"model": "constant", "value": seconds}}


def test_a_delayed_message_comes_later_and_in_order(tmp_path: Path) -> None:
    """Not before its delay is over, whole, and none overtakes another when all have the same delay."""
    plan = plan_of(READY, link("robot", "base", slow(0.2)))
    with at_work(plan, tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        ready(wire, robot, base)
        come: list[float] = []
        got = reader(base, "x")
        base.declare_subscriber("x", lambda _: come.append(time.monotonic()))
        wait_until(lambda: is_declared(wire, "base", "subscriber", "x"), "the reader is known")
        sent = time.monotonic()
        for n in range(20):
            robot.put("x", str(n), attachment=b"a", congestion_control=BLOCK)
        robot.delete("x", congestion_control=BLOCK)
        wait_until(lambda: len(got) == len(come) == 21, "they come")
        assert min(come) - sent >= 0.2
        assert [sample.payload.to_string() for sample in got] == [*(str(n) for n in range(20)), ""]
        assert got[-1].kind == zenoh.SampleKind.DELETE
        assert got[0].attachment is not None
        delayed = wire.rows_of("x")
        assert set(delayed["delay"].tolist()) == {0.2}


def test_messages_of_a_key_leave_a_link_of_limited_rate_in_order(tmp_path: Path) -> None:
    """Although each takes hardly longer on the link than the wire needs to hear it."""
    plan = plan_of(READY, link("robot", "base", {**PERFECT, "rate": 1e6, "queue": 10_000_000}))
    with at_work(plan, tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        ready(wire, robot, base)
        got = reader(base, "x")
        wait_until(lambda: is_declared(wire, "base", "subscriber", "x"), "the reader is known")
        for n in range(3000):
            robot.put("x", f"{n:020}", congestion_control=BLOCK)
        wait_until(lambda: len(got) == 3000, "all come")
        assert [int(sample.payload.to_string()) for sample in got] == [*range(3000)]


def test_messages_of_an_ordered_link_do_not_overtake_each_other(tmp_path: Path) -> None:
    """Although their delays differ by more than the time between them; without `ordered` some do."""
    varying = {**PERFECT, "delay": {"model": "normal", "mean": 0.1, "standard_deviation": 0.05}}
    plan = plan_of(
        READY,
        link("robot", "base", varying, "in/**", name="in", ordered=True),
        link("robot", "base", varying, "out/**", name="out"),
    )
    with at_work(plan, tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        ready(wire, robot, base)
        ordered, free = reader(base, "in/x"), reader(base, "out/x")
        wait_until(lambda: all(is_declared(wire, "base", "subscriber", key) for key in ("in/x", "out/x")), "it reads")
        for n in range(100):
            for key in ("in/x", "out/x"):
                robot.put(key, str(n), congestion_control=BLOCK)
        wait_until(lambda: len(ordered) == len(free) == 100, "all come")
        assert [int(sample.payload.to_string()) for sample in ordered] == [*range(100)]
        assert [int(sample.payload.to_string()) for sample in free] != [*range(100)]


def test_what_is_still_delayed_when_the_wire_ends_is_counted(tmp_path: Path) -> None:
    """As under way, in the journal's files too."""
    with at_work(both_ways(slow(1000.0)), tmp_path) as wire, wire.program("robot") as robot:
        wait_until(lambda: robot.put("x", b"") or len(wire.rows) >= 3, "the wire hears")
    reasons = pa.concat_tables(journal_tables(tmp_path))["reason"].to_pylist()
    assert len(reasons) >= 3
    assert {str(reason).lower() for reason in reasons} == {"underway"}


def test_a_doubled_message_comes_twice(tmp_path: Path) -> None:
    """And its record says so."""
    plan = plan_of(READY, link("robot", "base", {**PERFECT, "duplicate": 1.0}))
    with at_work(plan, tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        ready(wire, robot, base)
        got = reader(base, "x")
        wait_until(lambda: is_declared(wire, "base", "subscriber", "x"), "the reader is known")
        robot.put("x", b"1")
        robot.delete("x")
        wait_until(lambda: len(got) == 4, "four come")
        assert [sample.kind == zenoh.SampleKind.PUT for sample in got] == [True, True, False, False]
        doubled = wire.rows_of("x")
        assert doubled["kind"].tolist() == [Kind.PUT | AGAIN, Kind.DELETE | AGAIN]


def test_a_link_of_limited_rate_queues_messages_and_drops_what_does_not_fit(tmp_path: Path) -> None:
    """A message takes its size divided by the rate; five of a hundred bytes fill a queue of five hundred."""
    plan = plan_of(READY, link("robot", "base", {**PERFECT, "rate": 100.0, "queue": 500}))
    with at_work(plan, tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        ready(wire, robot, base)
        for _ in range(8):
            robot.put("x", b"x" * 100, congestion_control=BLOCK)
        wait_until(lambda: len(wire.rows_of("x")) == 8, "the wire hears")
        rows = wire.rows_of("x")
        assert rows["fate"].tolist() == [WireFate.DELIVERED] * 5 + [WireFate.OVERFLOW] * 3
        assert [round(delay) for delay in rows["delay"].tolist()] == [1, 2, 3, 4, 5, 0, 0, 0]


def test_events_cut_and_part_links_and_change_them_while_the_wire_runs(tmp_path: Path) -> None:
    """But what is lossless passes; an operator's events are like those of the file."""
    plan = both_ways(lossless=("stop/**",), events=(WireEvent(0.0, None, note="go"),))
    messages: list[str] = []
    with (
        at_work(plan, tmp_path) as wire,
        wire.program("robot") as robot,
        wire.program("base") as base,
        WireConductor(plan, wire.relay, messages.append) as conductor,
    ):
        ready(wire, robot, base)
        got = reader(base, "stop/**")
        assert conductor.change({"partition": ["robot", "base"]}) == "partition robot, base"
        wait_until(lambda: robot.put("x", b"") or WireFate.CUT in wire.fates(), "nothing passes")
        wait_until(lambda: robot.put("stop/now", b"") or got, "but what is lossless does")
        conductor.change({"join": ["robot", "base"]})
        count = len(wire.fates())
        wait_until(lambda: robot.put("x", b"") or 0 in wire.fates()[count + 1 :], "it passes again")
        conductor.change({"link": "robot-base", "set": {"quality": 0.0}})
        wait_until(lambda: robot.put("x", b"") or WireFate.LOST in wire.fates(), "the link loses everything")
    assert [line.partition(": ")[2] for line in messages][:3] == ["go", "partition robot, base", "heal robot, base"]


@pytest.mark.parametrize(
    ("key", "of_links", "of_side"),
    [
        ("map", "**", "**"),
        ("map", "**", "map"),
        ("map/1", "**", "map/*"),
        ("map/1", "**", "map/**"),
        ("map/@config/1", "map/@config/**", "**"),
    ],
)
def test_a_late_reader_gets_the_history_of_an_advanced_publisher(
    key: str, of_links: str, of_side: str, tmp_path: Path
) -> None:
    """The cache of the publisher is asked across the wire, whatever hides the key from `**`, or allows it at its side."""
    plan = plan_of(
        link("robot", "base", keys=of_links),
        link("base", "robot", keys=of_links),
        sides={"robot": Side("robot", (ANYWHERE,), keys=(of_side,))},
    )
    with at_work(plan, tmp_path) as wire, wire.program("robot", timestamping={"enabled": True}) as robot:
        publisher = advanced_publisher(robot, key, cache=CacheConfig(max_samples=3), publisher_detection=True)
        for n in range(5):
            publisher.put(str(n))
        wait_until(lambda: len(wire.rows) >= 5, "the wire hears")
        with wire.program("base") as late:
            got: list[str] = []
            subscriber: Any = advanced_subscriber(
                late,
                key,
                lambda sample: got.append(sample.payload.to_string()),
                history=HistoryConfig(detect_late_publishers=True),
            )
            wait_until(lambda: len(got) == 3, "its history comes")
            assert got == ["2", "3", "4"]
            subscriber.undeclare()


def test_an_advanced_reader_recovers_what_a_link_lost(tmp_path: Path) -> None:
    """Some of it: it asks for each missing sample once, on keys with `@adv`, and the replies may be lost too."""
    with at_work(both_ways(LOSSY), tmp_path) as wire, wire.program("robot", timestamping={"enabled": True}) as robot:
        detection = MissDetectionConfig(heartbeat=0.1, sporadic_heartbeat=None)
        recovery = RecoveryConfig(heartbeat=True, periodic_queries=None)
        publisher = advanced_publisher(
            robot, "scan", cache=CacheConfig(max_samples=100), publisher_detection=True, sample_miss_detection=detection
        )
        with wire.program("base") as base:
            got: list[str] = []
            subscriber: Any = advanced_subscriber(
                base, "scan", lambda sample: got.append(sample.payload.to_string()), recovery=recovery
            )
            wait_until(lambda: publisher.put("first") or got, "the reader is known")
            for n in range(30):
                publisher.put(str(n))

            def delivered() -> int:
                rows = wire.rows
                of_scan = (rows["key"] == wire.journal.words.key_code("scan")) & (rows["kind"] == Kind.PUT)
                return int((of_scan & (rows["fate"] == WireFate.DELIVERED)).sum())

            wait_until(lambda: len(wire.rows) >= 30 and len(got) > delivered(), "it gets lost ones too")
            assert WireFate.LOST in wire.fates()
            subscriber.undeclare()


def test_every_row_is_in_the_files_of_the_journal(tmp_path: Path) -> None:
    """Those of both links, with the names of their links."""
    with at_work(both_ways(LOSSY), tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        for n in range(50):
            robot.put("a", str(n), congestion_control=BLOCK)
            base.put("b", str(n), congestion_control=BLOCK)
        wait_until(lambda: len(wire.rows) == 100, "the wire hears")
    table = pa.concat_tables(journal_tables(tmp_path))
    counts = pc.value_counts(table["link"].cast(pa.string())).to_pylist()
    assert sorted(counts, key=lambda row: str(row["values"]), reverse=True) == [
        {"values": "robot-base", "counts": 50},
        {"values": "base-robot", "counts": 50},
    ]
