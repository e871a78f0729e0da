"""The table of a sweep, in words.

Source: docs/montecarlo.md, sweeps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from evedrop.model.figures import all_figures, columns, error_column, shown_figure, z_column
from evedrop.model.figures.text import estimate, figure_text
from evedrop.show.report.text_table import TextColumn, TextTable


def sweep_table(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> TextTable:
    """A row for each point and receiver; rows: those of sweep.parquet, keys: the entries that the sweep changed."""
    figures = columns("sweep_column")
    compared = [z_column(name) for name in all_figures() if rows and z_column(name) in rows[0]]
    heads = [*keys, "peer", *(column.heading for column in figures), "z", "ratio", "relative secrecy"]
    table = TextTable([TextColumn(head, head not in {"peer", "relative secrecy"}) for head in heads])
    for row in rows:
        table.add(
            *(f"{row[key]}" for key in keys),
            row["peer"],
            *(
                estimate(shown_figure(row, names), shown_figure(row, list(map(error_column, names))), column.format)
                for column, names in figures.items()
            ),
            figure_text(shown_figure(row, compared), "+.1f"),
            estimate(row.get("ratio"), row.get("ratio_standard_error"), ".3g"),
            row["relative_secrecy"] or "–",
        )
    return table
