"""Reads results folders: the summary, and the tables as Arrow, of a run that ended, is in progress, or was killed.

Source: docs/results.md.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar, final

import pyarrow as pa
import pyarrow.parquet as pq

from evedrop.errors import UnknownName, UsageError
from evedrop.model.digest import DIGEST_BYTES
from evedrop.model.streams import MOST_SLOTS
from evedrop.results.crash_proof_tables import (
    TableRound,
    goes_on,
    is_unfinished,
    last_round,
    metrics_path,
    parquet_batches,
    schema_of,
    stream_of,
)
from evedrop.results.summary_file import plain
from evedrop.results.tables import DIGESTS, JOURNAL, NULLABLE, SLOTS, inputs_schema_like, trials_schema_like
from evedrop.scenario.arguments import path_argument
from evedrop.scenario.progress_events import RunEvent
from evedrop.score.summary import Summary
from evedrop.system.files import Unreadable, opened, text_of

if TYPE_CHECKING:
    from pyarrow.compute import Expression  # importing it takes 0.3 s

T = TypeVar("T")


@final
class ByName(dict[str, T]):
    """Entries of results by name. An unknown name raises UnknownName, a KeyError that lists the known ones."""

    def __init__(self, kind: str, entries: Mapping[str, T]) -> None:
        """what: the kind of entry, such as "receiver"."""
        super().__init__(entries)
        self._what = kind

    def __missing__(self, name: object) -> T:
        raise UnknownName(self._what, name, self)


_MOST_BYTES = 2**28
_PIECE_ROWS = 4096
_ROWS_WORTH_THREADS = 100_000


@dataclass(frozen=True)
class Results:
    """A results folder that was read: `summary` as in docs/results.md, the tables as Arrow.

    `typed_summary` is the same summary with types, and raises UsageError if this version does not write such a summary.
    """

    folder: Path
    summary: Mapping[str, Any]

    @classmethod
    def read(cls, folder: str | Path) -> Self:
        """Read a results folder, also one of a run that is in progress or was killed: `ended` in its summary says so.

        Raises UsageError naming the missing or broken file if it is not a results folder.
        """
        path_argument("folder", folder, "the results folder of a run")
        place = Path(folder)
        path = place / "summary.json"
        for study, file in (("sweep", "sweep.json"), ("comparison", "compare.json")):
            if not path.exists() and (place / file).exists():
                raise UsageError(
                    f"{folder} is the folder of a {study}; give the results folder of a run, or: evedrop report {folder}"
                )
        if not path.exists() and (place / "shards").is_dir():
            raise UsageError(
                f"{folder} is of a run in shards that is in progress or was killed; each of its shards is a results folder "
                f"by itself, such as {place / 'shards' / '1'}"
            )
        if not path.exists() and is_unfinished(place):
            try:
                unfinished = _cut_short(place)
            except UsageError:
                if not path.exists():
                    raise
            else:
                if not path.exists():  # or the run has ended meanwhile, and what was found is not all of one moment
                    return cls(place, unfinished)
        return cls(place, _read_summary(path))

    @property
    def typed_summary(self) -> Summary:
        """The summary with types. Raises UsageError if it is not one of this version."""
        try:
            return Summary.read(self.summary)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            path = self.folder / "summary.json"
            why = _one_line(error) if isinstance(error, ValueError) else repr(error)
            raise UsageError(f"{path} is not a run summary of this version ({why}); run the scenario again") from error

    @property
    def remark(self) -> str | None:
        """A remark on a run that did not complete; None for a complete run."""
        ended = str(self.summary.get("ended", "complete")) or "ended in an unknown way"
        return None if ended == "complete" else f"{self.folder}: {ended.splitlines()[0]}"

    @property
    def events(self) -> list[RunEvent]:
        """The events of the run; also of a run of an older version."""
        return [RunEvent(event["slot"], event["event"], event["by"]) for event in self.summary.get("events", ())]

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.parquet"

    @contextmanager
    def _opened(self, name: str) -> Iterator[tuple[pa.Schema, Iterator[pa.RecordBatch]] | None]:
        """The stream of a table while the block runs; None if the table is a Parquet file.

        Raises UsageError for any error on opening it, and for any error in the block, which reads it.
        """
        try:
            with stream_of(self.folder, name) as stream:
                if stream is None:
                    with opened(self._path(name)):  # reading a pipe would block
                        pass
                yield stream
        except Exception as error:  # pyarrow raises many kinds of errors for a damaged file
            raise UsageError(
                f"{self._path(name)} cannot be read ({_one_line(error)}); run the scenario again"
            ) from error

    def _table(self, name: str, schema_like: Callable[[pa.Schema], pa.Schema]) -> pa.Table:
        """A whole table; schema_like: returns the schema that it must have, given its own."""
        path = self._path(name)
        with self._opened(name) as stream:
            if stream is None:
                # By its path: threads of Arrow that read a Python file may abort the interpreter at its end (Python 3.11).
                # Not by `read_table`, which takes four times as long for a small one.
                parquet = pq.ParquetFile(path)
                table = parquet.read(use_threads=parquet.metadata.num_rows > _ROWS_WORTH_THREADS)
            else:
                table = pa.Table.from_batches(stream[1], stream[0])
            columns = table.column_names  # which are read only here, and need not be text
            table.validate(full=True)  # a damaged column of words may name words that are not there
        wanted = schema_like(table.schema)
        if not table.schema.equals(wanted):
            raise UsageError(
                f"{path} is not a table of this version ({_differences(table.schema, wanted)}); run the scenario again"
            )
        empty = [name for name in columns if name not in NULLABLE and table[name].null_count]
        if empty:
            raise UsageError(f"{path} has empty cells in {', '.join(empty)}; run the scenario again")
        return table

    def part(self, name: str, columns: Sequence[str], where: Expression | None = None) -> pa.Table:
        """Some columns of a table, of the rows for which `where` holds; of a finished run, reads only these.

        Raises UsageError if the table cannot be read, or lacks a column.
        """
        with self._opened(name) as stream:
            if stream is None:
                table = pq.read_table(self._path(name), columns=list(columns), filters=where)
            else:
                whole = pa.Table.from_batches(stream[1], stream[0])
                table = (whole if where is None else whole.filter(where)).select(columns)
            table.validate(full=True)
        return table

    def pieces(self, name: str, columns: Sequence[str] | None = None, rows: int = _PIECE_ROWS) -> Iterator[pa.Table]:
        """All or some columns of a table, this many rows of a Parquet file at a time: memory does not grow with the table.

        Raises UsageError if the table cannot be read, or lacks a column.
        """
        with self._opened(name) as stream:
            for batch in parquet_batches(self._path(name), rows, columns) if stream is None else stream[1]:
                piece = pa.Table.from_batches([batch])
                piece = piece if columns is None else piece.select(columns)
                piece.validate(full=True)
                yield piece

    @property
    def slots(self) -> pa.Table:
        """A row per slot and peer: statistics over trials."""
        return self._table("slots", lambda _: SLOTS)

    @property
    def trials(self) -> pa.Table:
        """A row per slot, peer and recorded trial."""
        return self._table("trials", trials_schema_like)

    @property
    def journal(self) -> pa.Table:
        """A row per slot and link."""
        return self._table("journal", lambda _: JOURNAL)

    @property
    def inputs(self) -> pa.Table | None:
        """A row per slot and recorded trial of a closed loop; None without a controller."""
        # Metrics of before the first slot have no controller, although a run that was killed soon after has rows.
        if self.summary.get("controller") is None and not self.has("inputs"):
            return None
        return self._table("inputs", inputs_schema_like)

    def has(self, name: str) -> bool:
        """Whether there is such a table."""
        return schema_of(self.folder, name) is not None or self._path(name).exists()

    @property
    def digests(self) -> pa.Table:
        """A row per peer, trial and block of 256 slots. Raises UsageError for the digests of an older version."""
        return self._table("digests", lambda _: DIGESTS)


def _differences(schema: pa.Schema, wanted: pa.Schema) -> str:
    """How a table's columns differ from those of this version."""
    digest = schema.field("digest").type if "digest" in schema.names else None
    if digest is not None and pa.types.is_fixed_size_binary(digest) and digest.byte_width != DIGEST_BYTES:
        return (
            f"its digests have {digest.byte_width} bytes, and those of this version, which cover other bytes, have "
            f"{DIGEST_BYTES}: they cannot be compared"
        )
    other = [field.name for field in wanted if field not in schema] or schema.names
    return f"it differs in {', '.join(other)}"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


@contextmanager
def results_of_this_version(folder: Path) -> Iterator[None]:
    """Turn an error about entries that no run of this version writes into UsageError: somebody may have changed the folder."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        why = f"{type(error).__name__}: {_one_line(error)}"
        raise UsageError(f"{folder} has results that this version does not write ({why}); run it again") from error


def _read_summary(path: Path) -> dict[str, Any]:
    try:
        summary = json.loads(text_of(path, _MOST_BYTES))
    except Unreadable as error:
        raise UsageError(
            f"{path.parent} is not a results folder ({path.name}: {error}); give the results folder of a run"
        ) from error
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path} is not JSON ({error}); run the scenario again") from error
    parts = {"peers": dict, "secrecy": dict, "links": dict, "slots": int, "trials": int}
    if not isinstance(summary, dict) or any(type(summary.get(name)) is not kind for name, kind in parts.items()):
        raise UsageError(f"{path} is not a run summary; run the scenario again")
    events = summary.get("events", [])
    if not isinstance(events, list) or not all(map(_is_event, events)):
        raise UsageError(f"{path} has invalid events; run the scenario again")
    return summary


def _is_event(event: Any) -> bool:
    return (
        isinstance(event, dict)
        and type(event.get("slot")) is int
        and 0 <= event["slot"] <= MOST_SLOTS
        and all(isinstance(event.get(name), str) for name in ("event", "by"))
    )


def _cut_short(folder: Path) -> dict[str, Any]:
    """The last metrics that were written, as the summary of a results folder that has no summary yet."""
    last = last_round(folder)
    at = last.at
    if not at:
        raise UsageError(
            f"{folder} has nothing yet: its run has just begun, or was killed then; run the scenario again"
        )
    summary = _metrics(folder, last) or _no_metrics(folder)
    ended = (
        f"the run goes on, at {at}"
        if goes_on(folder)
        else f"cut short at {at}, because its run was killed or its disk was full"
    )
    return {**summary, "slots": last.slots, "ended": ended + age_of_metrics(folder)}


def age_of_metrics(folder: Path) -> str:
    """What `ended` of an unfinished results folder adds if its metrics are of an earlier moment than its rows."""
    rows = last_round(folder)
    metrics = _metrics(folder, rows)
    at, slots = ("slot 0", 0) if metrics is None else (metrics["ended"], metrics["slots"])
    return as_of(at, slots < rows.slots) if rows.at and at != rows.at else ""


def _metrics(folder: Path, rows: TableRound) -> dict[str, Any] | None:
    """The last metrics that were written; None without them, or if a power cut has taken rows of theirs."""
    try:
        metrics = _read_summary(metrics_path(folder))
    except UsageError:
        return None
    return metrics if metrics["slots"] <= rows.slots else None


METRICS_AS_OF = " (the metrics are as of "
"""What `ended` has if metrics are of an earlier moment than the rows."""


def as_of(moment: str, more: bool = True) -> str:
    """What `ended` adds if metrics are of an earlier moment. more: whether the tables have slots that the metrics lack."""
    return f"{METRICS_AS_OF}{moment}{'; the tables have more' if more else ''})"


def _no_metrics(folder: Path) -> dict[str, Any]:
    """The summary of a run that was killed before it wrote one. Raises UsageError if its scenario cannot be read."""
    # Only this case needs theory and the scenario to read results.
    from evedrop.scenario.recorded import recorded  # noqa: PLC0415
    from evedrop.score.run_tally import RunTally  # noqa: PLC0415
    from evedrop.score.scorekeeper import RunOutcome, summary_of  # noqa: PLC0415

    recording = recorded(folder)
    if not recording.complete:
        raise UsageError(
            f"{folder} has no metrics yet, and theory needs its classes, which are not built in; looking at results imports "
            "none: look again when the run has metrics, or run the scenario again"
        )
    scenario = recording.scenario
    nothing = RunTally.nothing(scenario, scenario.trials)
    summary: dict[str, Any] = plain(
        summary_of(scenario, nothing, dict.fromkeys(scenario.digested), RunOutcome(0.0, "slot 0")).as_dict()
    )
    return summary
