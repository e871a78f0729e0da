"""What reads bytes that somebody else made: each reader with examples to start from, and how these are changed.

A reader gives anything or raises an EvedropError; it is broken by any other error, and by what takes too long.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import re
import tomllib
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgpack
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tomli_w

from evedrop.errors import EvedropError, RunError
from evedrop.expected.estimates import warnings_of
from evedrop.fitting.process_fit import fit_process
from evedrop.live.launch.briefs import ObserverTask, briefs_of
from evedrop.live.network.control_file import Control, read_controls
from evedrop.live.protocol.brief import read_brief
from evedrop.live.protocol.brief_parts import ProgramEntry
from evedrop.live.protocol.brief_use import expect_usable
from evedrop.live.protocol.state_message import read_state
from evedrop.loading import load, parse, shipped, value_of
from evedrop.memory.montecarlo import simulate
from evedrop.news import silent
from evedrop.plugins import named_in
from evedrop.recordings.disturbance_file import read_disturbances
from evedrop.recordings.link_recording import LinkRecording
from evedrop.results.diff import difference
from evedrop.results.reading import load_results
from evedrop.results.resolved_scenario import write_resolved
from evedrop.results.writer import ResultsWriter
from evedrop.score.sums import SlotSums
from evedrop.view.replay import replay
from evedrop.wire.check import key_lines, warnings_of_wire, wire_lines
from evedrop.wire.fates import KeyFates
from evedrop.wire.file import example_wire, load_wire, resolved_wire, wire_of
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_reader import journal_tables
from evedrop.wire.law import expected
from evedrop.wire.timeline import moments
from tests.fuzz.mutation import Mutator, words_of
from tests.live.network import golden
from tests.wire.wire_plans import wire_plan

Change = Callable[[Mutator, bytes], bytes]
_EXAMPLES = Path(__file__).with_name("examples")
_SLOTS_STREAM = "unfinished/slots-0.arrows"
_DOCUMENTS = Path(__file__).parents[2] / "docs"


@dataclass(frozen=True)
class Reader:
    """One reader of bytes."""

    examples: Callable[[], list[bytes]]
    read: Callable[[bytes, Path], Any]
    """From the bytes, and a folder of its own, to anything."""
    changes: tuple[Change, ...]
    status: int = 2
    """The exit status of what it raises."""
    words: Callable[[], tuple[str, ...]] = tuple

    def changed(self, mutator: Mutator, number: int) -> bytes:
        """An example, changed."""
        examples = self.examples()
        return mutator.random.choice(self.changes)(mutator, examples[number % len(examples)])


def raw(mutator: Mutator, data: bytes) -> bytes:
    """Some of the bytes are others."""
    return mutator.raw(data)


def _as_toml(mutator: Mutator, data: bytes) -> bytes:
    tables = mutator.tree(tomllib.loads(data.decode()))
    try:
        return tomli_w.dumps(tables if isinstance(tables, dict) else {"x": tables}).encode("utf-8", "replace")
    except (TypeError, ValueError, AttributeError):
        return mutator.raw(data)


def _as_json(mutator: Mutator, data: bytes) -> bytes:
    return json.dumps(mutator.tree(json.loads(data))).encode("utf-8", "replace")


def _as_msgpack(mutator: Mutator, data: bytes) -> bytes:
    try:
        packed: bytes = msgpack.packb(mutator.tree(msgpack.unpackb(data, strict_map_key=False)), use_bin_type=True)
        return packed
    except (OverflowError, TypeError, ValueError):
        return mutator.raw(data)


def _cells(mutator: Mutator, data: bytes) -> bytes:
    rows = [line.split(",") for line in data.decode().split("\n")]
    changed = mutator.tree(rows)
    lines = changed if isinstance(changed, list) else [changed]
    texts = [",".join(map(str, row)) if isinstance(row, list) else str(row) for row in lines]
    return "\n".join(texts).encode("utf-8", "replace")


def _as_parquet(mutator: Mutator, data: bytes) -> bytes:
    """A table with some columns of another type, or rows that are not there."""
    table = pq.read_table(io.BytesIO(data))
    rows = mutator.tree(table.to_pylist())
    try:
        return _parquet_of(pa.Table.from_pylist(rows, table.schema if mutator.random.random() < 0.7 else None))
    except (pa.ArrowException, TypeError, AttributeError, OverflowError, ValueError):
        return mutator.raw(data)


def _lines(mutator: Mutator, data: bytes) -> bytes:
    """Lines of JSON, some of them changed."""
    lines = [
        mutator.tree(json.loads(line)) if mutator.random.random() < 0.5 else json.loads(line)
        for line in data.splitlines()
    ]
    return "".join(f"{json.dumps(line)}\n" for line in lines).encode("utf-8", "replace")


# Scenarios


@cache
def _scenarios() -> list[bytes]:
    """The shipped ones, as they are and short, those of the documents, and ones with a bit of everything."""
    found = [path.read_bytes() for path in sorted(_EXAMPLES.glob("_*.toml"))] * 4
    for path in shipped().values():
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
        tables["slots"] = min(tables["slots"], 40)
        tables.pop("expect", None)
        found.append(tomli_w.dumps(tables).encode())
    for page in sorted(_DOCUMENTS.glob("*.md")):
        blocks = re.findall(r"^```toml\n(.*?)^```$", page.read_text(encoding="utf-8"), re.S | re.M)
        found += [
            block.encode() for block in blocks if "[process]" in block and ":" not in block.partition("[encoding]")[2]
        ]
    return [*found, *(path.read_bytes() for path in shipped().values())]


@cache
def _scenario_words() -> tuple[str, ...]:
    return words_of([tomllib.loads(one.decode()) for one in _scenarios()])


def read_scenario(data: bytes, folder: Path) -> None:
    """As `evedrop check` does."""
    if _names_code(data):
        return
    path = folder / "scenario.toml"
    path.write_bytes(data)
    warnings_of(load(path))


def _names_code(data: bytes) -> bool:
    """Whether a text names a class of somebody's own, whose code would be imported."""
    try:
        return any(named_in(tomllib.loads(data.decode())))
    except (ValueError, RecursionError):
        return False


def read_change(data: bytes, folder: Path) -> None:
    """As --set KEY=VALUE does."""
    key, _, value = data.decode("utf-8", "replace").partition("=")
    if not _names_code(data):
        parse(_scenarios()[0].decode(), "scenario", {key: value_of(value)}, folder=folder)


def _set_examples() -> list[bytes]:
    keys = ("slots=40", "title=x", "legitimate.link.quality=0.5", "eavesdroppers.smart.link={quality = 0.3}",
            "process.A.0.0=1.5", "event.0={at = 3, cut = \"legitimate\"}", "expect=[]", "process.Q=[[1.0]]")  # fmt: skip
    return [key.encode() for key in keys]


# Wires


@cache
def _wires() -> list[bytes]:
    """The example, and one with a bit of everything."""
    return [example_wire().encode(), _EXAMPLES.joinpath("wire.toml").read_bytes()]


def _wire(data: bytes, folder: Path) -> None:
    """As `evedrop wire --check` does; what is accepted can be written, read again and carried out."""
    if _names_code(data):
        return
    path = folder / "wire.toml"
    path.write_bytes(data)
    plan = load_wire(path)
    assert wire_of(tomllib.loads(resolved_wire(plan))) == plan
    assert [*wire_lines(plan), *key_lines(plan, ["robot/scan"])]
    assert list(warnings_of_wire(plan)) is not None
    assert moments(plan)
    for link in plan.links:
        KeyFates(link, "robot/scan", "put", plan.seed).next()
        expected(link.settings, [], [range(10)])


# Tables that a scenario names


def _disturbances(data: bytes, folder: Path, name: str = "day.csv") -> None:
    (folder / name).write_bytes(data)
    read_disturbances(folder / name, ("P_solar", "P_load"), ("kW", "kW"), 3, 1.0)


def _states(data: bytes, folder: Path) -> None:
    (folder / "pose.csv").write_bytes(data)
    fit_process(folder / "pose.csv")


def _state_message(entry: ProgramEntry, data: bytes, _folder: Path) -> None:
    try:
        read_state(data, entry)
    except ValueError as error:
        if "expected" not in str(error):  # it was not raised on purpose
            raise
        raise RunError(str(error)) from error


def _trace(data: bytes, folder: Path, name: str = "walk.csv") -> None:
    (folder / name).write_bytes(data)
    recording = LinkRecording(folder / name)
    for column in [None, *recording.columns()[:3]]:
        for read in (recording.outcomes, recording.delays):
            _tried(partial(read, column))


def _tried(act: Callable[[], Any]) -> None:
    """Have an error of ours end one thing that is read, and not those after it."""
    try:
        act()
    except EvedropError:
        return


def _parquet_of(table: pa.Table) -> bytes:
    sink = io.BytesIO()
    pq.write_table(table, sink)
    return sink.getvalue()


def _recordings() -> list[bytes]:
    return [
        _parquet_of(pa.table({"received": [1, 1, 0, 1] * 20})),
        _parquet_of(pa.table({"received": [True, False] * 9, "delay": [0.5, None] * 9})),
        _parquet_of(pa.table({"received": ["1", "0", "x"], "nested": [[1], [], None]})),
    ]


# What a run leaves, and what it is told


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
    """The same of a run whose observer was killed after three rounds."""
    with TemporaryDirectory() as name:
        folder = Path(name) / "run"
        folder.mkdir(mode=0o700)
        scenario = load("eavesdroppers", {"slots": 12, "trials": 3, "record_trials": 2, "expect": []})
        write_resolved(folder, scenario)
        with contextlib.suppress(_Killed), ResultsWriter.of(folder, scenario) as writer:
            for first in range(3):
                for receiver in scenario.receivers:
                    ones = SlotSums(*(np.ones(1) for _ in fields(SlotSums)))
                    writer.slot_rows(first, receiver, ones, np.zeros(1))
                writer.write_rows(f"slot {first + 1}")
            found = _files_in(folder)
            raise _Killed
        return found


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
    from evedrop.cli.closing_report import print_results

    results = load_results(place)
    for table in ("slots", "trials", "journal", "digests", "inputs"):
        _tried(partial(getattr, results, table))
    _tried(lambda: difference(results, results))
    _tried(lambda: print_results(place))


@cache
def _briefs() -> list[bytes]:
    found = []
    for name in ("eavesdroppers", "acknowledged", "microgrid", "restart"):
        scenario = load(name, {"slots": 8, "trials": 2, "record_trials": 1, "expect": [], "event": []})
        for brief in briefs_of(scenario, "tcp/127.0.0.1:1", ObserverTask(Path("nowhere"), False)).values():
            found.append(json.dumps({**json.loads(brief.text), "run": "r00000000", "password": "p"}).encode())
    return found


def _brief(data: bytes, folder: Path) -> None:
    path = folder / "brief.json"
    path.write_bytes(data)
    path.chmod(0o600)
    brief = read_brief(path)
    if not any(named_in(json.loads(brief.text)["part"])):
        expect_usable(brief)


def _control(data: bytes, folder: Path) -> None:
    (folder / "control.json").write_bytes(data)
    read_controls(folder)


def _controls() -> list[bytes]:
    control = Control("r00000000", "tcp/127.0.0.1:1", "operator", "p")
    return [json.dumps(asdict(control)).encode()]


# Messages


def _messages(name: str) -> Callable[[], list[bytes]]:
    return lambda: [golden.parts_of(golden.GOLDEN[name])[2]]


def _message(name: str) -> Callable[[bytes, Path], None]:
    shape, value, _ = golden.parts_of(golden.GOLDEN[name])
    decode = golden.CODECS[name.split(",", maxsplit=1)[0]][1]
    return lambda data, _: _decoded(decode, shape, value, data)


def _decoded(decode: golden.Decode, shape: dict[str, Any], value: dict[str, Any], data: bytes) -> None:
    try:
        decode(shape, value, data)
    except EvedropError:
        raise
    except Exception as error:
        # The test of the golden bytes makes values of what was read, of messages that say what it expects.
        last = traceback.extract_tb(error.__traceback__)[-1]
        if last.filename != golden.__file__:
            raise


def _every_message() -> Iterator[tuple[str, Reader]]:
    for name in golden.MESSAGES:
        title = "message-" + "-".join(name.replace(",", " ").replace("/", " ").split())
        yield title, Reader(_messages(name), _message(name), (raw, _as_msgpack, _as_msgpack), status=3)


MESSAGES: dict[str, Reader] = dict(_every_message())
"""Of every message with golden bytes in docs/protocol.md."""


# The folder of a wire


@cache
def _killed_wire() -> dict[str, bytes]:
    """The files of a wire that was killed in its second start, by their paths."""
    with TemporaryDirectory() as name:
        for start in range(2):
            journal = WireJournal(Path(name), wire_plan(), part_rows=8)
            for n in range(8 * start, 8 * start + 12):
                key, source = journal.key_code(f"scan/{n % 2}"), journal.source_code("gid")
                journal.record(1e9 + n, n // 2, n, 0.25, key, source, 64, 0, 0, n % 3)
            journal.change("scan", {"loss": {"model": "bernoulli", "quality": 0.5}}, {("scan/0", "put"): 4})
            if start == 0:
                journal.close()
        found = {str(path.relative_to(name)): path.read_bytes() for path in Path(name).rglob("*") if path.is_file()}
        journal.close()
    return found


def _in_wire(file: str) -> Callable[[bytes, Path], None]:
    """Read the journal with other bytes in one of its files, and start the wire again."""

    def look(data: bytes, folder: Path) -> None:
        for path, content in (*_killed_wire().items(), (file, data)):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(content)
        with contextlib.suppress(EvedropError):
            for table in journal_tables(folder):
                table.to_pylist()
        with WireJournal(folder, wire_plan()) as journal:
            journal.changes_of("scan", "scan/0", "put")

    return look


_DAY = b"time [s],P_solar [kW],P_load [kW]\n0,0.5,0.2\n1,0.6,0.2\n2,0.7,1.25\n"
_POSE = ("time,x [m],v\n" + "".join(f"{5 + 0.1 * k:.1f},{k % 7},{0.1 * (k % 5)}\n" for k in range(30))).encode()
_NAMED = ProgramEntry("robot/pose", ["x", "y"], [0.0, 1.5], "tcp/127.0.0.1:7447")
_WALK = b"k,received,delay\n0,1,2.5\n1,0,\n2,1,3\n"

FILES: dict[str, Reader] = {
    "scenario": Reader(_scenarios, read_scenario, (raw, _as_toml, _as_toml, _as_toml), words=_scenario_words),
    "wire": Reader(
        _wires,
        _wire,
        (raw, _as_toml, _as_toml),
        words=lambda: words_of([tomllib.loads(one.decode()) for one in _wires()]),
    ),
    "change": Reader(_set_examples, read_change, (raw,)),
    "disturbances": Reader(lambda: [_DAY], _disturbances, (raw, _cells)),
    "disturbances-gz": Reader(
        lambda: [gzip.compress(_DAY, mtime=0)], lambda data, folder: _disturbances(data, folder, "day.csv.gz"), (raw,)
    ),
    "states": Reader(lambda: [_POSE], _states, (raw, _cells)),
    "state-message": Reader(
        lambda: [b'{"x": 0.5, "y": -2.25e3}', b"[1.0, 2.0]"], partial(_state_message, _NAMED), (raw, _as_json), status=3
    ),
    "state-bytes": Reader(
        lambda: [bytes(24)], partial(_state_message, replace(_NAMED, offsets=[4, 12])), (raw,), status=3
    ),
    "trace": Reader(lambda: [_WALK, b"1\n0\n1\n"], _trace, (raw, _cells)),
    "trace-parquet": Reader(_recordings, lambda data, folder: _trace(data, folder, "walk.parquet"), (raw,)),
    "brief": Reader(_briefs, _brief, (raw, _as_json, _as_json)),
    "control": Reader(_controls, _control, (raw, _as_json)),
    "summary": Reader(_results_of("summary.json"), _in_results("summary.json"), (raw, _as_json, _as_json)),
    **{
        f"results-{name}": Reader(_results_of(f"{name}.parquet"), _in_results(f"{name}.parquet"), (raw,))
        for name in ("slots", "trials", "digests")
    },
    "view-trials": Reader(
        _results_of("trials.parquet"), _in_results("trials.parquet", look=_replayed), (raw, _as_parquet)
    ),
    "view-summary": Reader(_results_of("summary.json"), _in_results("summary.json", look=_replayed), (_as_json,)),
    **{
        f"wire-{file.rpartition('.')[2]}": Reader(
            partial(lambda file: [_killed_wire()[f"journal/{file}"]], file), _in_wire(f"journal/{file}"), changes
        )
        for file, changes in (
            ("history.jsonl", (raw, _lines)),
            ("001-0001.parquet", (raw, _as_parquet)),
            ("unfinished/002-0001.rows", (raw,)),
            ("unfinished/002.words", (raw, _lines)),
        )
    },
    "unfinished-rounds": Reader(
        lambda: [_cut_short()["unfinished/rounds"]], _in_results("unfinished/rounds", _cut_short), (raw, _lines)
    ),
    "unfinished-slots": Reader(lambda: [_cut_short()[_SLOTS_STREAM]], _in_results(_SLOTS_STREAM, _cut_short), (raw,)),
}
"""Files that are read by what a user types."""

READERS: dict[str, Reader] = {**FILES, **MESSAGES}
