"""Publications cross a wire whole, or are lost for a reason that the journal states."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest
import zenoh

from evedrop.wire.records import UNLINKED, Kind, WireFate
from tests.conftest import wait_until
from tests.wire.wire_at_work import DEAD, LOSSY, PERFECT, WireAtWork, at_work, both_ways, link, plan_of
from tests.wire.wire_links import key_fates


def reader(session: zenoh.Session, key: str = "**") -> list[zenoh.Sample]:
    """The list into which all samples of a key go."""
    samples: list[zenoh.Sample] = []
    session.declare_subscriber(key, samples.append)
    return samples


def ready(wire: WireAtWork, sender: zenoh.Session, receiver: zenoh.Session) -> None:
    """Return when a message of the one program reaches the other, by a key of its own."""
    come: list[zenoh.Sample] = []
    with receiver.declare_subscriber("ready", come.append):
        wait_until(lambda: sender.put("ready", b"") or come, "a first message crosses")


def everything(sample: zenoh.Sample) -> dict[str, Any]:
    """All that a sample carries, in comparable form."""
    source = sample.source_info
    return {
        "key": str(sample.key_expr),
        "payload": sample.payload.to_bytes(),
        "kind": str(sample.kind),
        "encoding": str(sample.encoding),
        "attachment": None if sample.attachment is None else sample.attachment.to_bytes(),
        "priority": str(sample.priority),
        "congestion control": str(sample.congestion_control),
        "express": sample.express,
        "timestamp": None if sample.timestamp is None else str(sample.timestamp),
        "source": None if source is None else (str(source.source_id.zid), source.source_id.eid, source.source_sn),
    }


@pytest.mark.parametrize("often", [0, 100])
def test_everything_that_a_message_carries_crosses(tmp_path: Path, often: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader at the other side gets exactly what a reader at the same side gets, with publishers and without."""
    monkeypatch.setattr("evedrop.wire.publications.OFTEN", often)
    with (
        at_work(both_ways(), tmp_path) as wire,
        wire.program("robot") as sender,
        wire.program("robot") as near,
        wire.program("base") as far,
    ):
        ready(wire, sender, far)
        ready(wire, sender, near)
        here, there = reader(near, "thing/**"), reader(far, "thing/**")
        wait_until(lambda: sender.put("thing/ready", b"") or (here and there), "both readers hear")
        here.clear()
        there.clear()
        info = zenoh.SourceInfo(sender.id, 41)
        full: dict[str, Any] = {"attachment": b"seen", "timestamp": sender.new_timestamp(), "source_info": info}
        quality: dict[str, Any] = {
            "priority": zenoh.Priority.REAL_TIME,
            "congestion_control": zenoh.CongestionControl.BLOCK,
            "express": True,
        }
        sender.put("thing/plain", b"1")
        sender.put("thing/full", b"2" * 100_000, encoding=zenoh.Encoding("application/cbor;s=1"), **full, **quality)
        sender.delete("thing/full", **full, **quality)
        sender.delete("thing/plain")
        sender.put("thing/*/wild", b"3", congestion_control=zenoh.CongestionControl.BLOCK)
        sender.put("thing/full", b"4", priority=zenoh.Priority.BACKGROUND)
        sender.put("thing/last", b"", priority=zenoh.Priority.BACKGROUND)

        def sorted_by_priority(samples: list[zenoh.Sample]) -> list[dict[str, Any]]:
            return sorted((everything(sample) for sample in samples if "ready" not in str(sample.key_expr)), key=str)

        wait_until(lambda: len(sorted_by_priority(here)) == 7 and len(sorted_by_priority(there)) == 7, "all cross")
        assert sorted_by_priority(there) == sorted_by_priority(here)
        assert [entry["source"] for entry in sorted_by_priority(there)].count(
            (str(sender.zid()), sender.id.eid, 41)
        ) == 2
        assert [entry["timestamp"] for entry in sorted_by_priority(there)].count(None) == 5


def test_the_nth_message_of_a_key_has_the_fate_that_the_seed_gives(tmp_path: Path) -> None:
    """No matter what else flows; deletes are numbered like puts."""
    plan = both_ways(LOSSY)
    with at_work(plan, tmp_path) as wire, wire.program("robot") as sender, wire.program("base") as far:
        ready(wire, sender, far)
        got = reader(far, "scan")
        count = itertools.count()
        wait_until(lambda: sender.put("scan", b"first") or (next(count) >= 0 and got), "the reader hears")
        already = next(count)
        for n in range(already, 200):
            if n % 3:
                sender.put("scan", str(n).encode(), congestion_control=zenoh.CongestionControl.BLOCK)
            else:
                sender.delete("scan", attachment=str(n).encode(), congestion_control=zenoh.CongestionControl.BLOCK)
            sender.put("other", b"", congestion_control=zenoh.CongestionControl.BLOCK)

        def rows() -> Any:
            rows = wire.rows
            return rows[rows["key"] == wire.journal.words.key_code("scan")]

        wait_until(lambda: len(rows()) == 200, "the wire hears all")
        fates = key_fates(plan.links[0], "scan", "put", plan.seed)
        expected = [fates.next()[0] for _ in range(200)]
        assert rows()["n"].tolist() == list(range(200))
        assert rows()["fate"].tolist() == expected
        delivered = [n for n in range(already, 200) if expected[n] == 0]
        wait_until(lambda: len(got) >= len(delivered) + expected[:already].count(0), "all that is delivered")
        numbers = [
            int((sample.attachment or sample.payload).to_string())
            for sample in got
            if sample.payload.to_bytes() != b"first"
        ]
        assert numbers == delivered


def test_a_message_that_no_link_takes_is_recorded_as_unlinked(tmp_path: Path) -> None:
    """It is not lost silently."""
    plan = plan_of(link("robot", "base", keys="scan/**"), link("base", "robot"))
    with at_work(plan, tmp_path) as wire, wire.program("robot") as sender:
        wait_until(lambda: sender.put("pose", b"123") or len(wire.rows), "the wire hears")
        row = wire.rows[0]
        assert (row["fate"], row["link"], row["n"], row["size"]) == (WireFate.UNLINKED, UNLINKED, -1, 3)


def test_the_first_link_that_matches_takes_a_message_and_a_tap_has_losses_of_its_own(tmp_path: Path) -> None:
    """Of three sides, the base gets what the first link lets through, and the listener what its tap does."""
    plan = plan_of(
        link("robot", "base", DEAD, "scan/**", name="scan"),
        link("robot", "base", PERFECT, name="rest"),
        link("robot", "listener", PERFECT, tap=True),
    )
    with (
        at_work(plan, tmp_path) as wire,
        wire.program("robot") as sender,
        wire.program("base") as base,
        wire.program("listener") as listener,
    ):
        ready(wire, sender, base)
        ready(wire, sender, listener)
        at_base, at_listener = reader(base), reader(listener)
        wait_until(lambda: sender.put("ready", b"") or (at_base and at_listener), "both hear")
        sender.put("scan/1", b"x")
        sender.put("pose", b"y")
        wait_until(lambda: "pose" in [str(sample.key_expr) for sample in at_base], "the other link carries it")
        wait_until(lambda: "scan/1" in [str(sample.key_expr) for sample in at_listener], "the tap carries it")
        assert "scan/1" not in [str(sample.key_expr) for sample in at_base]
        assert wire.fates("scan") == [WireFate.LOST]


def test_deletes_puts_and_sizes_are_recorded(tmp_path: Path) -> None:
    """With the sender's own number, where it gives one."""
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as sender:
        wait_until(lambda: sender.put("ready", b"") or len(wire.rows), "the wire hears")
        sender.put("a", b"12345", attachment=b"67", source_info=zenoh.SourceInfo(sender.id, 12))
        sender.delete("a")
        code = wire.journal.words.key_code("a")
        wait_until(
            lambda: len([row for row in wire.rows if row["key"] == code]) >= 2, "the wire hears"
        )  # others may be late
        put, delete = [row for row in wire.rows if row["key"] == code]
        assert (put["kind"], put["size"], put["sequence"], put["n"]) == (Kind.PUT, 7, 12, 0)
        assert put["source"] == wire.journal.words.source_code(f"{sender.zid()}/{sender.id.eid}")
        assert (delete["kind"], delete["size"], delete["sequence"], delete["n"]) == (Kind.DELETE, 0, -1, 1)


@pytest.mark.parametrize(
    ("settings", "fields", "fate"),
    [
        (PERFECT, {"largest": 10}, WireFate.TOO_LARGE),
        ({**PERFECT, "delay": {"model": "constant", "value": 1000.0}}, {"held_messages": 0}, WireFate.HELD_UP),
        ({**PERFECT, "delay": {"model": "constant", "value": 1000.0}}, {"held_bytes": 10}, WireFate.HELD_UP),
        ({**PERFECT, "corrupt": 1.0}, {}, WireFate.CORRUPTED),
    ],
)
def test_why_a_message_does_not_cross(
    tmp_path: Path, settings: dict[str, Any], fields: dict[str, Any], fate: WireFate
) -> None:
    """The journal says so."""
    with at_work(both_ways(settings, **fields), tmp_path) as wire, wire.program("robot") as sender:
        wait_until(lambda: sender.put("a", b"x" * 11) or fate in [*wire.fates(), *wire.amended], "the wire hears")


@pytest.mark.parametrize(("key", "held"), [("a", 2), ("a" * 1500, 1)])
def test_a_message_that_waits_takes_more_room_than_its_payload(tmp_path: Path, key: str, held: int) -> None:
    """Its key, and what the wire keeps for every message: empty messages do not fill the memory."""
    delayed = {**PERFECT, "delay": {"model": "constant", "value": 1000.0}}
    with at_work(both_ways(delayed, held_bytes=3000), tmp_path) as wire, wire.program("robot") as sender:
        for _ in range(4):
            sender.put(key, b"", congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: [*wire.fates(), *wire.amended].count(WireFate.HELD_UP) == 4 - held, "those beyond it")
        assert len(wire.rows) == 4


def test_a_key_that_was_forgotten_goes_on_with_its_next_fate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With room for two keys, three in turns have the fates that each would have alone, with the settings of their link."""
    monkeypatch.setattr("evedrop.wire.publications.READY_KEYS", 2)
    plan = both_ways({"loss": {"model": "gilbert-elliott", "p": 0.2, "r": 0.3}})
    keys = ("a", "b", "c")
    with at_work(plan, tmp_path) as wire, wire.program("robot") as sender:
        for _ in range(40):
            for key in keys:
                sender.put(key, b"", congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: len(wire.rows) == 120, "the wire hears all")
        for key in keys:
            rows = wire.rows_of(key)
            fates = key_fates(plan.links[0], key, "put", plan.seed)
            assert rows["n"].tolist() == list(range(40))
            assert rows["fate"].tolist() == [fates.next()[0] for _ in range(40)]
