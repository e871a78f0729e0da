"""The data for the report of a run: its summary, its scenario, and the parts of its tables that the report shows."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from evedrop.errors import UsageError
from evedrop.files import Unreadable, text_of
from evedrop.loading.recorded import recorded_noise
from evedrop.model.packet_words import NOTHING, SILENT
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes
from evedrop.results.reading import Results, load_results
from evedrop.score.summary import Summary
from evedrop.score.track import LostSpan, Track, lost_spans, track_of
from evedrop.view import palette
from evedrop.view.lanes import EAVESDROPPER

_MOST_BYTES = 2**24
OUTCOMES = EAVESDROPPER.words
"""The fates of a packet; the index of a word is its code."""
_INTERVAL = 1.96  # standard errors on either side: 95 %


class SlotMeans(NamedTuple):
    """The error of a receiver, slot by slot, (c,) each; NaN where it is unknown."""

    slot: Floats
    error: Floats
    low: Floats
    """The 95 % interval of the mean over trials."""
    high: Floats
    theory: Floats


class RecordedTrial(NamedTuple):
    """A receiver in the first recorded trial, (c,) each."""

    slot: Floats
    outcome: Codes
    """What became of every packet, as indices into `OUTCOMES`."""
    track: Codes
    spans: Sequence[LostSpan]
    """The spans in which it lost track."""


@dataclass(frozen=True)
class RunSource:
    """A results folder of a run, read."""

    folder: Path
    results: Results
    summary: Summary
    scenario_text: str
    """The scenario.toml of the folder; empty if it cannot be read."""

    @classmethod
    def read(cls, folder: Path) -> RunSource:
        """Read a folder. Raises UsageError if it is not a results folder of this version."""
        results = load_results(folder)
        try:
            text = text_of(folder / "scenario.toml", _MOST_BYTES)
        except (OSError, Unreadable):
            text = ""
        return cls(folder, results, results.typed_summary, text)

    @cached_property
    def tables(self) -> Mapping[str, Any]:
        """The tables of the scenario; empty if they cannot be read."""
        try:
            return tomllib.loads(self.scenario_text)
        except (ValueError, RecursionError):
            return {}

    def colour(self, receiver: str) -> str:
        """The colour of a receiver, as in the view."""
        return palette.hexadecimal(palette.colour(list(self.summary.peers).index(receiver)))

    @cached_property
    def means(self) -> dict[str, SlotMeans]:
        """Receiver → its error in every slot. Raises UsageError if the table cannot be read."""
        columns = ["slot", "peer", "mean_squared_error", "mean_actual_trace_covariance", "standard_error"]
        table = self.results.part("slots", [*columns, "expected_trace_covariance"])
        return {name: _means(rows) for name, rows in self._by_receiver(table).items()}

    @cached_property
    def trial(self) -> dict[str, RecordedTrial]:
        """Receiver → its first recorded trial; empty without one. Raises UsageError if the table cannot be read."""
        columns = ["slot", "peer", "sent", "action", "squared_error", "trace_covariance"]
        table = self.results.part("trials", columns, pc.field("trial") == self.summary.first_trial)
        return {name: _trial(rows, self.noise) for name, rows in self._by_receiver(table).items() if rows.num_rows}

    @cached_property
    def noise(self) -> float:
        """The process noise tr Q; 0 if the scenario cannot be read."""
        return recorded_noise(self.folder)

    def _by_receiver(self, table: pa.Table) -> dict[str, pa.Table]:
        found = {name: table.filter(pc.equal(table["peer"], name)) for name in self.summary.peers}
        return {name: rows if _in_order(rows) else rows.sort_by("slot") for name, rows in found.items()}


def _in_order(rows: pa.Table) -> bool:
    """Whether the slots of the rows increase, as in tables of the writer."""
    return bool((np.diff(rows["slot"].to_numpy()) > 0).all())


def _means(rows: pa.Table) -> SlotMeans:
    error = _numbers(rows["mean_squared_error"])
    actual = _numbers(rows["mean_actual_trace_covariance"])
    error = np.where(np.isnan(error), actual, error)
    scatter = _INTERVAL * _numbers(rows["standard_error"])
    return SlotMeans(
        _numbers(rows["slot"]), error, error - scatter, error + scatter, _numbers(rows["expected_trace_covariance"])
    )


def _numbers(column: pa.ChunkedArray) -> Floats:
    return np.asarray(column.to_numpy(), np.float64)


def _words(column: pa.ChunkedArray) -> tuple[NDArray[np.intp], list[str]]:
    """A column of words as indices, (c,), into the words that follow."""
    whole = pc.dictionary_encode(column.cast(pa.string())).combine_chunks()
    if isinstance(whole, pa.ChunkedArray):  # without rows
        whole = whole.chunk(0) if whole.num_chunks else pa.array([], pa.string()).dictionary_encode()
    return whole.indices.to_numpy(zero_copy_only=False).astype(np.intp), whole.dictionary.to_pylist()


def _trial(rows: pa.Table, noise: float) -> RecordedTrial:
    sent, actions = (_words(rows[name]) for name in ("sent", "action"))
    unknown = sorted(set(actions[1]) - set(OUTCOMES))
    if unknown:
        raise UsageError(f"trials.parquet has the unknown action {unknown[0]}; run the scenario again")
    codes = np.array([OUTCOMES.index(word) for word in actions[1]], np.uint8)[actions[0]]
    silent = np.array([word == NOTHING for word in sent[1]], np.bool_)[sent[0]]
    outcome = np.where(silent, np.uint8(OUTCOMES.index(SILENT)), codes)
    errors, traces = _numbers(rows["squared_error"]), _numbers(rows["trace_covariance"])
    slots, track = _numbers(rows["slot"]), track_of(errors, traces, noise)
    return RecordedTrial(slots, outcome, track, lost_spans(track, int(slots[0])))


TRACK_COLOURS = dict(zip(Track, palette.KNOWLEDGE, strict=True))
"""The colours of the lanes that say what a receiver knows."""
