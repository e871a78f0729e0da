"""Reads from a wire's journal the losses and delays of one link, or of the network before the wire: for `evedrop links fit`.

Source: docs/links.md, recordings of messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NoReturn, final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import zenoh
from numpy.typing import NDArray

from evedrop.counting import counted
from evedrop.errors import TraceError, UsageError
from evedrop.scenario.recordings.message_recording import (
    MessageArrivals,
    MessageRecording,
    MessageSeries,
    check_parts,
    joined,
    series_of,
)
from evedrop.wire.file import load_wire
from evedrop.wire.history import WireHistory
from evedrop.wire.journal_place import JOURNAL_FOLDER
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.plan import WirePlan, numbered_as
from evedrop.wire.records import REASONS, Kind, WireFate, codes_of, delivered_again, records_of

_COLUMNS = ["time", "link", "key", "size", "source", "sequence", "reason", "delay", "n", "kind", "again"]
_MOST_SHOWN = 10  # links or keys that a message lists
_HIDDEN = {WireFate.OVERFLOW, WireFate.CUT, WireFate.TOO_LARGE, WireFate.LOOPED}
"""The fates of messages that the loss model may have lost as well: nobody can tell."""


def journal_recording(
    folder: Path, link: str | None = None, key: str | None = None, *, gaps: bool = False, longest: float | None = None
) -> MessageRecording:
    """What became of the messages of a link, in the order of sending.

    key: a key expression, to read only some of the link's keys. gaps: what was lost before the wire, from the numbers that the
    senders gave to their messages, in place of what the wire itself lost. longest: as for `series_of`, only for gaps.

    Raises UsageError if the folder has no journal, and TraceError if it does not tell what was asked.
    """
    return _LinkRows(folder, link, key).recording(gaps, longest)


@final
class _LinkRows:
    """The rows of one link in a journal."""

    def __init__(self, folder: Path, link: str | None, key: str | None) -> None:
        """Raises UsageError or TraceError."""
        self._folder = folder
        table = pa.concat_tables([table_.select(_COLUMNS) for table_ in journal_tables(folder)])
        self._link = self._chosen(table, link)
        rows = table.filter(pc.equal(table["link"].cast(pa.string()), self._link))
        rows = rows.unify_dictionaries().combine_chunks()
        if key is not None:
            rows = rows.filter(self._has_key(rows, key))
        if unknown := {*pc.unique(rows["reason"].cast(pa.string())).drop_null().to_pylist()} - {*REASONS.values()}:
            self._no(f"has messages whose reason is {min(unknown)!r}, which is none that a wire writes")
        self._keys = key
        self._rows = rows
        self._notes: list[str] = []

    def recording(self, gaps: bool, longest: float | None) -> MessageRecording:
        """See `journal_recording`."""
        name = f"{self._folder}, link {self._link}" + (f", {self._keys}" if self._keys is not None else "")
        if not self._rows.num_rows:
            self._no("has no message on this link and key")
        plan = self._planned()
        recording = self._before(name, longest) if gaps else self._emulated(name, plan)
        link = None if plan is None else next((link for link in plan.links if link.name == self._link), None)
        if link is None:
            return replace(recording, notes=tuple(self._notes), keys=self._keys or "**")
        return replace(
            recording, notes=tuple(self._notes), source=link.source, target=link.target, keys=self._keys or link.keys
        )

    def _emulated(self, name: str, plan: WirePlan | None) -> MessageRecording:
        """What the link's models did."""
        rows = self._rows.filter(pc.is_valid(self._rows["n"]))
        if plan is not None and plan.lossless:
            rows = self._lossy(rows, plan)
        if not rows.num_rows:
            self._no("has only messages that no model decides on")
        streams, records = self._streams(rows, key=numbered_as, kind=_stream_of), records_of(rows, {})
        order = np.lexsort((records["n"], streams))
        streams, records = streams[order], records[order]
        fates, heard = records["fate"], records["time"]
        decided = ~np.isin(fates, list(_HIDDEN))
        hidden = int((~decided).sum())
        if hidden:
            self._notes.append(
                f"left out: {counted(hidden, 'message')} that met a cut, a full queue or a limit before the loss model"
            )
        if not decided.any():
            self._no("has only messages that met a cut, a full queue or a limit before the loss model")
        follows = (np.diff(streams) == 0) & (np.diff(records["n"]) == 1)
        goes_on = np.concatenate([[False], follows & decided[:-1]])
        apart = float(np.median(np.diff(heard)[follows])) if follows.any() else 0.0
        survived = ~np.isin(fates, [WireFate.LOST])
        delivered, corrupted = decided & (fates == WireFate.DELIVERED), fates == WireFate.CORRUPTED
        series = MessageSeries(
            survived[decided].astype(np.uint8),
            parts=int((decided & ~goes_on).sum()),
            repeated=int(delivered_again(records).sum()),
            seconds=apart or None,  # a wire that was suspended hears most of them at once
        )
        check_parts(name, series, "cuts, queues and limits hide what the loss model did in between")
        self._note_changes(rows)
        kept = int((decided & survived).sum())  # and not only what arrived: the wire itself may have dropped the rest
        corrupt = float(corrupted.sum()) / kept if corrupted.any() else None
        dropped = kept - int((delivered | corrupted).sum())
        return MessageRecording(name, series, records["delay"][delivered], corrupt, dropped)

    def _before(self, name: str, longest: float | None) -> MessageRecording:
        """What was lost before the wire heard it."""
        puts = pa.array([_stream_of(kind) == "put" for kind in self._rows["kind"].to_pylist()])
        rows = self._rows.filter(pc.and_(puts, pc.is_valid(self._rows["sequence"])))
        if not rows.num_rows:
            self._no(
                "has no publication with a number of its sender's, as rmw_zenoh and publishers with Zenoh's source info give it"
            )
        records = records_of(rows, {})
        parts = []
        for which in _groups(self._streams(rows, key=str, source=str)):
            try:
                parts.append(series_of(MessageArrivals(records["sequence"][which], records["time"][which]), longest))
            except ValueError as error:
                self._no(str(error), error)
        if len(parts) > 1:
            self._notes.append(f"{len(parts)} senders and keys, one after the other")
        series = joined(parts)
        if series.outcomes.all():
            self._no(f"lacks none of {len(series.outcomes)} numbers of its senders: nothing was lost before the wire")
        check_parts(name, series, "the senders were started again so often, or several use one identity")
        self._notes.append("what was lost before the wire; no delays: the journal does not contain the time of sending")
        return MessageRecording(name, series, np.empty(0))

    def _chosen(self, table: pa.Table, link: str | None) -> str:
        """The name of the link that was named, or of the only one with messages."""
        counts = {
            str(entry["values"]): int(entry["counts"])
            for entry in pc.value_counts(table["link"].cast(pa.string())).to_pylist()
            if entry["values"] is not None
        }
        if link is None and len(counts) == 1:
            return next(iter(counts))
        if link is not None and link in counts:
            return link
        shown = _some([f"{name} ({counted(count, 'message')})" for name, count in counts.items()])
        if not counts:
            self._no("has no messages on any link")
        if link is not None:
            self._no(f'has no messages on a link "{link}"; it has {shown}')
        return self._no(f"has several links; expected --link and one of {shown}")

    def _lossy(self, rows: pa.Table, plan: WirePlan) -> pa.Table:
        """The rows on which the link's models decide: the others are never lost, whatever the models are."""
        keys = rows["key"].cast(pa.string())
        never_lost = [key for key in pc.unique(keys).to_pylist() if plan.is_lossless(zenoh.KeyExpr(key))]
        lossy = rows.filter(pc.invert(pc.is_in(keys, pa.array(never_lost, pa.string()))))
        if left_out := rows.num_rows - lossy.num_rows:
            self._notes.append(f"left out: {counted(left_out, 'message')} that wire.toml has as lossless")
        return lossy

    def _has_key(self, rows: pa.Table, key: str) -> pa.Array:
        """Which rows have a key that the expression takes."""
        try:
            expression = zenoh.KeyExpr(key)
        except zenoh.ZError as error:
            raise UsageError(
                f"--key {key}: Zenoh refuses this key expression; expected one such as */scan/**"
            ) from error
        keys = rows["key"].cast(pa.string())  # those beyond the limit have no text
        taken = [text for text in pc.unique(keys.drop_null()).to_pylist() if expression.intersects(zenoh.KeyExpr(text))]
        return pc.is_in(keys, pa.array(taken, pa.string()))

    def _streams(self, rows: pa.Table, **columns_as: Callable[[str], str]) -> NDArray[np.int64]:
        """A number for each row, the same where the columns are. columns_as: column → the word for each of its words."""
        columns = []
        for name, word_for in columns_as.items():
            texts = pc.unique(rows[name].cast(pa.string())).drop_null().to_pylist()
            numbers = {word: number for number, word in enumerate(dict.fromkeys(map(word_for, texts)))}
            columns.append(codes_of(rows[name], {text: numbers[word_for(text)] for text in texts}, len(numbers)))
        streams: NDArray[np.int64] = (
            np.unique(np.stack(columns), axis=1, return_inverse=True)[1].reshape(-1).astype(np.int64)
        )
        return streams

    def _note_changes(self, rows: pa.Table) -> None:
        """Tell that a link did not have the same settings all the time."""
        history = WireHistory.read(self._folder / JOURNAL_FOLDER)
        pairs = pa.TableGroupBy(rows.select(["key", "kind"]), ["key", "kind"]).aggregate([]).to_pylist()
        changes = max(len(history.changes_of(self._link, pair["key"], _stream_of(pair["kind"]))) for pair in pairs)
        if changes > 1:
            self._notes.append(f"the link had {changes} settings one after the other: fitted as one")

    def _planned(self) -> WirePlan | None:
        """The wire's file; None if it is not there."""
        with suppress(UsageError):
            return load_wire(self._folder / "wire.toml")
        return None

    def _no(self, problem: str, cause: Exception | None = None) -> NoReturn:
        raise TraceError(str(self._folder), "file", problem) from cause


def _stream_of(kind: str) -> str:
    """The kind of messages with which a kind, by its word in the journal, shares its numbers."""
    return Kind[kind.upper()].stream


def _groups(codes: NDArray[np.int64]) -> Iterator[NDArray[np.intp]]:
    """The places of each code, in order."""
    order = np.argsort(codes, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(codes[order])) + 1)


def _some(names: Sequence[str]) -> str:
    """Names, in a line of bounded length."""
    more = [] if len(names) <= _MOST_SHOWN else [f"{len(names) - _MOST_SHOWN} more"]
    return ", ".join([*names[:_MOST_SHOWN], *more])
