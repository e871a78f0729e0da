"""The results folder: written during the run, complete whenever it ends, and read back as typed tables.

Source: docs/results.md.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self, final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from evedrop.model.digest import DigestLog, Digests
from evedrop.model.process import Floats
from evedrop.model.receiver import ACTIONS, MISLED, NOTHING, TYPES, Action, Codes, Flags, packed_flags
from evedrop.names import CONTROLLER
from evedrop.results.crash_proof_tables import (
    BATCH_BYTES,
    TableStream,
    Unfinished,
    finish,
    keep,
    stream_file,
    write_metrics,
)
from evedrop.results.folder import UNFINISHED, HeldFolder
from evedrop.results.resolved_scenario import TakenStates
from evedrop.results.summary_file import summary_text
from evedrop.results.tables import DIGESTS, JOURNAL, SLOTS, input_columns, inputs_schema, rows_of, trials_schema
from evedrop.scenario.closed_loop import monitor_of
from evedrop.scenario.input_files import disturbances_of
from evedrop.scenario.tables import Scenario
from evedrop.score.scorekeeper import Scored
from evedrop.score.slots import Slots
from evedrop.score.summary import Summary
from evedrop.score.sums import LEVELS, SlotSums
from evedrop.system.world import world

_ROUND_SECONDS = 3.0  # the longest time between rounds, which a killed writer loses
_ROUND_BYTES = (32 * 2**10, 4 * 2**20)  # the most that is held back, at the start of a run and later
_ROUND_ONE_IN = 8  # at most one in 8 of the bytes on disk is held back
_METRICS_PAUSE = 50  # after metrics took some time, none are computed for 50 times as long


@final
class ResultsWriter:
    """Writes the tables of a results folder; a context manager.

    Inside the block, rows go to streams that can be read however the writer ends; on leaving it they become Parquet files.
    `write_summary` then completes the folder.
    """

    def __init__(
        self, folder: Path, scenario: Scenario, with_metrics: Callable[[], None] = lambda: None, at: str = "slot 0"
    ) -> None:
        """with_metrics: called before metrics are written, when their rows are on disk.

        at: as for `checkpoint`; empty for a study, whose folder has nothing to read before its first trials are done.

        Raises OSError if the folder cannot be written.
        """
        process, plant = scenario.process, None if scenario.controller is None else scenario.driven
        self._digested = scenario.receivers if plant is None else (*scenario.receivers, CONTROLLER)
        self._around = np.array(process.around) if any(process.around) else None
        self._held = HeldFolder(folder)
        self._unfinished = Unfinished(folder)
        self._loop = None if plant is None else (plant, disturbances_of(scenario))
        self._taken = TakenStates(folder, process) if process.source == "zenoh" else None
        peers = {"peer": self._digested}
        words = {**peers, "sent": TYPES, "action": ACTIONS}
        self._kinds: dict[str, tuple[pa.Schema, Mapping[str, tuple[str, ...]]]] = {
            "slots": (SLOTS, peers),
            "trials": (trials_schema(len(process.A)), words),
            "journal": (JOURNAL, {"link": scenario.receivers}),
            "digests": (DIGESTS, peers),
        }
        if self._loop is not None:
            plant, disturbances = self._loop
            monitored = monitor_of(scenario) is not None
            self._kinds["inputs"] = (inputs_schema(plant.inputs, disturbances.shape[1], monitored), {})
        self._streams = {name: self._stream(name, 0) for name in self._kinds}
        self._outdated: list[TableStream] = []
        self._restarts = self._bytes = self._on_disk = self._slots = 0
        self._at = at
        self._broken = self._metrics_before = False
        self._round_due = self._metrics_due = world().monotonic() + _ROUND_SECONDS
        self._with_metrics = with_metrics
        self._round()

    def _stream(self, name: str, number: int) -> TableStream:
        schema, names = self._kinds[name]
        return TableStream(self._held.now / UNFINISHED / stream_file(name, number), schema, names)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        failure: OSError | None = None
        try:
            if not self._broken:
                self._round()
        except OSError as problem:
            failure = problem
        for stream in (*self._streams.values(), *self._outdated):
            stream.close()
        try:
            finish(self._held.now)
        except (OSError, pa.ArrowException) as problem:  # the streams stay where they are, and can be read
            failure = failure or (problem if isinstance(problem, OSError) else OSError(str(problem)))
        self._unfinished.close()
        if self._taken is not None:
            self._taken.close()
        self._held.close()
        if failure is not None and error is None:
            raise failure

    def checkpoint(
        self, at: str, metrics: Callable[[], Summary | None], before: Callable[[], None] = lambda: None
    ) -> None:
        """Write rows to disk if some seconds have passed since the last round, or if many are held back.

        at: how far the run came, in words; metrics: returns the summary so far, or None if there is none now, called more rarely
        if it takes long; before: called before metrics. Raises OSError if the disk is full or the folder is gone.
        """
        self._at = at
        began = world().monotonic()
        least, most = _ROUND_BYTES
        if began < self._round_due and self._bytes < min(most, max(least, self._on_disk // _ROUND_ONE_IN)):
            return
        first = not self._metrics_before
        due = first or began >= self._metrics_due
        if due:
            before()
        if first:  # rows without metrics could not be looked at, if the run were killed now
            earliest = metrics()
            self._round(lambda: self._write_known(earliest))
            self._metrics_before = True
        else:
            self._round()
        self._round_due = world().monotonic() + _ROUND_SECONDS
        if due:
            self._metrics_due = self._round_due
        if due and not first:  # the first metrics import the theory, so their time says nothing about the next
            self._write_known(metrics())
            now = world().monotonic()
            self._metrics_due = now + max(_ROUND_SECONDS, _METRICS_PAUSE * (now - began))

    def write_rows(self, at: str) -> None:
        """Write all rows to disk now. Raises OSError as `checkpoint` does."""
        self._at = at
        self._round()

    def settle(self, at: str, metrics: Summary) -> None:
        """Write everything to disk, with the last metrics; no rows may follow. Raises OSError as `checkpoint` does."""
        self._at = at
        self._round()
        self.write_metrics(metrics)

    def _write_known(self, metrics: Summary | None) -> None:
        if metrics is not None:
            self.write_metrics(metrics)

    def write_metrics(self, metrics: Summary) -> None:
        """Write the summary so far, of a run that has not ended."""
        self._with_metrics()
        keep(self._held.now)  # or a power cut could leave metrics of rows that are lost
        write_metrics(self._held.now, summary_text(replace(metrics, ended=self._at)))

    def restart_slots(self) -> None:
        """Discard the rows of all slots; other rows will replace them."""
        self._restarts += 1
        self._outdated.append(self._streams["slots"])
        self._streams["slots"] = self._stream("slots", self._restarts)

    def _round(self, before: Callable[[], None] = lambda: None) -> None:
        """Write all rows; before: called when they are written, and do not count yet: they do in the next round if it fails."""

        def whole() -> None:
            self._broken = False  # all batches are whole, even if what comes before they count fails
            before()
            self._broken = True

        with self._unbroken():
            if self._taken is not None:
                self._taken.write()
            self._unfinished.round(self._at, self._slots, self._streams, whole)
        self._on_disk, self._bytes = self._on_disk + self._bytes, 0
        for stream in self._outdated:
            stream.close()
            world().disk.remove(self._held.now / UNFINISHED / stream.file)
        self._outdated = []

    @contextmanager
    def _unbroken(self) -> Iterator[None]:
        """If the block fails, nothing more is written: rows after an incomplete batch could not be read."""
        if self._broken:
            raise OSError(errno.EIO, "an earlier part could not be written")
        self._broken = True
        yield
        self._broken = False

    def _add(self, table: str, columns: Sequence[NDArray[Any]]) -> None:
        stream = self._streams[table]
        self._bytes += stream.add(columns)
        if stream.held_bytes >= BATCH_BYTES:  # these rows count only from the next round on
            with self._unbroken():
                stream.write()

    def slot_rows(
        self,
        first: int,
        name: str,
        sums: SlotSums,
        expected: Floats,
        quantiles: Floats | None = None,
        covariance_only: bool = False,
    ) -> None:
        """A row per slot: statistics over trials of one receiver.

        expected: the trace by theory, (c,); quantiles: of error and of trace, (c, 2 levels), NaN where there are none;
        covariance_only: the error is the trace of the actual covariance, not a squared error.
        """
        count, trials = len(expected), sums.trials
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            mean = sums.error / trials
            columns = [sums.trace / trials, expected, sums.received / trials, sums.used / trials]
        self._slots = max(self._slots, first + count)
        nothing = np.full(count, np.nan)
        spread = quantiles if quantiles is not None else np.full((count, 2 * len(LEVELS)), np.nan)
        self._add(
            "slots",
            [
                np.arange(first, first + count),
                self._names(name, count),
                trials.astype(np.int64),
                nothing if covariance_only else mean,
                mean if covariance_only else nothing,
                sums.standard_errors,
                *columns,
                *spread.T,
            ],
        )

    def trial_rows(self, slots: Slots, squared_errors: Mapping[str, Floats], first_trial: int) -> None:
        """A row per slot, receiver and recorded trial, from first_trial on, with all columns."""
        sensor, recorded = slots.sensor, slots.recorded
        count = slots.count * recorded
        k = np.repeat(np.arange(slots.first, slots.first + slots.count), recorded)
        trials = np.tile(np.arange(first_trial, first_trial + recorded), slots.count)
        nu = sensor.nu[:, :recorded]
        packets = nu if sensor.sent is None else np.where(sensor.sent[:, :recorded], nu, TYPES.index(NOTHING))
        x = self._levels(*rows_of(sensor, ("x",), recorded))
        for name, receiver in slots.receivers.items():
            self._add(
                "trials",
                [
                    k,
                    self._names(name, count),
                    trials,
                    packets.reshape(-1),
                    seen_actions(receiver.action[:, :recorded], nu).reshape(-1),
                    squared_errors[name][:, :recorded].reshape(-1),
                    np.trace(receiver.P, axis1=1, axis2=2).reshape(-1),
                    x,
                    self._levels(*rows_of(receiver, ("x_hat",), recorded)),
                    *rows_of(receiver, ("P",), recorded),
                ],
            )

    def state_rows(self, slots: Slots) -> None:
        """A line per slot: the states that were taken from a program, which all trials share."""
        if self._taken is not None:
            self._taken.add(slots.sensor.x[:, :, 0])

    def _levels(self, x: Floats) -> Floats:
        """States as rows, (c r, n), with the reference added, from which they are deviations."""
        return x if self._around is None else x + self._around

    def input_rows(self, slots: Slots, first_trial: int) -> None:
        """A row per slot and recorded trial, from first_trial on: the inputs and disturbances of the plant."""
        if slots.sensor.u is None or self._loop is None:
            return
        self._add("inputs", input_columns(slots, *self._loop, first_trial))

    def journal_rows(self, slots: Slots) -> None:
        """A row per slot and link of a live run: counts by reason, and a bit mask of the trials that were delivered."""
        for name, link in slots.links.items():
            offered = np.full(slots.count, slots.trials) - link.unsent.astype(np.int64)
            delivered = np.count_nonzero(link.delivered, axis=1)
            by_reason = link.lost.astype(np.int64).T
            lost = by_reason.sum(axis=0)
            self._add(
                "journal",
                [
                    np.arange(slots.first, slots.first + slots.count),
                    self._names(name, slots.count),
                    offered,
                    delivered,
                    offered - delivered - lost,
                    lost,
                    *by_reason,
                    packed_flags(link.delivered),
                ],
            )

    def _names(self, name: str, count: int) -> NDArray[np.int8]:
        return np.full(count, self._digested.index(name), np.int8)

    def digest_rows(self, first_trial: int, digests: Mapping[str, Mapping[int, Digests]]) -> None:
        """A row per receiver, trial and block: receiver → block → digests (R, 16) of the trials from first_trial on."""
        for name, blocks in digests.items():
            for block, values in sorted(blocks.items()):
                trials = len(values)
                numbers = np.arange(first_trial, first_trial + trials)
                self._add("digests", [self._names(name, trials), numbers, np.full(trials, block), values])


def seen_actions(action: Codes, nu: Flags) -> Codes:
    """Indices into `ACTIONS`: the actions, with the truth about each packet's type."""
    misled = (action == int(Action.STATE)) & nu
    return np.where(misled, np.uint8(ACTIONS.index(MISLED)), action)


def write_rows(writer: ResultsWriter, slots: Slots, scored: Mapping[str, Scored], first_trial: int) -> None:
    """Write all rows of some slots."""
    for name, values in scored.items():
        writer.slot_rows(slots.first, name, values.sums, values.expected)
    writer.input_rows(slots, first_trial)
    writer.state_rows(slots)
    writer.trial_rows(slots, {name: values.squared_error for name, values in scored.items()}, first_trial)
    writer.journal_rows(slots)


@final
class DigestRows:
    """The digests of a run; their rows are written as blocks are reported."""

    def __init__(self, digests: Mapping[str, DigestLog], first_trial: int) -> None:
        """digests: receiver, or controller → block → digests of the trials from first_trial on; blocks are added later."""
        self._digests = digests
        self._first_trial = first_trial
        self._written = dict.fromkeys(digests, 0)

    def write(self, writer: ResultsWriter) -> None:
        """Write the blocks that were added since the last call."""
        for name, blocks in self._digests.items():
            if len(blocks) > self._written[name]:
                writer.digest_rows(self._first_trial, {name: blocks.after(self._written[name])})
                self._written[name] = len(blocks)
