"""The table of a sweep, in words.

Source: docs/montecarlo.md, sweeps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from evedrop.model.metrics import all_metrics, columns, error_column, shown_metric, z_column
from evedrop.model.metrics.text import estimate, number_text
from evedrop.show.report.text_table import TextColumn, TextTable


def sweep_table(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> TextTable:
    """A row for each point and receiver; rows: those of sweep.parquet, keys: the entries that the sweep changed."""
    metrics = columns("sweep_column")
    compared = [z_column(name) for name in all_metrics() if rows and z_column(name) in rows[0]]
    heads = [*keys, "peer", *(column.heading for column in metrics), "z", "ratio", "relative secrecy"]
    table = TextTable([TextColumn(head, head not in {"peer", "relative secrecy"}) for head in heads])
    for row in rows:
        table.add(
            *(f"{row[key]}" for key in keys),
            row["peer"],
            *(
                estimate(shown_metric(row, names), shown_metric(row, list(map(error_column, names))), column.format)
                for column, names in metrics.items()
            ),
            number_text(shown_metric(row, compared), "+.1f"),
            estimate(row.get("ratio"), row.get("ratio_standard_error"), ".3g"),
            row["relative_secrecy"] or "–",
        )
    return table
