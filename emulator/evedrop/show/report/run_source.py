"""The data for the report of a run: its summary, its scenario, and the parts of its tables that the report shows."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from evedrop.errors import UsageError
from evedrop.model.process import Floats
from evedrop.model.receiver import NOTHING, SILENT
from evedrop.results.reading import Results
from evedrop.scenario.loading.recorded import recorded_noise
from evedrop.score.summary import Summary
from evedrop.score.track import LongestSpans, Track, track_of
from evedrop.show.report.chart import POINTS
from evedrop.show.report.groups import GroupCounts, GroupMeans
from evedrop.show.report.slot_rows import RowExtent, SlotRows
from evedrop.show.view import palette
from evedrop.show.view.lanes import EAVESDROPPER
from evedrop.system.files import Unreadable, text_of

_MOST_BYTES = 2**24
OUTCOMES = EAVESDROPPER.words
"""The fates of a packet; the index of a word is its code."""
MOST_SPANS = 12
"""The most spans without track that a report lists for a receiver."""
PIXELS = 2000
"""The most pixels of a lane. Each of a long run stands for several slots: for their most frequent code, or the highest."""
_INTERVAL = 1.96  # standard errors on either side: 95 %


class SlotMeans(NamedTuple):
    """The error of a receiver, at most `POINTS` points: slot by slot, or means of neighbouring slots; NaN where it is unknown."""

    first: int
    last: int
    """The last slot."""
    slot: Floats
    error: Floats
    low: Floats
    """The 95 % interval of the mean over trials."""
    high: Floats
    theory: Floats


@final
class RecordedTrial:
    """A receiver in the first recorded trial."""

    def __init__(self, extent: RowExtent, noise: float) -> None:
        """noise: tr Q."""
        self._noise = noise
        self.last = extent.last
        """The last slot."""
        self.outcome = GroupCounts(extent.rows, PIXELS, len(OUTCOMES))
        """What became of every packet, as indices into `OUTCOMES`."""
        self.track = GroupCounts(extent.rows, PIXELS, len(Track))
        self.lost = LongestSpans(MOST_SPANS, extent.first)
        """The spans in which it lost track."""

    def add(self, rows: pa.Table) -> None:
        """The rows of the next slots. Raises UsageError if one has an unknown action."""
        sent, actions = (_words(rows[name]) for name in ("sent", "action"))
        unknown = sorted(set(actions[1]) - set(OUTCOMES))
        if unknown:
            raise UsageError(f"trials.parquet has the unknown action {unknown[0]}; run the scenario again")
        codes = np.array([OUTCOMES.index(word) for word in actions[1]], np.uint8)[actions[0]]
        silent = np.array([word == NOTHING for word in sent[1]], np.bool_)[sent[0]]
        self.outcome.add(np.where(silent, np.uint8(OUTCOMES.index(SILENT)), codes))
        track = track_of(_numbers(rows["squared_error"]), _numbers(rows["trace_covariance"]), self._noise)
        self.track.add(track)
        self.lost.add(track)


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
        results = Results.read(folder)
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
        columns = ["slot", "mean_squared_error", "mean_actual_trace_covariance", "standard_error"]
        table = SlotRows(self.results, "slots", self.summary.peers)
        groups = {name: GroupMeans(extent.rows, POINTS, 5) for name, extent in table.extents.items()}
        for name, rows in table.pieces([*columns, "expected_trace_covariance"]):
            groups[name].add(_means(rows))
        return {
            name: SlotMeans(extent.first, extent.last, *groups[name].means) for name, extent in table.extents.items()
        }

    @cached_property
    def trial(self) -> dict[str, RecordedTrial]:
        """Receiver → its first recorded trial; empty without one. Raises UsageError if the table cannot be read."""
        table = SlotRows(self.results, "trials", self.summary.peers, self.summary.first_trial)
        trials = {name: RecordedTrial(extent, self.noise) for name, extent in table.extents.items()}
        for name, rows in table.pieces(["sent", "action", "squared_error", "trace_covariance"]):
            trials[name].add(rows)
        return trials

    @cached_property
    def noise(self) -> float:
        """The process noise tr Q; 0 if the scenario cannot be read."""
        return recorded_noise(self.folder)


def _means(rows: pa.Table) -> Floats:
    """Slot, error, the ends of its interval, and what theory expects, (5, c)."""
    error = _numbers(rows["mean_squared_error"])
    actual = _numbers(rows["mean_actual_trace_covariance"])
    error = np.where(np.isnan(error), actual, error)
    scatter = _INTERVAL * _numbers(rows["standard_error"])
    theory = _numbers(rows["expected_trace_covariance"])
    return np.stack([_numbers(rows["slot"]), error, error - scatter, error + scatter, theory])


def _numbers(column: pa.ChunkedArray) -> Floats:
    return np.asarray(column.to_numpy(), np.float64)


def _words(column: pa.ChunkedArray) -> tuple[NDArray[np.intp], list[str]]:
    """A column of words as indices, (c,), into the words that follow."""
    whole = pc.dictionary_encode(column.cast(pa.string())).combine_chunks()
    if isinstance(whole, pa.ChunkedArray):  # without rows
        whole = whole.chunk(0) if whole.num_chunks else pa.array([], pa.string()).dictionary_encode()
    return whole.indices.to_numpy(zero_copy_only=False).astype(np.intp), whole.dictionary.to_pylist()
