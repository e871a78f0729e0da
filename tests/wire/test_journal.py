"""The journal of a wire: every record is in it exactly once, whatever happens to the process or the disk."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from evedrop.errors import UsageError
from evedrop.model.slot.link import NEVER
from evedrop.system.files import try_lock
from evedrop.system.world import world
from evedrop.wire import journal_reading
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_place import part_names
from evedrop.wire.journal_reading import journal_tables, unfinished_table
from evedrop.wire.records import (
    AGAIN,
    HELD,
    RECORD,
    STORED,
    UNLINKED,
    JournalPart,
    Kind,
    Records,
    WireFate,
    Words,
    records_in,
    records_of,
    table_of,
)
from evedrop.wire.running_link import RunningLink
from tests.conftest import LIMIT, wait_until
from tests.examples import mostly_long
from tests.wire.wire_plans import wire_plan

LOSSY = {"loss": {"model": "bernoulli", "quality": 0.6}}
BETTER = {"loss": {"model": "bernoulli", "quality": 0.9}}


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """All rows of a wire's journal."""
    rows: list[dict[str, Any]] = pa.concat_tables(journal_tables(folder)).to_pylist()
    return rows


def test_the_lines_of_the_page_read_a_journal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As they stand in docs/wire/results.md: of a wire that has heard nothing yet, and of one that goes on."""
    page = (Path(__file__).parents[2] / "docs" / "wire" / "results.md").read_text(encoding="utf-8")
    (lines,) = (block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "journal_tables" in block)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "robot").mkdir(parents=True)
    for heard in (0, 3):
        with WireJournal(Path("runs/robot"), wire_plan()) as journal:
            for n in range(heard):
                put(journal, n)
            if heard:
                frame = read_as_the_page(lines)
        assert read_as_the_page(lines).num_rows == heard
    assert frame.num_rows == 3


def read_as_the_page(lines: str) -> pa.Table:
    """What the lines of the page call `journal`."""
    names: dict[str, Any] = {}
    exec(lines, names)  # noqa: S102 - the page's own lines
    table: pa.Table = names["journal"]
    return table


def put(
    journal: WireJournal, n: int, fate: WireFate = WireFate.DELIVERED, *, key: str = "scan/1", delay: float = 0.0
) -> int:
    """Record a put on the first link."""
    return int(journal.records.record(1000.0 + n, n, -1, delay, journal.words.key_code(key), 0, 64, 0, Kind.PUT, fate))


def test_every_record_of_many_threads_is_in_parquet_exactly_once(tmp_path: Path) -> None:
    """Over several parts, in the order of their rows, and each was handed to the listeners exactly once."""
    heard: list[Records] = []

    def work(name: str) -> None:
        for n in range(3000):
            put(journal, n, key=name)

    with WireJournal(tmp_path, wire_plan(), part_rows=1000) as journal:
        journal.listeners.append(heard.append)
        threads = [threading.Thread(target=work, args=(f"scan/{index}",)) for index in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    rows = rows_of(tmp_path)
    for index in range(4):
        assert [row["n"] for row in rows if row["key"] == f"scan/{index}"] == list(range(3000))
        assert journal.counts["scan", f"scan/{index}", "put"] == 3000
    blocks = np.concatenate(heard)
    assert [(journal.key_of(key), n) for key, n in zip(blocks["key"], blocks["n"], strict=True)] == [
        (row["key"], row["n"]) for row in rows
    ]
    assert sorted(path.name for path in (tmp_path / "journal").iterdir()) == [
        *(f"001-{part:04d}.parquet" for part in range(1, 13)), "history.jsonl",
    ]  # fmt: skip


@pytest.mark.thorough
def test_the_journal_goes_on_when_a_part_is_made_while_it_looks_at_all_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thread that records makes a part if the journal's own thread has not made one in time."""
    holds = JournalPart.holds

    def looked_at(part: JournalPart) -> bool:
        """While the first full part is looked at, another thread fills parts, unless it must wait for its turn."""
        monkeypatch.setattr(JournalPart, "holds", holds)
        recording.start()
        recording.join(0.2)
        return part.holds

    monkeypatch.setattr(JournalPart, "holds", property(looked_at))
    with WireJournal(tmp_path, wire_plan(), part_rows=2) as journal:
        recording = threading.Thread(target=lambda: [put(journal, n) for n in range(2, 12)])
        for n in range(2):
            put(journal, n)
        wait_until((tmp_path / "journal" / "001-0006.parquet").exists, "the Parquet file of the last full part")
        recording.join()
    assert [row["n"] for row in rows_of(tmp_path)] == list(range(12))


def test_a_row_says_all_that_was_recorded(tmp_path: Path) -> None:
    """Names in place of codes, null where there is nothing, and sizes that do not fit as the largest."""
    with WireJournal(tmp_path, wire_plan()) as journal:
        key, source = journal.words.key_code("scan/ä"), journal.words.source_code("gid")
        journal.records.record(1.5, 3, 2**40, 0.25, key, source, 64, 0, Kind.PUT | AGAIN, WireFate.DELIVERED)
        journal.records.record(2.5, -1, -1, 0.0, key, 0, 2**33, UNLINKED, Kind.QUERY, WireFate.UNLINKED)
        journal.records.record(3.5, 4, -1, 0.0, key, 0, 0, 0, Kind.DELETE, WireFate.LOST)
    first = {"time": 1.5, "link": "scan", "key": "scan/ä", "size": 64, "source": "gid", "sequence": 2**40, "fate": "delivered",
             "reason": None, "delay": 0.25, "n": 3, "kind": "put", "again": True}  # fmt: skip
    second = {"time": 2.5, "link": None, "key": "scan/ä", "size": 2**32 - 1, "source": None, "sequence": None,
              "fate": "dropped", "reason": "unlinked", "delay": 0.0, "n": None, "kind": "query", "again": False}  # fmt: skip
    third = {**first, "time": 3.5, "size": 0, "source": None, "sequence": None, "fate": "lost", "reason": "loss", "delay": 0.0,
             "n": 4, "kind": "delete", "again": False}  # fmt: skip
    assert rows_of(tmp_path) == [first, second, third]
    assert journal.counts == {("scan", "scan/ä", "put"): 5}


def test_records_without_a_history_are_not_written_over(tmp_path: Path) -> None:
    """A history that was removed, or lost the line of a start, knows nothing of the records of that start."""
    with WireJournal(tmp_path, wire_plan()) as journal:
        put(journal, 0)
    before = rows_of(tmp_path)
    (tmp_path / "journal" / "history.jsonl").unlink()
    with pytest.raises(
        UsageError, match="has records of start 1, but its history lacks that start; give another folder"
    ):
        WireJournal(tmp_path, wire_plan()).begin()
    assert rows_of(tmp_path) == before


def test_another_wire_on_the_same_folder_is_refused(tmp_path: Path) -> None:
    """While the first one runs; afterwards it may have the folder, but not with another seed."""
    with WireJournal(tmp_path, wire_plan()) as journal:
        put(journal, 0)
        with pytest.raises(UsageError, match=r"another wire writes to .*; end it, or give another folder"):
            WireJournal(tmp_path, wire_plan())
    with pytest.raises(UsageError, match="had the seed 7, and this one has 8"):
        WireJournal(tmp_path, wire_plan(seed=8))
    with WireJournal(tmp_path, wire_plan()) as journal:
        assert journal.counts == {("scan", "scan/1", "put"): 1}
        put(journal, 1)
    assert [row["n"] for row in rows_of(tmp_path)] == [0, 1]


def test_a_folder_that_is_just_being_read_is_not_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who reads the journal of a killed wire has it locked for an instant: here, until the starting wire has waited once."""
    with WireJournal(tmp_path, wire_plan()) as journal:
        put(journal, 0)
    readers = [os.open(tmp_path / "journal", os.O_RDONLY)]
    assert try_lock(readers[0], shared=True)

    def sleep(_: float) -> None:
        while readers:
            os.close(readers.pop())

    monkeypatch.setattr(world(), "sleep", sleep)
    with WireJournal(tmp_path, wire_plan()) as journal:
        assert journal.counts == {("scan", "scan/1", "put"): 1}
    assert not readers


def test_amended_rows(tmp_path: Path) -> None:
    """Before the listeners had the row, after, and when only it still waits: they add up to what the journal says."""
    tally = dict.fromkeys(WireFate, 0)

    def add(block: Records) -> None:
        for fate in block["fate"]:
            tally[WireFate(fate)] += 1

    def amend(records: Records, fate: WireFate) -> None:
        for record in records:
            assert (record["n"], journal.key_of(record["key"]), record["size"]) == (2, "scan/1", 64)
            tally[WireFate(record["fate"])] -= 1
            tally[fate] += 1

    with WireJournal(tmp_path, wire_plan(), part_rows=4) as journal:
        journal.listeners.append(add)
        journal.amendment_listeners.append(amend)
        held = journal.records.record(1002.0, 2, -1, 0.0, journal.words.key_code("scan/1"), 0, 64, 0, Kind.PUT, HELD)
        for _ in range(7):
            put(journal, 2)
        wait_until((tmp_path / "journal" / "001-0002.parquet").exists, "a Parquet file")
        journal.records.amend(held, WireFate.REFUSED)
        wait_until((tmp_path / "journal" / "001-0001.parquet").exists, "the one before")
        handed, fresh = put(journal, 2), put(journal, 2)
        journal.flush()
        journal.records.amend(handed, WireFate.UNDERWAY)
        journal.records.amend(fresh, WireFate.REFUSED)
        journal.records.amend(put(journal, 2), WireFate.UNDERWAY)
    reasons = [row["reason"] for row in rows_of(tmp_path)]
    assert reasons == ["refused", *[None] * 7, "underway", "refused", "underway"]
    assert {fate: count for fate, count in tally.items() if count} == {
        WireFate.DELIVERED: 7, WireFate.REFUSED: 2, WireFate.UNDERWAY: 2,
    }  # fmt: skip


def test_numbers_go_on_after_a_kill_whatever_the_killed_wire_heard(tmp_path: Path) -> None:
    """Also those of keys that only an earlier start heard, and those of deletes, which are numbered as puts."""
    folder, killed = tmp_path / "wire", tmp_path / "killed"
    with WireJournal(folder, wire_plan()) as journal:
        for n in range(5):
            put(journal, n, key="scan/old")
    with WireJournal(folder, wire_plan()) as journal:
        journal.records.record(1.0, 3, -1, 0.0, journal.words.key_code("scan/new"), 0, 0, 0, Kind.DELETE, WireFate.LOST)
        shutil.copytree(folder, killed)  # as the disk is when the wire is killed now
    with WireJournal(killed, wire_plan()) as journal:
        assert journal.counts == {("scan", "scan/old", "put"): 5, ("scan", "scan/new", "put"): 4}
        assert journal.recovered == 1


def test_parts_are_read_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    """Their order is right even when there are more parts than their names have digits for."""
    with WireJournal(tmp_path, wire_plan()) as journal:
        put(journal, 0)
    made = tmp_path / "journal" / "001-0001.parquet"
    for name in ("001-9999", "001-10000", "002-0001"):
        shutil.copy(made, made.with_name(f"{name}.parquet"))
    assert part_names(tmp_path / "journal") == ["001-0001", "001-9999", "001-10000", "002-0001"]


def test_what_a_killed_wire_had_not_sent_is_underway(tmp_path: Path) -> None:
    """Not what should have been sent by then, and not a message without a delay that waited for its turn."""
    folder, killed = tmp_path / "wire", tmp_path / "killed"
    with WireJournal(folder, wire_plan()) as journal:
        for n, delay in enumerate((3600.0, 3600.0, 0.0, 0.0)):
            code = journal.words.key_code("scan/1")
            row = journal.records.record(time.time(), n, -1, delay, code, 0, 0, 0, Kind.PUT, WireFate.DELIVERED | HELD)
            if n % 2:
                journal.records.sent(row)
        assert [row["reason"] for row in rows_of(folder)] == [None] * 4
        shutil.copytree(folder, killed)
    with WireJournal(killed, wire_plan()):
        pass
    assert [row["reason"] for row in rows_of(killed)] == ["underway", None, "underway", None]


def test_a_file_of_rows_stays_while_one_of_them_was_not_sent(tmp_path: Path) -> None:
    """Its Parquet file would no longer know which; it is made as soon as all are sent, or when the wire ends."""
    with WireJournal(tmp_path, wire_plan(), part_rows=2) as journal:
        rows = []
        for n in range(6):
            fate = WireFate.DELIVERED | HELD if n in (0, 4) else WireFate.DELIVERED
            rows.append(
                journal.records.record(
                    time.time() - 60.0, n, -1, 0.0, journal.words.key_code("a"), 0, 0, 0, Kind.PUT, fate
                )
            )
        made = tmp_path / "journal"
        wait_until((made / "001-0002.parquet").exists, "the file of the rows that are sent")
        assert not (made / "001-0001.parquet").exists()
        journal.records.sent(rows[0])
        wait_until((made / "001-0001.parquet").exists, "the file, after all are sent")
        assert not (made / "001-0003.parquet").exists()
    assert [row["reason"] for row in rows_of(tmp_path)] == [None] * 6


def test_a_listener_that_fails_gets_no_more_records(tmp_path: Path) -> None:
    """And the user is told; the journal and all other listeners go on."""
    told: list[str] = []
    heard: list[Records] = []
    with WireJournal(tmp_path, wire_plan(), tell=told.append) as journal:
        journal.listeners += [lambda block: heard.append(block[10**6]), heard.append]
        put(journal, 0)
        journal.flush()
        put(journal, 1)
    assert [len(block) for block in heard] == [1, 1]
    assert len(told) == 1
    assert "IndexError" in told[0]


def test_a_record_that_is_torn_is_not_read(tmp_path: Path) -> None:
    """At whichever byte the process ended while it wrote the last record."""
    part = JournalPart(tmp_path / "001-0001.rows", 60)
    record = np.zeros(1, RECORD)
    record["time"], record["n"], record["fate"] = 1000.0, 5, WireFate.LOST + STORED
    for size in range(RECORD.itemsize):
        part.buffer[: RECORD.itemsize] = record.tobytes()
        part.buffer[RECORD.itemsize : 2 * RECORD.itemsize] = record.tobytes()[:size] + bytes(RECORD.itemsize - size)
        assert records_in(tmp_path / "001-0001.rows")["n"].tolist() == [5]
    assert part.take()["n"].tolist() == [5]


def test_a_record_whose_beginning_was_lost_is_not_read(tmp_path: Path) -> None:
    """A power cut may leave the page with its end, and zeros in the page before."""
    part = JournalPart(tmp_path / "001-0001.rows", 100)
    record = np.zeros(100, RECORD)
    record["time"], record["n"], record["fate"] = 1000.0, np.arange(100), STORED
    part.buffer[:] = record.tobytes()
    part.buffer[:4096] = bytes(4096)
    assert records_in(tmp_path / "001-0001.rows")["n"].tolist() == [*range(86, 100)]


def test_the_settings_that_each_message_had_are_known_after_a_restart(tmp_path: Path) -> None:
    """Changes by events and the operator, and those of the file between two starts, for old and new keys."""
    first = WireJournal(tmp_path, wire_plan()).begin()
    for n in range(10):
        put(first, n)
    first.change("scan", BETTER, {("scan/1", "put"): 6})
    first.close()
    assert [(change.at, change.settings) for change in first.history.changes_of("scan", "scan/1", "put")] == [
        (0, LOSSY),
        (6, BETTER),
    ]
    assert [(change.at, change.settings) for change in first.history.changes_of("scan", "scan/2", "put")] == [
        (0, BETTER)
    ]
    history = tmp_path / "journal" / "history.jsonl"
    history.write_bytes(history.read_bytes() + b'{"change": "sc')  # torn
    with WireJournal(tmp_path, wire_plan()) as second:
        changes = [(change.at, change.settings) for change in second.history.changes_of("scan", "scan/1", "put")]
        assert changes == [(0, LOSSY), (6, BETTER), (10, LOSSY)]
        assert [change.at for change in second.history.changes_of("scan", "scan/2", "put")] == [0]
    assert [json.loads(line).get("start") for line in history.read_text().splitlines()] == [1, None, None, 2, None]
    history.write_text("nonsense\n")
    with pytest.raises(UsageError, match=r"history.jsonl, line 1, is not the history of a wire; give another folder"):
        WireJournal(tmp_path, wire_plan())


@pytest.mark.parametrize("killed", [False, True])
def test_a_history_goes_on_although_its_session_has_another_id(killed: bool, tmp_path: Path) -> None:
    """After the end of the wire or of its process: messages of `KEY/@adv/…` have one number after another."""
    folder, plan = tmp_path / "wire", wire_plan()
    with WireJournal(folder, plan) as first:
        code = first.words.key_code("scan/1/@adv/pub/aa/1/_")
        for n in range(3):
            first.records.record(time.time(), n, -1, 0.0, code, 0, 8, 0, Kind.QUERY, WireFate.DELIVERED)
        first.change("scan", BETTER, {("scan/1/@adv", "query"): 2})
        if killed:
            shutil.copytree(folder, tmp_path / "killed")
    with WireJournal(tmp_path / "killed" if killed else folder, plan) as second:
        decide = RunningLink(plan.links[0], plan, second).lane("query", "scan/1/@adv/pub/bb/1/_", lossless=False)
        assert decide(time.time(), 8)[0] == 3
        changes = second.history.changes_of("scan", "scan/1/@adv/*/cc/9/**", "query")
        assert [(change.at, change.settings) for change in changes] == [(0, LOSSY), (2, BETTER), (3, LOSSY)]


KILLED = """
import mmap, os, random, signal, sys, time
from pathlib import Path
import numpy as np
import pyarrow as pa
from evedrop.wire.records import HELD, Kind
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_reading import journal_tables
from tests.wire.wire_plans import wire_plan

folder, chance = Path(sys.argv[1]), random.Random(5)
recorded = np.frombuffer(mmap.mmap(-1, 8), np.int64)  # struct.pack_into clears before it writes: a killed process leaves 0


def write(first):
    journal = WireJournal(folder, wire_plan(), part_rows=3000).begin()
    assert journal.counts.get(("scan", "scan/1", "put"), 0) >= first
    n = first = journal.counts.get(("scan", "scan/1", "put"), 0)
    key = journal.words.key_code("scan/1")
    while True:
        journal.records.record(time.time(), n, n, 0.0 if n % 2 else 3600.0, key, 0, 64, 0, Kind.PUT, 0 if n % 2 else HELD)
        n += 1
        recorded[0] = n


total = 0
for turn in range(int(sys.argv[2])):
    child = os.fork()
    if child == 0:
        write(total)
    target = total + chance.choice([1, 7, 2999, 3000, 3001, 10_000])
    while recorded[0] < target:
        assert os.waitpid(child, os.WNOHANG) == (0, 0)
    time.sleep(chance.random() / 50)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    total = int(recorded[0])
    read = sum(table.num_rows for table in journal_tables(folder))
    assert total <= read <= total + 1, (total, read)
    total = read
with WireJournal(folder, wire_plan()) as journal:
    assert journal.counts == {("scan", "scan/1", "put"): total}
rows = pa.concat_tables(journal_tables(folder)).to_pylist()
assert [row["n"] for row in rows] == [row["sequence"] for row in rows] == list(range(total))
assert {row["key"] for row in rows} == {"scan/1"}
assert {(row["n"] % 2, row["reason"]) for row in rows} == {(1, None), (0, "underway")}
assert not list(folder.glob("journal/unfinished")), "the wire that ended left something behind"
print(total)
"""


@pytest.mark.thorough
@pytest.mark.parametrize("times", mostly_long([3, 8], [3]))
def test_a_wire_may_be_killed_at_any_moment(times: int, tmp_path: Path) -> None:
    """Kill -9, so many times in one folder: every recorded row is in the journal once, and the numbers of messages go on.

    A message that was still delayed when its wire was killed is under way, not delivered.
    """
    command = [sys.executable, "-c", KILLED, str(tmp_path), str(times)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 5000


ON_SMALL_DISK = """
import subprocess, sys, time
from pathlib import Path
import pyarrow as pa
from evedrop.wire.records import Kind
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_reading import journal_tables
from tests.wire.wire_plans import wire_plan

def fill(name):
    # Write a file that takes all the room.
    with open(disk / name, "wb", buffering=0) as file:
        try:
            while file.write(bytes(4096)):
                pass
        except OSError:
            pass


disk, room_again = Path(sys.argv[1]), sys.argv[2] == "room again"
if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "none", disk], stderr=subprocess.DEVNULL).returncode:
    sys.exit(77)
(disk / "other").write_bytes(bytes(3_700_000))
told, heard = [], []
with WireJournal(disk / "run", wire_plan(), tell=told.append, part_rows=1000) as journal:
    journal.listeners.append(lambda block: heard.extend(block["n"].tolist()))
    key = journal.words.key_code("scan/1")
    # Otherwise parts in memory may be given up before there is room again, if the machine is busy.
    ticks = []
    journal.records.tend = ticks.append
    while not ticks:
        time.sleep(0.01)
    for n in range(20_000):
        journal.records.record(time.time(), n, -1, 0.0, key, 0, 64, 0, Kind.PUT, 0)
    fill("rest")
    for code in range(3000):
        journal.words.key_code(f"scan/a/long/name/of/a/key/{code}")
    assert [journal.words.key_code("scan/1"), journal.words.key_code("scan/a/long/name/of/a/key/2999")] == [1, 3001]
    journal.flush()
    assert heard == list(range(20_000))
    assert journal.place.incomplete_since is not None and 10_000 < journal.records.missing < 20_000, journal.records.missing
    if room_again:
        (disk / "other").unlink()
assert (journal.records.missing == 0) == room_again, journal.records.missing
rows = [row for table in journal_tables(disk / "run") for row in table.to_pylist()]
assert [row["n"] for row in rows] == list(range(20_000 - journal.records.missing))
assert {row["key"] for row in rows} == {"scan/1"}
print(*told, sep="\\n")
"""


@pytest.mark.thorough
@pytest.mark.parametrize("then", ["full", "room again"])
def test_on_a_full_disk_the_wire_goes_on(then: str, tmp_path: Path) -> None:
    """Listeners get every record; the journal keeps what the disk has room for, and says once since when it is incomplete.

    With room again, the parts that were in memory are written as well.
    """
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        pytest.skip("only root may mount a small disk")
    command = ["unshare", "--mount", sys.executable, "-c", ON_SMALL_DISK, str(tmp_path), then]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    if done.returncode in {1, 77} and "Traceback" not in done.stderr:
        pytest.skip("this machine lets nobody mount")
    assert done.returncode == 0, done.stderr
    incomplete, *last = done.stdout.splitlines()
    assert "the journal is incomplete from" in incomplete
    assert "No space left on device" in incomplete
    assert all("its records stay in" in line for line in last)
    assert len(last) == (then == "full")


@pytest.mark.parametrize("place", ["its records are read", "its parts are listed", "its parts are looked for"])
@pytest.mark.parametrize("happens", ["a new key", "the end", "the next start"])
def test_a_journal_is_read_whole_whatever_its_wire_does_meanwhile(
    place: str, happens: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A new key has its name, and no part is lost or refused."""
    journals = [WireJournal(tmp_path, wire_plan(), part_rows=100).begin()]
    put(journals[0], 0)

    def meanwhile() -> None:
        monkeypatch.undo()
        if happens != "a new key":
            journals[-1].close()
        if happens == "the next start":
            journals.append(WireJournal(tmp_path, wire_plan(), part_rows=100).begin())
        if happens != "the end":
            put(journals[-1], 0, key="scan/2")

    def records(path: Path, killed: bool = False) -> Records:
        if happens == "a new key":
            meanwhile()
            return records_in(path, killed)
        records = records_in(path, killed)
        meanwhile()
        return records

    def names(folder: Path) -> list[str]:
        meanwhile()
        return part_names(folder)

    def look(folder: Path, pattern: str) -> Iterator[Path]:
        paths = [*glob(folder, pattern)]
        meanwhile()
        return iter(paths)

    glob = Path.glob
    if place == "its records are read":
        monkeypatch.setattr(journal_reading, "records_in", records)
    elif place == "its parts are listed":
        monkeypatch.setattr(journal_reading, "part_names", names)
    else:
        monkeypatch.setattr(Path, "glob", look)
    keys = [row["key"] for row in rows_of(tmp_path)]
    assert keys in (["scan/1"], ["scan/1", "scan/2"])
    journals[-1].close()


def records_file(folder: Path, **changes: Any) -> Path:
    """A file of two records of the first start that are not yet in Parquet; changes: columns of the second."""
    records = np.zeros(2, RECORD)
    records["time"], records["n"], records["fate"] = [1000.0, 1001.0], [0, 1], STORED
    for name, value in changes.items():
        records[name][1] = value
    path = folder / "journal" / "unfinished" / "001-0001.rows"
    path.parent.mkdir(parents=True)
    records.tofile(path)
    return path


@pytest.mark.parametrize(
    "changes",
    [
        {"fate": 10 + STORED}, {"kind": max(Kind) + 1}, {"n": NEVER}, {"link": 1}, {"time": np.nan}, {"time": -np.inf},
        {"delay": np.nan}, {"delay": 1e15},
    ],
)  # fmt: skip
def test_a_record_that_no_wire_writes_is_named(changes: dict[str, Any], tmp_path: Path) -> None:
    """With its fate, kind, number, link, time or delay out of range; the same record is read where it is within it."""
    right = {"n": NEVER - 1, "link": UNLINKED, "kind": Kind.REPLY | AGAIN, "fate": WireFate.UNLINKED + STORED}
    assert unfinished_table(records_file(tmp_path / "right", **right), {1: ["scan"]}, killed=False).num_rows == 2
    path = records_file(tmp_path / "wrong", **changes)
    with pytest.raises(UsageError, match="record 1 is not one of this wire"):
        unfinished_table(path, {1: ["scan"]}, killed=False)


def test_a_table_of_records_gives_them_back() -> None:
    """Every kind and fate, and what is null; but not their senders."""
    fates, kinds = [*WireFate], [*Kind, *(kind | AGAIN for kind in Kind)]
    records = np.zeros(len(fates) * len(kinds), RECORD)
    records["fate"], records["kind"] = np.repeat(fates, len(kinds)), np.tile(kinds, len(fates))
    at = np.arange(len(records))
    records["time"], records["delay"], records["size"] = 1000.0 + at, at / 8.0, at * 2**20
    records["n"], records["sequence"] = at - 1, 2 * at - 1
    records["link"], records["key"] = np.where(at % 3 == 2, UNLINKED, at % 3), at % 4
    records["kind"][records["fate"] != WireFate.DELIVERED] &= ~np.uint8(AGAIN)  # which comes to nothing
    words = Words(["scan", "command"], {1: "scan/1", 2: "scan/2", 3: "stop"}, {})
    table = table_of(records, words)
    result = records_of(table, {"scan": 0, "command": 1}, {"scan/1": 1, "scan/2": 2, "stop": 3})
    for name in RECORD.names or ():
        assert np.array_equal(result[name], records[name]), name
    assert table["fate"].to_pylist() == [
        "delivered" if fate is WireFate.DELIVERED else "lost" if fate.emulated else "dropped"
        for fate in map(WireFate, records["fate"])
    ]
