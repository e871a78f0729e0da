"""The results folder: written while the run goes on, whole whenever it ends, and read back as typed tables.

Source: docs/results.md.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from emulator.errors import UsageError
from emulator.model.digest import DIGEST_BYTES, Digests
from emulator.model.links.link import REASONS
from emulator.model.plant import Plant
from emulator.model.process import Floats
from emulator.model.receiver import Action, Codes, Flags
from emulator.network.access import CONTROLLER
from emulator.network.wire import packed_flags
from emulator.runs.folder import private_file, write_private
from emulator.runs.histogram import LEVELS
from emulator.runs.input_table import input_columns, inputs_schema, inputs_schema_in
from emulator.runs.joined import Slots
from emulator.runs.score import SlotSums
from emulator.scenario import Scenario
from emulator.scenario.disturbances import disturbances_of

_ROWS = 65_536  # rows of a table held back until they are worth writing
_BYTES = 16 * 2**20  # the same of wide rows, as a journal's of many trials are; and a row group has no more

SLOTS = pa.schema(
    [
        ("slot", pa.int64()),
        ("peer", pa.dictionary(pa.int8(), pa.string())),
        ("trials", pa.int64()),
        ("mean_squared_error", pa.float64()),
        ("mean_actual_trace_covariance", pa.float64()),
        ("standard_error", pa.float64()),
        ("mean_trace_covariance", pa.float64()),
        ("expected_trace_covariance", pa.float64()),
        ("received_fraction", pa.float64()),
        ("used_fraction", pa.float64()),
        *((f"{quantity}_quantile_{level:g}", pa.float64()) for quantity in ("error", "trace") for level in LEVELS),
    ]
)
JOURNAL = pa.schema(
    [
        ("slot", pa.int64()),
        ("link", pa.dictionary(pa.int8(), pa.string())),
        ("offered", pa.int64()),
        ("delivered", pa.int64()),
        ("late", pa.int64()),
        ("lost", pa.int64()),
        *((f"lost_by_{reason}", pa.int64()) for reason in REASONS),
        ("delivered_mask", pa.binary()),
    ]
)
ACTIONS = ("dropped", "state", "innovation", "discarded", "misled")
"""What a receiver did, as the observer knows it: `misled` is an innovation used as the state."""
SENT = ("state", "innovation", "nothing")
"""What a packet was."""


NULLABLE = {
    "mean_squared_error",
    "mean_actual_trace_covariance",
    "expected_trace_covariance",
    *(field.name for field in SLOTS if "quantile" in field.name),
}
"""Columns in which NaN means that there is nothing."""


def _trials_schema(n: int) -> pa.Schema:
    return pa.schema(
        [
            ("slot", pa.int64()),
            ("peer", pa.dictionary(pa.int8(), pa.string())),
            ("trial", pa.int64()),
            ("sent", pa.dictionary(pa.int8(), pa.string())),
            ("action", pa.dictionary(pa.int8(), pa.string())),
            ("squared_error", pa.float64()),
            ("trace_covariance", pa.float64()),
            ("x", pa.list_(pa.float64(), n)),
            ("x_hat", pa.list_(pa.float64(), n)),
            ("P", pa.list_(pa.float64(), n * n)),
        ]
    )


DIGESTS = pa.schema(
    [
        ("peer", pa.dictionary(pa.int8(), pa.string())),
        ("trial", pa.int64()),
        ("block", pa.int64()),
        ("digest", pa.binary(DIGEST_BYTES)),
    ]
)


class _Table:
    """A Parquet file that grows. Rows are held back, as arrays of one row each slot, until they make a row group."""

    def __init__(self, path: Path, schema: pa.Schema, names: Mapping[str, tuple[str, ...]]) -> None:
        """names: what the codes of each dictionary column stand for."""
        self._writer = pq.ParquetWriter(
            private_file(path), schema, compression="zstd", compression_level=1, use_dictionary=[*names]
        )
        self._schema = schema
        self._names = {column: pa.array(words) for column, words in names.items()}
        self._held: list[list[NDArray[Any]]] = [[] for _ in schema]
        self._rows = self._bytes = 0

    def add(self, columns: Sequence[NDArray[Any]]) -> None:
        """Take rows: an array for each column, codes where it has names, and two dimensions where it holds lists or bytes."""
        for held, column in zip(self._held, columns, strict=True):
            held.append(np.array(column))  # a copy: a view would keep a whole message from being forgotten
            self._bytes += held[-1].nbytes
        self._rows += len(columns[0])
        if self._rows >= _ROWS or self._bytes >= _BYTES:
            self._write()

    def _write(self) -> None:
        whole = [np.concatenate(held) for held in self._held] if self._rows else []
        at_once = max(1, self._rows * _BYTES // max(1, self._bytes))
        for first in range(0, self._rows, at_once):
            columns = [
                self._column(field, values[first : first + at_once])
                for field, values in zip(self._schema, whole, strict=True)
            ]
            self._writer.write_table(pa.Table.from_arrays(columns, schema=self._schema))
        self._held, self._rows, self._bytes = [[] for _ in self._schema], 0, 0

    def _column(self, field: pa.Field, values: NDArray[Any]) -> pa.Array:
        if field.name in self._names:
            return pa.DictionaryArray.from_arrays(pa.array(values.astype(np.int8)), self._names[field.name])
        if pa.types.is_fixed_size_list(field.type):
            return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])
        if pa.types.is_fixed_size_binary(field.type):
            return pa.FixedSizeBinaryArray.from_buffers(field.type, len(values), [None, pa.py_buffer(values)])
        if pa.types.is_binary(field.type):
            ends = np.arange(len(values) + 1, dtype=np.int32) * np.int32(values.shape[1])
            return pa.BinaryArray.from_buffers(
                field.type, len(values), [None, pa.py_buffer(ends), pa.py_buffer(values)]
            )
        return pa.array(values, field.type, from_pandas=field.name in NULLABLE)

    def close(self) -> None:
        try:
            self._write()
        finally:
            self._writer.close()


class ResultsWriter:
    """Writes a results folder. Final; use it as a context manager, so that whatever ends the run, the files are whole."""

    def __init__(
        self,
        folder: Path,
        receivers: tuple[str, ...],
        n: int,
        around: Sequence[float] | None = None,
        loop: tuple[Plant, Floats] | None = None,
    ) -> None:
        """around: what is added to states and estimates, (n,); loop: of a closed one, plant and disturbances (slots, q)."""
        self._digested = receivers if loop is None else (*receivers, CONTROLLER)
        self._around = None if around is None or not any(around) else np.array(around)
        peers = {"peer": self._digested}
        words = {**peers, "sent": SENT, "action": ACTIONS}
        self._slots = _Table(folder / "slots.parquet", SLOTS, peers)
        self._trials = _Table(folder / "trials.parquet", _trials_schema(n), words)
        self._journal = _Table(folder / "journal.parquet", JOURNAL, {"link": receivers})
        self._digests = _Table(folder / "digests.parquet", DIGESTS, peers)
        self._tables = [self._slots, self._trials, self._journal, self._digests]
        self._loop = loop
        if loop is not None:
            plant, disturbances = loop
            self._inputs = _Table(folder / "inputs.parquet", inputs_schema(plant.inputs, disturbances.shape[1]), {})
            self._tables.append(self._inputs)

    @classmethod
    def of(cls, folder: Path, scenario: Scenario) -> Self:
        """Of the results of a scenario."""
        loop = (
            None
            if scenario.driven is None or scenario.controller is None
            else (scenario.driven, disturbances_of(scenario))
        )
        return cls(folder, scenario.receivers, len(scenario.process.A), scenario.process.around, loop)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        failures: list[Exception] = []
        for table in self._tables:
            try:
                table.close()
            except (
                OSError,
                pa.ArrowException,
            ) as failure:  # one that cannot be written keeps no other from being whole
                failures.append(failure)
        if failures and error is None:
            raise failures[0]

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

        expected: the trace that theory gives, (c,); quantiles: of error and of trace, (c, 2 levels), NaN where there are
        none; covariance_only: the error is the trace of the actual covariance, not a squared error.
        """
        count, trials = len(expected), sums.trials
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            mean = sums.error / trials
            variance = np.maximum(0.0, sums.error_squared / trials - mean * mean) * trials / (trials - 1.0)
            standard_error = np.where(trials > 1, np.sqrt(variance / trials), np.nan)
            columns = [sums.trace / trials, expected, sums.received / trials, sums.used / trials]
        nothing = np.full(count, np.nan)
        spread = quantiles if quantiles is not None else np.full((count, 2 * len(LEVELS)), np.nan)
        self._slots.add(
            [
                np.arange(first, first + count),
                self._names(name, count),
                trials.astype(np.int64),
                nothing if covariance_only else mean,
                mean if covariance_only else nothing,
                standard_error,
                *columns,
                *spread.T,
            ]
        )

    def trial_rows(self, slots: Slots, squared_errors: Mapping[str, Floats], first_trial: int) -> None:
        """A row per slot, receiver and recorded trial, the first of which is first_trial: everything."""
        recorded = next(iter(slots.receivers.values())).P.shape[3]
        count = slots.count * recorded
        k = np.repeat(np.arange(slots.first, slots.first + slots.count), recorded)
        trials = np.tile(np.arange(first_trial, first_trial + recorded), slots.count)
        nu = slots.nu[:, :recorded]
        packets = nu if slots.sent is None else np.where(slots.sent[:, :recorded], nu, len(SENT) - 1)
        x = self._levels(slots.x[:, :, :recorded])
        for name, receiver in slots.receivers.items():
            self._trials.add(
                [
                    k,
                    self._names(name, count),
                    trials,
                    packets.reshape(-1),
                    seen_actions(receiver.action[:, :recorded], nu).reshape(-1),
                    squared_errors[name][:, :recorded].reshape(-1),
                    np.trace(receiver.P, axis1=1, axis2=2).reshape(-1),
                    x,
                    self._levels(receiver.x_hat[:, :, :recorded]),
                    np.moveaxis(receiver.P, 3, 1).reshape(count, -1),
                ]
            )

    def _levels(self, x: Floats) -> Floats:
        """States (c, n, r) as rows, (c r, n), with the reference added from which they are deviations."""
        rows = x.transpose(0, 2, 1).reshape(-1, x.shape[1])
        return rows if self._around is None else rows + self._around

    def input_rows(self, slots: Slots, first_trial: int) -> None:
        """A row per slot and recorded trial, the first of which is first_trial: what moved the plant."""
        if slots.inputs is None or self._loop is None:
            return
        self._inputs.add(input_columns(slots, *self._loop, first_trial))

    def journal_rows(self, slots: Slots) -> None:
        """A row per slot and link of a live run: counts by reason, and which trials were delivered as a bit mask."""
        for name, receiver in slots.receivers.items():
            silent = 0 if receiver.unsent is None else receiver.unsent.astype(np.int64)
            offered = np.full(slots.count, slots.trials) - silent
            delivered = np.count_nonzero(receiver.delivered, axis=1)
            by_reason = [receiver.lost[reason].astype(np.int64) for reason in REASONS]
            lost = np.sum(by_reason, axis=0)
            self._journal.add(
                [
                    np.arange(slots.first, slots.first + slots.count),
                    self._names(name, slots.count),
                    offered,
                    delivered,
                    offered - delivered - lost,
                    lost,
                    *by_reason,
                    packed_flags(receiver.delivered),
                ]
            )

    def _names(self, name: str, count: int) -> NDArray[np.int8]:
        return np.full(count, self._digested.index(name), np.int8)

    def digest_rows(self, first_trial: int, digests: Mapping[str, Mapping[int, Digests]]) -> None:
        """A row per receiver, trial and block: receiver → block → digests (R, 32) of the trials from first_trial on."""
        for name, blocks in digests.items():
            for block, values in sorted(blocks.items()):
                trials = len(values)
                numbers = np.arange(first_trial, first_trial + trials)
                self._digests.add([self._names(name, trials), numbers, np.full(trials, block), values])


def seen_actions(action: Codes, nu: Flags) -> Codes:
    """Indices into `ACTIONS`: what was done, with the truth about the packet's type."""
    misled = (action == Action.STATE) & nu
    return np.where(misled, np.uint8(ACTIONS.index("misled")), action)


def write_summary(folder: Path, summary: Mapping[str, Any]) -> None:
    """Write summary.json; infinite and undefined numbers as strings, which JSON lacks."""
    unfinished = folder / "summary.json.new"
    write_private(unfinished, json.dumps(plain(summary), indent=1, ensure_ascii=False) + "\n")
    os.replace(unfinished, folder / "summary.json")


def plain(value: Any) -> Any:
    """The same with infinite and undefined numbers as strings, which JSON lacks."""
    if isinstance(value, Mapping):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return value


@dataclass(frozen=True)
class Results:
    """A results folder, read: `summary` as in docs/results.md, the tables as Arrow."""

    folder: Path
    summary: Mapping[str, Any]

    def _table(self, name: str, expected: pa.Schema | None = None) -> pa.Table:
        path = self.folder / f"{name}.parquet"
        try:
            table = pq.read_table(path)
        except (OSError, pa.ArrowException) as error:
            raise UsageError(f"{path} cannot be read ({_one_line(error)}); run the scenario again") from error
        wanted = _trials_schema(_states_in(table.schema)) if expected is None else expected
        if not table.schema.equals(wanted):
            other = [field.name for field in wanted if field not in table.schema] or table.schema.names
            raise UsageError(
                f"{path} is no table of this version (it differs in {', '.join(other)}); run the scenario again"
            )
        empty = [name for name in table.column_names if name not in NULLABLE and table[name].null_count]
        if empty:
            raise UsageError(f"{path} has empty cells in {', '.join(empty)}; run the scenario again")
        return table

    @property
    def slots(self) -> pa.Table:
        """A row per slot and peer: statistics over trials."""
        return self._table("slots", SLOTS)

    @property
    def trials(self) -> pa.Table:
        """A row per slot, peer and recorded trial."""
        return self._table("trials")

    @property
    def journal(self) -> pa.Table:
        """A row per slot and link."""
        return self._table("journal", JOURNAL)

    @property
    def inputs(self) -> pa.Table | None:
        """A row per slot and recorded trial of a closed loop; None without a controller."""
        if self.summary.get("controller") is None:
            return None
        return self._table("inputs", inputs_schema_in(self.folder / "inputs.parquet"))

    @property
    def digests(self) -> pa.Table:
        """A row per peer, trial and block of 256 slots."""
        return self._table("digests", DIGESTS)


def _states_in(schema: pa.Schema) -> int:
    """The number of states in a table of trials, as far as it is one."""
    x = schema.field("x").type if "x" in schema.names else None
    return int(x.list_size) if x is not None and pa.types.is_fixed_size_list(x) else 1


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def load_results(folder: str | Path) -> Results:
    """Read a results folder. Raises UsageError if it is none, naming the file that is missing or broken."""
    path = Path(folder) / "summary.json"
    try:
        summary = json.loads(path.read_text())
    except OSError as error:
        if (Path(folder) / "shards").is_dir():
            raise UsageError(
                f"{folder} is of a run in shards that goes on or was killed; each of its shards is a results folder by "
                f"itself when it has ended, such as {Path(folder) / 'shards' / '1'}"
            ) from error
        raise UsageError(
            f"{folder} is no results folder ({path.name}: {error.strerror}); give the --out of a run"
        ) from error
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path} is not JSON ({error}); run the scenario again") from error
    parts = {"peers": dict, "secrecy": dict, "links": dict, "slots": int, "trials": int}
    if not isinstance(summary, dict) or any(type(summary.get(name)) is not kind for name, kind in parts.items()):
        raise UsageError(f"{path} is no summary of a run; run the scenario again")
    return Results(Path(folder), summary)
