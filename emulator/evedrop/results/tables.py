"""The columns of the tables in a results folder.

Source: docs/results.md, tables.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from evedrop.model.digest import DIGEST_BYTES
from evedrop.model.links.loss_model import REASONS
from evedrop.model.plant import Plant
from evedrop.model.process import Floats
from evedrop.model.record import Record, columns
from evedrop.model.slot.records import ReceiverSlots, SensorSlots
from evedrop.score.slots import Slots
from evedrop.score.sums import LEVELS

SLOTS = pa.schema(
    [
        ("slot", pa.int64()),
        ("peer", pa.dictionary(pa.int8(), pa.string())),
        ("trials", pa.int64()),
        ("mean_squared_error", pa.float64()),
        ("mean_actual_trace_covariance", pa.float64()),
        ("standard_error", pa.float64()),
        ("mean_trace_covariance", pa.float64()),
        ("theoretical_trace_covariance", pa.float64()),
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

NULLABLE = {
    "mean_squared_error",
    "mean_actual_trace_covariance",
    "theoretical_trace_covariance",
    *(field.name for field in SLOTS if "quantile" in field.name),
}
"""Columns in which NaN means that there is no value."""


_TYPES = {"b": pa.bool_(), "f": pa.float64(), "i": pa.int64(), "u": pa.int64()}


def fields_of(kind: type[Record], names: Sequence[str], extent: Mapping[str, int]) -> list[pa.Field]:
    """The fields of columns of a record in a table with a row per slot and trial; extent: axis → its length.

    Where a trial has several numbers in a slot, they are a list.
    """
    by_name, fields = {entry.name: entry for entry in columns(kind)}, []
    for name in names:
        value, inner = _TYPES[by_name[name].dtype.kind], by_name[name].shape(extent)[:-1]
        fields.append(pa.field(name, pa.list_(value, math.prod(inner)) if inner else value))
    return fields


def rows_of(record: Record, names: Sequence[str], recorded: int) -> list[NDArray[Any]]:
    """These columns of a record, if they are there, with a row per slot and recorded trial."""
    arrays = [array for name in names if (array := getattr(record, name)) is not None]
    rows = [np.moveaxis(array[..., :recorded], -1, 1) for array in arrays]
    return [array.reshape(array.shape[0] * array.shape[1], *([-1] if array.ndim > 2 else [])) for array in rows]


def trials_schema(n: int) -> pa.Schema:
    """The schema of the recorded trials of a process with n states."""
    return pa.schema(
        [
            ("slot", pa.int64()),
            ("peer", pa.dictionary(pa.int8(), pa.string())),
            ("trial", pa.int64()),
            ("sent", pa.dictionary(pa.int8(), pa.string())),
            ("action", pa.dictionary(pa.int8(), pa.string())),
            ("squared_error", pa.float64()),
            ("trace_covariance", pa.float64()),
            *fields_of(SensorSlots, ("x",), {"n": n, "R": 1}),
            *fields_of(ReceiverSlots, ("x_hat", "P"), {"n": n, "R": 1, "S": 1}),
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


_OF_A_MONITOR = ("watermark", "statistic")


def inputs_schema(inputs: int, disturbances: int, monitored: bool = False) -> pa.Schema:
    """The schema for these numbers of inputs and disturbances; monitored: whether there are a watermark and a detector."""
    axes = {"m": inputs, "R": 1}
    return pa.schema(
        [
            ("slot", pa.int64()),
            ("trial", pa.int64()),
            *fields_of(SensorSlots, ("u",), axes),
            *([("d", pa.list_(pa.float64(), disturbances))] if disturbances else []),
            *fields_of(SensorSlots, ("failed",), axes),
            ("clipped", pa.bool_()),
            *(fields_of(SensorSlots, _OF_A_MONITOR, axes) if monitored else []),
        ]
    )


def trials_schema_like(schema: pa.Schema) -> pa.Schema:
    """The schema that a table of trials with these columns should have."""
    return trials_schema(_length_in(schema, "x") or 1)


def inputs_schema_like(schema: pa.Schema) -> pa.Schema:
    """The schema that a table of inputs with these columns should have."""
    return inputs_schema(_length_in(schema, "u") or 1, _length_in(schema, "d"), "statistic" in schema.names)


def _length_in(schema: pa.Schema, name: str) -> int:
    """The number of numbers in each cell of a column; 0 if there is no such column, or it has no such lists."""
    at = schema.get_field_index(name)
    return int(schema.types[at].list_size) if at >= 0 and pa.types.is_fixed_size_list(schema.types[at]) else 0


def input_columns(slots: Slots, plant: Plant, disturbances: Floats, first_trial: int) -> list[NDArray[Any]]:
    """A row per slot and recorded trial, from first_trial on; disturbances (slots, q) are of the whole run."""
    sensor, recorded = slots.sensor, slots.recorded
    applied = sensor.applied
    assert sensor.u is not None and applied is not None  # noqa: S101, PT018 - asked by the caller
    u, some = sensor.u[:, :, :recorded], slice(slots.first, slots.first + slots.count)
    return [
        np.repeat(np.arange(some.start, some.stop), recorded),
        np.tile(np.arange(first_trial, first_trial + recorded), slots.count),
        np.stack([plant.limited(inputs) for inputs in u]).transpose(0, 2, 1).reshape(slots.count * recorded, -1),
        *([np.repeat(disturbances[some], recorded, axis=0)] if disturbances.shape[1] else []),
        *rows_of(sensor, ("failed",), recorded),
        plant.clips(applied[:, :, :recorded]).reshape(-1),
        *rows_of(sensor, _OF_A_MONITOR, recorded),
    ]


_STRATEGIES = b"strategies"


def with_strategies(table: pa.Table, strategies: Mapping[str, str]) -> pa.Table:
    """The table of a sweep that says, in its metadata, which strategy each receiver has: pictures take their colours from it."""
    metadata = {**(table.schema.metadata or {}), _STRATEGIES: json.dumps(dict(strategies)).encode()}
    return table.replace_schema_metadata(metadata)


def swept_strategies(table: pa.Table) -> dict[str, str]:
    """Receiver → the strategy that it has at the first point of a sweep; empty if its table does not say it."""
    text = (table.schema.metadata or {}).get(_STRATEGIES, b"{}")
    return {str(name): str(strategy) for name, strategy in json.loads(text).items()}
