"""The table of a plant's inputs and disturbances: its columns and rows.

Source: docs/results.md, tables.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from evedrop.files import opened
from evedrop.model.plant import Plant
from evedrop.model.process import Floats
from evedrop.score.slots import Slots


def inputs_schema(inputs: int, disturbances: int) -> pa.Schema:
    """The schema for these numbers of inputs and disturbances."""
    return pa.schema(
        [
            ("slot", pa.int64()),
            ("trial", pa.int64()),
            ("u", pa.list_(pa.float64(), inputs)),
            *([("d", pa.list_(pa.float64(), disturbances))] if disturbances else []),
            ("failed", pa.bool_()),
            ("clipped", pa.bool_()),
        ]
    )


def inputs_schema_in(path: Path) -> pa.Schema:
    """The schema that a file should have; for a file that is not such a table, one with which reading it reports that."""
    try:
        with opened(path):  # a pipe would be waited for
            pass
        schema = pq.read_schema(path)
        u, d = (int(schema.field(name).type.list_size) if name in schema.names else 0 for name in ("u", "d"))
    except Exception:  # pyarrow raises many kinds of errors for a damaged file, and the table's reader reports them
        u = d = 0
    return inputs_schema(max(1, u), d)


def input_columns(slots: Slots, plant: Plant, disturbances: Floats, first_trial: int) -> list[NDArray[Any]]:
    """A row per slot and recorded trial, from first_trial on; disturbances (slots, q) are of the whole run."""
    assert slots.inputs is not None  # noqa: S101 - asked by the caller
    recorded = next(iter(slots.receivers.values())).P.shape[3]
    u, some = slots.inputs.u[:, :, :recorded], slice(slots.first, slots.first + slots.count)
    return [
        np.repeat(np.arange(some.start, some.stop), recorded),
        np.tile(np.arange(first_trial, first_trial + recorded), slots.count),
        np.stack([plant.limited(one) for one in u]).transpose(0, 2, 1).reshape(slots.count * recorded, -1),
        *([np.repeat(disturbances[some], recorded, axis=0)] if disturbances.shape[1] else []),
        slots.inputs.failed[:, :recorded].reshape(-1),
        plant.clips(u).reshape(-1),
    ]
