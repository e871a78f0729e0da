"""Readers of scenario and wire files, and of the tables that a scenario names."""

from __future__ import annotations

import gzip
import re
import tomllib
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import pyarrow as pa
import tomli_w

from evedrop.errors import RunError
from evedrop.live.protocol.brief import ProgramPart
from evedrop.live.protocol.state_message import read_state
from evedrop.scenario.estimates import warnings_of
from evedrop.scenario.loading import load, parse, value_of
from evedrop.scenario.plugins import named_in
from evedrop.scenario.recordings.disturbance_file import read_disturbances
from evedrop.scenario.recordings.link_recording import LinkRecording
from evedrop.scenario.recordings.process_fit import fit_process
from evedrop.scenarios import shipped
from evedrop.wire.deliveries import KeyDeliveries, bounds
from evedrop.wire.file import example_wire, key_lines, load_wire, resolved_wire, warnings_of_wire, wire_lines, wire_of
from evedrop.wire.timeline import moments
from tests.fuzz.mutation import words_of
from tests.fuzz.reader import Reader, as_json, as_toml, cells, parquet_of, raw, tried
from tests.wire.wire_links import key_fates

_EXAMPLES = Path(__file__).with_name("examples")
_DOCUMENTS = Path(__file__).parents[2] / "docs"


@cache
def _scenarios() -> list[bytes]:
    """The shipped ones, as they are and short, those of the documents, and ones with a bit of everything."""
    scenarios = [path.read_bytes() for path in sorted(_EXAMPLES.glob("_*.toml"))] * 4
    for path in shipped().values():
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
        tables["slots"] = min(tables["slots"], 40)
        tables.pop("expect", None)
        scenarios.append(tomli_w.dumps(tables).encode())
    for page in sorted(_DOCUMENTS.glob("*.md")):
        blocks = re.findall(r"^```toml\n(.*?)^```$", page.read_text(encoding="utf-8"), re.S | re.M)
        scenarios += [
            block.encode() for block in blocks if "[process]" in block and ":" not in block.partition("[encoding]")[2]
        ]
    return [*scenarios, *(path.read_bytes() for path in shipped().values())]


@cache
def _scenario_words() -> tuple[str, ...]:
    return words_of([tomllib.loads(scenario.decode()) for scenario in _scenarios()])


def read_scenario(data: bytes, folder: Path) -> list[str]:
    """As `evedrop check` does; returns its warnings."""
    if _names_code(data):
        return []
    path = folder / "scenario.toml"
    path.write_bytes(data)
    return warnings_of(load(path))


def read_change(data: bytes, folder: Path) -> None:
    """As --set KEY=VALUE does."""
    key, _, value = data.decode("utf-8", "replace").partition("=")
    if not _names_code(data):
        parse(_scenarios()[0].decode(), "scenario", {key: value_of(value)}, folder=folder)


def _set_examples() -> list[bytes]:
    keys = ("slots=40", "title=x", "legitimate.link.quality=0.5", "eavesdroppers.smart.link={quality = 0.3}",
            "process.A.0.0=1.5", "event.0={at = 3, cut = \"legitimate\"}", "expect=[]", "process.Q=[[1.0]]")  # fmt: skip
    return [key.encode() for key in keys]


def _names_code(data: bytes) -> bool:
    """Whether a text names a class of somebody's own, whose code would be imported."""
    try:
        return any(named_in(tomllib.loads(data.decode())))
    except (ValueError, RecursionError):
        return False


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
        key_fates(link, "robot/scan", "put", plan.seed).next()
        bounds([KeyDeliveries(link.settings, [], [range(10)])], 10)


def _disturbances(data: bytes, folder: Path, name: str = "day.csv") -> None:
    (folder / name).write_bytes(data)
    read_disturbances(folder / name, ("P_solar", "P_load"), ("kW", "kW"), 3, 1.0)


def _states(data: bytes, folder: Path) -> None:
    (folder / "pose.csv").write_bytes(data)
    fit_process(folder / "pose.csv")


def _state_message(entry: ProgramPart, data: bytes, _folder: Path) -> None:
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
            tried(partial(read, column))


def _recordings() -> list[bytes]:
    return [
        parquet_of(pa.table({"received": [1, 1, 0, 1] * 20})),
        parquet_of(pa.table({"received": [True, False] * 9, "delay": [0.5, None] * 9})),
        parquet_of(pa.table({"received": ["1", "0", "x"], "nested": [[1], [], None]})),
    ]


_DAY = b"time [s],P_solar [kW],P_load [kW]\n0,0.5,0.2\n1,0.6,0.2\n2,0.7,1.25\n"
_POSE = ("time,x [m],v\n" + "".join(f"{5 + 0.1 * k:.1f},{k % 7},{0.1 * (k % 5)}\n" for k in range(30))).encode()
_NAMED = ProgramPart("robot/pose", ["x", "y"], [0.0, 1.5], "tcp/127.0.0.1:7447")
_WALK = b"k,received,delay\n0,1,2.5\n1,0,\n2,1,3\n"

OF_SCENARIOS: dict[str, Reader] = {
    "scenario": Reader(_scenarios, read_scenario, (raw, as_toml, as_toml, as_toml), words=_scenario_words),
    "wire": Reader(
        _wires,
        _wire,
        (raw, as_toml, as_toml),
        words=lambda: words_of([tomllib.loads(one.decode()) for one in _wires()]),
    ),
    "change": Reader(_set_examples, read_change, (raw,)),
    "disturbances": Reader(lambda: [_DAY], _disturbances, (raw, cells)),
    "disturbances-gz": Reader(
        lambda: [gzip.compress(_DAY, mtime=0)], lambda data, folder: _disturbances(data, folder, "day.csv.gz"), (raw,)
    ),
    "states": Reader(lambda: [_POSE], _states, (raw, cells)),
    "state-message": Reader(
        lambda: [b'{"x": 0.5, "y": -2.25e3}', b"[1.0, 2.0]"], partial(_state_message, _NAMED), (raw, as_json), status=3
    ),
    "state-bytes": Reader(
        lambda: [bytes(24)], partial(_state_message, replace(_NAMED, offsets=[4, 12])), (raw,), status=3
    ),
    "trace": Reader(lambda: [_WALK, b"1\n0\n1\n"], _trace, (raw, cells)),
    "trace-parquet": Reader(_recordings, lambda data, folder: _trace(data, folder, "walk.parquet"), (raw,)),
}
"""Readers of what a user writes."""
