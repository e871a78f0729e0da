"""A wire that is killed and starts again in the same folder loses the messages that it would have lost without that."""

from __future__ import annotations

import itertools
import json
import os
import signal
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import pyarrow as pa
import pytest

from evedrop.live.network.control_file import read_control
from evedrop.live.network.operator import ask
from evedrop.live.protocol.requests import StatusRequest
from evedrop.wire.file import load_wire
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.journal_records import JournalRecords
from evedrop.wire.records import Kind, WireFate
from evedrop.wire.run import _earlier, continuation, run_wire
from tests.conftest import Evedrop, Live, wait_until
from tests.wire.wire_at_work import program
from tests.wire.wire_links import key_fates
from tests.wire.wire_plans import wire_plan

FILE = """
seed = 7
[side.robot]
[side.base]
[[link]]
name = "scan"
from = "robot"
to = "base"
keys = "scan"
quality = 0.6
[[link]]
from = "robot"
to = "base"
"""
COUNT = 500


def started(evedrop: Evedrop, path: Path) -> tuple[Live, Mapping[str, Sequence[str]]]:
    """A wire that has begun, and the endpoints of its sides."""
    wire = evedrop.started("wire", str(path))
    control = wire.folder / "control.json"
    wait_until(lambda: control.exists() or wire.process.poll() is not None, "a wire that can be asked")
    answer = ask(read_control(wire.folder), StatusRequest(), 30.0)
    assert answer is not None
    assert answer.wire is not None
    return wire, answer.wire.sides


def carrying(evedrop: Evedrop, path: Path, numbers: range, arrived: list[int]) -> Live:
    """Start the wire, and put messages with these numbers at one side; those that come to the other side go into `arrived`."""
    wire, sides = started(evedrop, path)
    with program(sides["robot"]) as robot, program(sides["base"]) as base:
        ready: list[bytes] = []
        base.declare_subscriber("ready", lambda sample: ready.append(sample.payload.to_bytes()))
        base.declare_subscriber("scan", lambda sample: arrived.append(int(sample.payload.to_bytes())))
        wait_until(lambda: robot.put("ready", b"") or ready, "a first message crosses")
        for n in numbers:
            robot.put("scan", str(n).encode())
        robot.put("ready", b"last")
        wait_until(lambda: ready[-1] == b"last", "the last message crosses")
    return wire


def test_a_first_start_and_one_without_messages_continue_nothing(tmp_path: Path) -> None:
    """Only a second start says so; the numbers of queries are named as such."""
    first: list[str] = []
    second: list[str] = []
    for lines in (first, second):
        assert run_wire(wire_plan(), tmp_path / "out", seconds=0.01, say=lines.append) == 0
    assert [line for line in first if "continues" in line] == []
    assert "start 2 continues start 1, which numbered no message of these links" in second
    assert continuation(3, {("up", "a", "query"): 7}).startswith(
        "start 3 continues start 2: query 8 of a on the link up is next;"
    )


def test_a_start_with_other_links_continues_only_those_that_are_still_there() -> None:
    """The most messages were on a link that the file no longer has."""
    counts = {("gone", "scan", "put"): 50, ("scan", "scan", "put"): 8}
    journal: Any = SimpleNamespace(recovered=0, history=SimpleNamespace(start=2), counts=counts)
    (line,) = _earlier(journal, wire_plan())
    assert line.startswith("start 2 continues start 1: message 9 of scan on the link scan is next; for")


def test_records_of_a_wire_that_ended_on_a_full_disk_are_not_said_to_be_of_a_killed_one(tmp_path: Path) -> None:
    """The next start makes their Parquet file, and names both ways in which they may have been left."""
    plan, sentences = wire_plan(), list[str]()
    with (
        patch.object(JournalRecords, "write_all", side_effect=OSError(28, "No space left on device")),
        WireJournal(tmp_path / "out", plan, tell=sentences.append) as journal,
    ):
        journal.records.record(1.0, 0, -1, 0.0, journal.words.key_code("scan"), 0, 1, 0, Kind.PUT, WireFate.DELIVERED)
    assert "its records stay in" in sentences[0]
    assert run_wire(plan, tmp_path / "out", seconds=0.01, say=sentences.append) == 0
    sentence = (
        "an earlier start was killed or had a full disk: 1 message of it could be recovered, and the numbers go on"
    )
    assert sentence in sentences


def test_a_wire_that_was_killed_goes_on_with_its_fates(evedrop: Evedrop) -> None:
    """Kill -9 of the command between two starts: what arrives is what one wire would have let through."""
    path = evedrop.folder / "robot.toml"
    path.write_text(FILE)
    arrived: list[int] = []
    wire = carrying(evedrop, path, range(COUNT), arrived)
    os.kill(wire.process.pid, signal.SIGKILL)
    wire.process.communicate()
    (wire.folder / "control.json").unlink()
    wire = carrying(evedrop, path, range(COUNT, 2 * COUNT), arrived)
    os.kill(wire.process.pid, signal.SIGINT)
    done = wire.end()
    assert done.status == 0, done.err
    assert " of it could be recovered, and the numbers go on" in done.out
    sentence = (
        f"start 2 continues start 1: message {COUNT + 1} of scan on the link scan is next, and likewise for 1 more; "
    )
    assert sentence in done.out
    (link, _) = load_wire(path).links
    fates = key_fates(link, "scan", "put", 7)
    assert arrived == [n for n in range(2 * COUNT) if fates.next()[0] == 0]
    summary = json.loads((wire.folder / "summary.json").read_text())
    assert (summary["start"], summary["links"]["scan"]["heard"], summary["unaccounted"]) == (2, COUNT, 0)
    assert summary["journal"]["recovered"] >= COUNT
    assert not (wire.folder / "control.json").exists()


DELAYED = """
[side.robot]
[side.base]
[[link]]
from = "robot"
to = "base"
delay = { model = "normal", mean = "100 ms", standard_deviation = "30 ms" }
"""


@pytest.mark.long
def test_a_killed_wire_calls_delivered_what_it_had_sent(evedrop: Evedrop) -> None:
    """Kill -9 while delayed messages pass: what arrived is delivered, but for one that may have been in its hands."""
    path = evedrop.folder / "robot.toml"
    path.write_text(DELAYED)
    wire, sides = started(evedrop, path)
    arrived: set[int] = set()
    with program(sides["robot"]) as robot, program(sides["base"]) as base:
        base.declare_subscriber("scan", lambda sample: arrived.add(int(sample.payload.to_bytes())))
        numbers = itertools.count()
        wait_until(lambda: robot.put("scan", str(next(numbers)).encode()) or len(arrived) > 200, "many have arrived")
        os.kill(wire.process.pid, signal.SIGKILL)
        wire.process.communicate()
    rows = pa.concat_tables(journal_tables(wire.folder)).to_pylist()
    delivered = {row["n"] for row in rows if row["fate"] == "delivered"}
    assert {row["reason"] for row in rows} == {None, "underway"}
    assert len(arrived - delivered) <= 1
