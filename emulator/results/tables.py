"""The columns of the tables in a results folder.

Source: docs/results.md, tables.
"""

from __future__ import annotations

import pyarrow as pa

from evedrop.model.digest import DIGEST_BYTES
from evedrop.model.links.link import REASONS
from evedrop.score.histogram import LEVELS

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
"""A receiver's actions as the observer knows them: `misled` is an innovation used as the state."""
SENT = ("state", "innovation", "nothing")
"""The kinds of packet."""


NULLABLE = {
    "mean_squared_error",
    "mean_actual_trace_covariance",
    "expected_trace_covariance",
    *(field.name for field in SLOTS if "quantile" in field.name),
}
"""Columns in which NaN means that there is no value."""


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
