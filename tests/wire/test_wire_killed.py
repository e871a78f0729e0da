"""A wire that has no summary, because it runs or was killed, has a table and a page all the same: from its journal."""

from __future__ import annotations

import csv
import fcntl
import json
import os
import shutil
import socket
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import pyarrow as pa
import pytest

from evedrop.cli.main import main
from evedrop.errors import UsageError
from evedrop.results.wire_summary import WIRE_FILE
from evedrop.show.view.viewer import Viewer
from evedrop.system.files import is_locked
from evedrop.system.world import world
from evedrop.wire import journal as journal_module
from evedrop.wire.file import resolved_wire
from evedrop.wire.history import WireHistory
from evedrop.wire.journal import WireJournal, recover
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.on_disk import summary_of_wire
from evedrop.wire.plan import Side
from evedrop.wire.records import HELD, Kind, WireFate
from evedrop.wire.run import _begin_results, run_wire
from tests.pages import checked
from tests.wire.wire_at_work import LOSSY, both_ways

DELIVERED, LOST, DELAYED = 6, 3, 1


@pytest.fixture
def folders(tmp_path: Path) -> Iterator[dict[str, Path]]:
    """The folders of a wire while it runs, and of one that was killed in its second start."""
    plan, out = both_ways(LOSSY), tmp_path / "running"
    folders_ = {"running": out, "killed": tmp_path / "killed"}
    with WireJournal(out, plan) as journal:
        journal.records.record(
            time.time(), 0, -1, 0.0, journal.words.key_code("scan"), 0, 8, 0, Kind.PUT, WireFate.LOST
        )
    with WireJournal(out, plan) as journal:
        (out / WIRE_FILE).write_text(resolved_wire(plan))
        fates = [WireFate.DELIVERED] * (DELIVERED + DELAYED) + [WireFate.LOST] * LOST
        for n, fate in enumerate(fates):
            delay, held = (1000.0, HELD) if n < DELAYED else (0.0, 0)
            journal.records.record(
                time.time(), 1 + n, -1, delay, journal.words.key_code("scan"), 0, 8, 0, Kind.PUT, fate | held
            )
        shutil.copytree(out, folders_["killed"])
        yield folders_


@pytest.mark.parametrize(
    ("state", "says", "delivered", "dropped"),
    [
        ("running", "the wire still runs", DELIVERED + DELAYED, {}),
        ("killed", "the wire was killed", DELIVERED, {"underway": DELAYED}),
    ],
)
def test_a_wire_without_a_summary_is_summed_up_from_its_journal(
    state: str, says: str, delivered: int, dropped: dict[str, int],
    folders: dict[str, Path], capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Its latest start: a message that was still delayed when the wire was killed did not arrive."""
    folder = folders[state]
    summary = summary_of_wire(folder)
    link = summary.links["robot-base"]
    assert (summary.state, summary.start, summary.heard) == (state, 2, DELIVERED + LOST + DELAYED)
    assert (link.delivered, link.lost_by, link.dropped_by) == (delivered, {"loss": LOST}, dropped)
    assert 0.0 < summary.seconds < 100.0
    assert main(["view", str(folder), "--table"]) == 0
    sentence = f"{says}: these are the metrics that its journal gives so far"
    printed = capfd.readouterr().out
    assert sentence in printed
    assert "robot-base lost 3 by loss" in printed
    exported = folder / "journal.csv"
    assert main(["export", str(folder), str(exported)]) == 0
    with exported.open(encoding="utf-8", newline="") as text:
        rows = [*csv.DictReader(text)]
    assert capfd.readouterr().out == f"{exported}: {len(rows)} messages\n"
    every = pa.concat_tables(journal_tables(folder)).to_pylist()
    latest = Counter(row["reason"] for table in journal_tables(folder, start=2) for row in table.to_pylist())
    assert (latest.pop(None), latest) == (delivered, {"loss": LOST, **dropped})
    assert [(row["key"], int(row["n"]), row["fate"], row["reason"] or None) for row in rows] == [
        (row["key"], row["n"], row["fate"], row["reason"]) for row in every
    ]
    assert [float(row["time"]) for row in rows] == [row["time"] for row in every]
    exported.unlink()
    assert main(["report", str(folder)]) == 0
    assert capfd.readouterr().out == f"{folder / 'report.html'}\n"
    texts = checked(folder).texts
    assert sentence in texts
    assert any(text.startswith(f"{says}; ") for text in texts)
    assert not (folder / "summary.json").exists()


def test_a_wire_without_a_journal_says_so(folders: dict[str, Path], capfd: pytest.CaptureFixture[str]) -> None:
    """Nothing is written."""
    shutil.rmtree(folders["killed"] / "journal")
    assert main(["report", str(folders["killed"])]) == UsageError.exit_status
    assert "is not the folder of a wire: it has no folder journal" in capfd.readouterr().err
    assert not (folders["killed"] / "report.html").exists()


def test_the_summary_of_an_earlier_start_does_not_outlive_it(tmp_path: Path) -> None:
    """While the wire runs again, and if it is then killed, its folder has no summary that is not of this start."""
    plan, out = both_ways(LOSSY), tmp_path / "out"
    assert run_wire(plan, out, seconds=0.01, say=lambda _: None) == 0
    assert json.loads((out / "summary.json").read_text())["state"] == "ended"
    there: list[bool] = []
    assert run_wire(plan, out, seconds=0.01, say=lambda _: there.append((out / "summary.json").exists())) == 0
    assert there[0] is False
    assert there[-1] is True
    assert json.loads((out / "summary.json").read_text())["start"] == 2


@pytest.mark.parametrize("earlier", ["ended", "killed"])
@pytest.mark.parametrize("lacks", ["a port", "a viewer"])
def test_a_start_that_cannot_begin_leaves_the_folder_as_it_was(
    earlier: str, lacks: str, folders: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The report is about the latest start that ran: it has its summary, or was killed as before."""
    plan, out = both_ways(LOSSY), folders["killed"]
    if earlier == "ended":
        out = tmp_path / "ended"
        assert run_wire(plan, out, seconds=0.01, say=lambda _: None) == 0
    (out / "recording.rrd").write_bytes(b"of the start before")
    before = contents(out)

    def start(*_: object) -> NoReturn:
        raise UsageError("no viewer")

    with socket.create_server(("127.0.0.1", 0)) as server:
        if lacks == "a port":
            taken = Side("base", (f"tcp/127.0.0.1:{server.getsockname()[1]}",))
            plan = both_ways(LOSSY, sides={"base": taken})
        else:
            monkeypatch.setattr(Viewer, "start", start)
        with pytest.raises(UsageError, match="side base cannot listen" if lacks == "a port" else "no viewer"):
            run_wire(plan, out, seconds=0.01, say=lambda _: None, view=str(out / "recording.rrd"))
    assert contents(out) == before
    summary = summary_of_wire(out)
    assert (summary.state, summary.start) == (earlier, 1 if earlier == "ended" else 2)
    assert run_wire(both_ways(LOSSY), out, seconds=0.01, say=lambda _: None) == 0
    assert summary_of_wire(out).start == summary.start + 1


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a folder, by their paths."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_wire_that_heard_nothing_has_lasted_until_it_was_last_alive(tmp_path: Path) -> None:
    """It notes that it is alive from its start on, so this is not 0."""
    plan = both_ways(LOSSY)
    with WireJournal(tmp_path, plan):
        (tmp_path / WIRE_FILE).write_text(resolved_wire(plan))
        summary = summary_of_wire(tmp_path)
    assert (summary.heard, summary.state) == (0, "running")
    assert 0.0 < summary.seconds < 100.0


@pytest.mark.parametrize("corrupt", [5, -0.1, "0.1"])
def test_a_history_with_settings_that_no_link_has_is_refused(corrupt: object, folders: dict[str, Path]) -> None:
    """With its file, the link and the entry: otherwise the bounds would be those of no model."""
    history = folders["killed"] / "journal" / "history.jsonl"
    settings = {"loss": {"model": "bernoulli", "quality": 0.5}, "corrupt": corrupt}
    with history.open("a") as file:
        file.write(json.dumps({"change": "robot-base", "time": time.time(), "settings": settings, "since": []}) + "\n")
    with pytest.raises(UsageError, match=r"history\.jsonl has settings of the link robot-base in which corrupt is"):
        summary_of_wire(folders["killed"])


def test_a_wire_does_not_go_on_after_a_delay_that_no_link_has(folders: dict[str, Path]) -> None:
    """With its file, the link and the entry: otherwise the first message on the link would end the wire."""
    history = folders["killed"] / "journal" / "history.jsonl"
    settings = {"loss": {"model": "bernoulli", "quality": 0.5}, "delay": {"model": "constant", "value": -3.0}}
    with history.open("a") as file:
        file.write(json.dumps({"change": "robot-base", "time": time.time(), "settings": settings, "since": []}) + "\n")
    with pytest.raises(UsageError, match=r"history\.jsonl has settings of the link robot-base in which delay\."):
        WireJournal(folders["killed"], both_ways(LOSSY))


def test_a_start_that_is_refused_leaves_a_killed_wire_as_it_was(folders: dict[str, Path]) -> None:
    """A start with another seed ends nothing: the wire was killed before, and it was killed afterwards."""
    killed = folders["killed"]
    history = killed / "journal" / "history.jsonl"
    before = history.read_bytes()
    with pytest.raises(UsageError, match="give the same seed, or another folder"):
        WireJournal(killed, replace(both_ways(LOSSY), seed=99))
    assert history.read_bytes() == before
    assert summary_of_wire(killed).state == "killed"


def test_the_time_of_a_start_does_not_include_the_recovery_before_it(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A long recovery, during which the clock goes on by 1000 s."""
    late = [0.0]
    monotonic = world().monotonic

    def slowly(journal: Path, history: WireHistory) -> int:
        late[0] += 1000.0
        return recover(journal, history)

    monkeypatch.setattr(journal_module, "recover", slowly)
    monkeypatch.setattr(world(), "monotonic", lambda: monotonic() + late[0])
    with WireJournal(folders["killed"], both_ways(LOSSY)) as journal:
        assert late == [1000.0]
        assert 0.0 <= journal.seconds < 500.0


def test_two_readers_at_once_do_not_take_each_other_for_a_wire(folders: dict[str, Path]) -> None:
    """Another reader holds its lock on the folder of the killed wire; the one that runs is in use all the same."""
    reader = os.open(folders["killed"] / "journal", os.O_RDONLY)
    try:
        fcntl.flock(reader, fcntl.LOCK_SH)
        assert not is_locked(folders["killed"] / "journal")
    finally:
        os.close(reader)
    assert is_locked(folders["running"] / "journal")


@pytest.mark.parametrize(
    ("file", "says"),
    [
        ("summary.json", "the summary of an earlier start cannot be removed ("),
        ("wire.toml", "wire.toml cannot be written ("),
    ],
)
def test_a_file_that_cannot_be_replaced_is_named(
    file: str, says: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The wire goes on, and the other file is as it should be."""
    _begin_results(tmp_path, both_ways(LOSSY))
    (tmp_path / "summary.json").write_text("{}")
    (tmp_path / file).unlink()
    (tmp_path / file).mkdir()
    _begin_results(tmp_path, both_ways(LOSSY))
    told = capfd.readouterr().err
    assert says in told
    assert told.count("the wire goes on") == 1
    assert (tmp_path / "wire.toml").is_file() == (file != "wire.toml")
    assert (tmp_path / "summary.json").exists() == (file == "summary.json")


def test_a_key_that_is_none_names_the_journal(folders: dict[str, Path]) -> None:
    """What to remove, in words that are true in Python as well."""
    words = folders["killed"] / "journal" / "unfinished" / "002.words"
    assert b"scan" in words.read_bytes()
    words.write_bytes(words.read_bytes().replace(b"scan", b"//an"))
    with pytest.raises(UsageError, match="is not a key; remove the journal, or give another folder"):
        summary_of_wire(folders["killed"])
