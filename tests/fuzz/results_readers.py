"""Readers of what a run or a wire leaves in its folder, and of what a process of a run is told."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from dataclasses import asdict, fields
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from evedrop.errors import EvedropError
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.network.control_file import Control, read_controls
from evedrop.live.protocol.brief import read_brief
from evedrop.results.diff import difference
from evedrop.results.reading import Results
from evedrop.results.resolved_scenario import write_resolved
from evedrop.results.writer import ResultsWriter
from evedrop.scenario.loading import load
from evedrop.scenario.plugins import named_in
from evedrop.scenario.progress_events import silent
from evedrop.score.sums import SlotSums
from evedrop.show.report.wire import wire_failures
from evedrop.show.view.scene_slots import replay
from evedrop.simulate.montecarlo import simulate
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.on_disk import scorekeeper_on_disk
from tests.fuzz.reader import Reader, as_json, as_parquet, lines, raw, tried
from tests.wire.wire_plans import wire_plan

_SLOTS_STREAM = "unfinished/slots-0.arrows"


@cache
def _results() -> dict[str, bytes]:
    """Path → bytes of a results folder, of a short study."""
    with TemporaryDirectory() as name:
        folder = Path(name) / "run"
        scenario = load("eavesdroppers", {"slots": 12, "trials": 3, "record_trials": 2, "expect": []})
        simulate(scenario, folder, silent)
        return _files_in(folder)


@cache
def _cut_short() -> dict[str, bytes]:
    """The same of a run whose recorder was killed after three rounds."""
    with TemporaryDirectory() as name:
        folder = Path(name) / "run"
        folder.mkdir(mode=0o700)
        scenario = load("eavesdroppers", {"slots": 12, "trials": 3, "record_trials": 2, "expect": []})
        write_resolved(folder, scenario)
        with contextlib.suppress(_Killed), ResultsWriter(folder, scenario) as writer:
            for first in range(3):
                for receiver in scenario.receivers:
                    ones = SlotSums(*(np.ones(1) for _ in fields(SlotSums)))
                    writer.slot_rows(first, receiver, ones, np.zeros(1))
                writer.write_rows(f"slot {first + 1}")
            files = _files_in(folder)
            raise _Killed
        return files


class _Killed(Exception):
    """The writer of results ends where it is."""


def _files_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def _results_of(name: str) -> Callable[[], list[bytes]]:
    return lambda: [data for path, data in _results().items() if path.endswith(name)]


def _in_results(
    file: str,
    whole_folder: Callable[[], dict[str, bytes]] = _results,
    look: Callable[[Path], None] | None = None,
) -> Callable[[bytes, Path], None]:
    """Read a results folder of which one file is as given."""

    def read(data: bytes, folder: Path) -> None:
        place = folder / "run"
        place.mkdir(exist_ok=True)
        for path, whole in whole_folder().items():
            (place / path).parent.mkdir(parents=True, exist_ok=True)
            (place / path).write_bytes(data if path == file else whole)
        (look or _look_at)(place)

    return read


def _replayed(place: Path) -> None:
    """As `evedrop view` does of results that have no recording."""
    replay(place, place / "again.rrd")


def _look_at(place: Path) -> None:
    """As view, diff and their likes do, but for the drawing."""
    from evedrop.cli.report import print_results

    results = Results.read(place)
    for table in ("slots", "trials", "journal", "digests", "inputs"):
        tried(partial(getattr, results, table))
    tried(lambda: difference(results, results))
    tried(lambda: print_results(place))


@cache
def _briefs() -> list[bytes]:
    briefs = []
    for name in ("eavesdroppers", "acknowledged", "microgrid", "restart"):
        scenario = load(name, {"slots": 8, "trials": 2, "record_trials": 1, "expect": [], "event": []})
        for brief in briefs_of(
            scenario, endpoints_at("tcp/127.0.0.1:1"), RecorderTask(Path("nowhere"), False)
        ).values():
            briefs.append(json.dumps({**json.loads(brief.text), "run": "r00000000", "password": "p"}).encode())
    return briefs


def _brief(data: bytes, folder: Path) -> None:
    path = folder / "brief.json"
    path.write_bytes(data)
    path.chmod(0o600)
    brief = read_brief(path)
    if not any(named_in(json.loads(brief.text)["part"])):
        brief.expect_usable()


def _control(data: bytes, folder: Path) -> None:
    (folder / "control.json").write_bytes(data)
    read_controls(folder)


def _controls() -> list[bytes]:
    control = Control("r00000000", "tcp/127.0.0.1:1", "operator", "p")
    return [json.dumps(asdict(control)).encode()]


@cache
def _killed_wire() -> dict[str, bytes]:
    """The files of a wire that was killed in its second start, by their paths."""
    with TemporaryDirectory() as name:
        for start in range(2):
            journal = WireJournal(Path(name), wire_plan(), part_rows=8).begin()
            for n in range(8 * start, 8 * start + 12):
                key, source = journal.words.key_code(f"scan/{n % 2}"), journal.words.source_code("gid")
                journal.records.record(1e9 + n, n // 2, n, 0.25, key, source, 64, 0, 0, n % 3)
            journal.change("scan", {"loss": {"model": "bernoulli", "quality": 0.5}}, {("scan/0", "put"): 4})
            if start == 0:
                journal.close()
        files = {str(path.relative_to(name)): path.read_bytes() for path in Path(name).rglob("*") if path.is_file()}
        journal.close()
    return files


def _in_wire(file: str) -> Callable[[bytes, Path], None]:
    """Read the journal with other bytes in one of its files, sum it up, and start the wire again."""

    def look(data: bytes, folder: Path) -> None:
        for path, content in (*_killed_wire().items(), (file, data)):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(content)
        with contextlib.suppress(EvedropError):
            for table in journal_tables(folder):
                table.to_pylist()
        with contextlib.suppress(EvedropError):
            [*wire_failures(scorekeeper_on_disk(folder, wire_plan()).summary())]
        with WireJournal(folder, wire_plan()) as journal:
            journal.history.changes_of("scan", "scan/0", "put")

    return look


OF_RESULTS: dict[str, Reader] = {
    "brief": Reader(_briefs, _brief, (raw, as_json, as_json)),
    "control": Reader(_controls, _control, (raw, as_json)),
    "summary": Reader(_results_of("summary.json"), _in_results("summary.json"), (raw, as_json, as_json)),
    **{
        f"results-{name}": Reader(_results_of(f"{name}.parquet"), _in_results(f"{name}.parquet"), (raw,))
        for name in ("slots", "trials", "digests")
    },
    "view-trials": Reader(
        _results_of("trials.parquet"), _in_results("trials.parquet", look=_replayed), (raw, as_parquet)
    ),
    "view-summary": Reader(_results_of("summary.json"), _in_results("summary.json", look=_replayed), (as_json,)),
    **{
        f"wire-{file.rpartition('.')[2]}": Reader(
            partial(lambda file: [_killed_wire()[f"journal/{file}"]], file), _in_wire(f"journal/{file}"), changes
        )
        for file, changes in (
            ("history.jsonl", (raw, lines)),
            ("001-0001.parquet", (raw, as_parquet)),
            ("unfinished/002-0001.rows", (raw,)),
            ("unfinished/002.words", (raw, lines)),
        )
    },
    "unfinished-rounds": Reader(
        lambda: [_cut_short()["unfinished/rounds"]], _in_results("unfinished/rounds", _cut_short), (raw, lines)
    ),
    "unfinished-slots": Reader(lambda: [_cut_short()[_SLOTS_STREAM]], _in_results(_SLOTS_STREAM, _cut_short), (raw,)),
}
"""Readers of what Evedrop writes."""
