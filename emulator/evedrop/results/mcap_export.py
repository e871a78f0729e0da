"""Writes the results of a run as an MCAP file, which Foxglove and other tools for robots read.

Messages are JSON with a schema. The tables are read and written in batches, so that memory does not grow with the run.

Source: docs/export.md, MCAP.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, final

import pyarrow as pa
import pyarrow.compute as pc

from evedrop.errors import UsageError
from evedrop.results.reading import Results
from evedrop.scenario.progress_events import RunEvent
from evedrop.scenario.recorded import recorded
from evedrop.system.files import whole_file

SUFFIX = ".mcap"
_BATCH_ROWS = 4096
_NANOSECONDS = 1_000_000_000
_DEFAULT_PERIOD = 1.0  # seconds per slot, if the scenario gives none
_LATEST = 2**63 - 1  # nanoseconds
_INFO = 2  # of foxglove.Log
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_LOG = {
    "type": "object",
    "title": "foxglove.Log",
    "properties": {
        "timestamp": {**_TIME, "title": "time"},
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer"},
    },
}


def export_mcap(
    results: Results, path: Path, period: float | None = None, batch_rows: int = _BATCH_ROWS
) -> Mapping[str, int]:
    """Write the results of a run to an MCAP file; returns topic → number of messages. The file appears when it is complete.

    period: seconds per slot; None: the scenario's slot_seconds, its pace, or 1 s, whichever comes first. batch_rows: rows of a
    table that are read at once.

    Raises UsageError if the extra is not installed, the tables cannot be read, or the file cannot be written.
    """
    if path.suffix.lower() != SUFFIX:
        raise UsageError(f"{path} is not the name of an MCAP file; give one that ends in {SUFFIX}")
    try:
        from mcap.writer import Writer  # noqa: PLC0415 - an optional extra
    except ImportError as error:
        raise UsageError("an MCAP file needs pip install '.[mcap]' in the checkout first") from error
    scenario = recorded(results.folder).scenario
    with whole_file(path) as temporary, temporary.open("wb") as file:
        writer = Writer(file)
        writer.start(library="evedrop")
        messages = _Messages(writer, period or scenario.slot_seconds or scenario.pace or _DEFAULT_PERIOD)
        title = {"scenario": scenario.title, "seconds_per_slot": f"{messages.period:g}"}
        writer.add_metadata("evedrop", title)
        for event in results.events:
            messages.add_event(event)
        tables = _Tables(results, batch_rows)
        _add_trial(tables, scenario.receivers[0], messages)
        for row in tables.rows("slots"):
            messages.add(f"/statistics/{row.pop('peer')}", "evedrop.Statistics", row)
        for row in tables.rows("journal"):
            del row["delivered_mask"]
            messages.add(f"/packets/{row.pop('link')}", "evedrop.Packets", row)
        writer.finish()
    return messages.counts


def _add_trial(tables: _Tables, first: str, messages: _Messages) -> None:
    """The first recorded trial: truth, estimates and inputs. first: a receiver, whose rows also have the truth."""
    for row in tables.rows("trials", tables.first_trial("trials")):
        del row["trial"]
        sent, x = row.pop("sent"), row.pop("x")
        name = row.pop("peer")
        if name == first:
            messages.add("/truth", "evedrop.Truth", {"slot": row["slot"], "sent": sent, "x": x})
        messages.add(f"/estimates/{name}", "evedrop.Estimate", row)
    for row in tables.rows("inputs", tables.first_trial("inputs")):
        del row["trial"]
        messages.add("/inputs", "evedrop.Inputs", row)


@final
class _Messages:
    """The messages of a file; a topic begins with its first message."""

    def __init__(self, writer: Any, period: float) -> None:
        self.period = period
        self.counts: dict[str, int] = {}
        self._writer = writer
        self._schemas: dict[tuple[str, str], int] = {}
        self._channels: dict[str, int] = {}

    def add(self, topic: str, kind: str, row: Mapping[str, Any]) -> None:
        """A message with the entries of a row, at the time of its slot; entries without a finite value are left out."""
        message = {name: finite for name, value in row.items() if (finite := _finite(value)) is not None}
        self._put(topic, kind, _schema(kind, row), int(row["slot"]), message)

    def add_event(self, event: RunEvent) -> None:
        """An event, as Foxglove's Log panel shows it."""
        sec, nsec = divmod(self._time(event.slot), _NANOSECONDS)
        time = {"sec": sec, "nsec": nsec}
        log = {"timestamp": time, "level": _INFO, "message": event.line, "name": event.by, "file": "", "line": 0}
        self._put("/events", "foxglove.Log", _LOG, event.slot, log)

    def _put(self, topic: str, kind: str, schema: Mapping[str, Any], slot: int, message: Mapping[str, Any]) -> None:
        if topic not in self._channels:
            text = json.dumps(schema, ensure_ascii=False)
            if (kind, text) not in self._schemas:
                self._schemas[kind, text] = self._writer.register_schema(kind, "jsonschema", text.encode())
            self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[kind, text])
            self.counts[topic] = 0
        time, data = self._time(slot), json.dumps(message, ensure_ascii=False, allow_nan=False).encode()
        self._writer.add_message(self._channels[topic], time, data, time, self.counts[topic])
        self.counts[topic] += 1

    def _time(self, slot: int) -> int:
        time = round(slot * self.period * _NANOSECONDS)
        if time > _LATEST:
            raise UsageError(
                f"slot {slot} is {time / _NANOSECONDS:.3g} s after slot 0, too late for MCAP; give a --period"
            )
        return time


def _finite(value: Any) -> Any:
    """The value, or None for a number that JSON does not have; in a list, null is in its place."""
    if isinstance(value, list):
        return [_finite(element) for element in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _schema(kind: str, row: Mapping[str, Any]) -> dict[str, Any]:
    """The JSON schema of messages with the entries of this row."""
    return {"type": "object", "title": kind, "properties": {name: _kind(value) for name, value in row.items()}}


def _kind(value: Any) -> dict[str, Any]:
    match value:
        case bool():
            return {"type": "boolean"}
        case int():
            return {"type": "integer"}
        case str():
            return {"type": "string"}
        case list():
            return {"type": "array", "items": {"type": "number"}}
    return {"type": "number"}


@final
class _Tables:
    """The tables of a run, read some rows at a time."""

    def __init__(self, results: Results, batch_rows: int) -> None:
        self._results, self._batch_rows = results, batch_rows

    def first_trial(self, name: str) -> pc.Expression | None:
        """A filter for the rows of the first recorded trial; None for a table without rows."""
        least = [pc.min(piece["trial"]).as_py() for piece in self._pieces(name, ["trial"]) if piece.num_rows]
        return pc.field("trial") == min(least) if least else None

    def rows(self, name: str, which: pc.Expression | None = None) -> Iterator[dict[str, Any]]:
        """The rows of a table, all or some; none if there is no such table. Raises UsageError if it cannot be read."""
        for piece in self._pieces(name):
            chosen = piece if which is None else piece.filter(which)
            for batch in chosen.to_batches(max_chunksize=self._batch_rows):
                yield from batch.to_pylist()

    def _pieces(self, name: str, columns: list[str] | None = None) -> Iterator[pa.Table]:
        if self._results.has(name):
            yield from self._results.pieces(name, columns, self._batch_rows)
