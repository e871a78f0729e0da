"""The plot of a sweep over a house: energy bought and sold, the effect of perfect knowledge, and what receivers can infer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa

from evedrop.model.metrics import error_column
from evedrop.results.tables import swept_strategies
from evedrop.show.view.figure_style import GREY, OCHRE, SLATE, panels
from evedrop.show.view.palette import paper_inks

_MARKS = "osD^v"
_LIMIT = 1.58  # per cent, the paper's bound on the difference of its grid power


def draw(path: Path, table: pa.Table, key: str) -> None:
    """Draw `path`.png and `path`.pdf against the values of one entry; for other entries, only the first values are shown."""
    rows = _of_one_line(table.to_pylist(), key)
    peers = list(dict.fromkeys(row["peer"] for row in rows))
    inks = paper_inks(peers, swept_strategies(table))
    mine = {peer: [row for row in rows if row["peer"] == peer] for peer in peers}
    house = mine[peers[0]]
    numbers = all(isinstance(row[key], (int, float)) for row in house)
    x = [float(row[key]) if numbers else float(i) for i, row in enumerate(house)]
    place = dict(zip((row[key] for row in house), x, strict=True))
    with panels(path, 3, 12.6, 3.9) as (energies, fractions, told):
        for name, colour, mark in (("bought", SLATE, "o"), ("sold", OCHRE, "s")):
            bars = _bars(house, f"{name}_energy")
            energies.errorbar(
                x, [row[f"{name}_energy"] for row in house], bars, fmt=f"{mark}-", color=colour, label=name
            )
        energies.set_ylabel("energy (kWh)")
        energies.set_ylim(bottom=0.0)
        energies.set_title("(a) energy")
        for name, colour, mark in (("net", SLATE, "o"), ("total", OCHRE, "s"), ("summed", GREY, "D")):
            result = [row[f"{name}_difference"] for row in house]
            percent = [
                float("nan") if difference is None or difference <= 0.0 else 100.0 * difference for difference in result
            ]
            bars = [100.0 * difference for difference in _bars(house, f"{name}_difference")]
            fractions.errorbar(x, percent, bars, fmt=f"{mark}-", color=colour, label=name)
        fractions.axhline(_LIMIT, color=GREY, linewidth=0.9, linestyle=":", label=f"the paper: {_LIMIT} %")
        fractions.set_yscale("log")
        fractions.set_ylabel("difference of grid power (%)")
        fractions.set_title("(b) from a controller that sees the truth")
        for peer, mark in zip(peers, _MARKS * len(peers), strict=False):
            areas = [float("nan") if row["activity_area"] is None else row["activity_area"] for row in mine[peer]]
            here = [place[row[key]] for row in mine[peer]]  # not at every point if the eavesdroppers are swept
            told.errorbar(here, areas, _bars(mine[peer], "activity_area"), fmt=f"{mark}-", color=inks[peer], label=peer)
        told.axhline(0.5, color=GREY, linewidth=0.9, linestyle=":", label="a coin")
        told.set_ylim(min(0.4, told.get_ylim()[0]), 1.02)
        told.set_ylabel("area under the curve")
        told.set_title("(c) who can tell when somebody is at it")
        for axes in (energies, fractions, told):
            axes.set_xlabel(key)
            axes.set_xlim(fractions.get_xlim())
            if not numbers:
                axes.set_xticks(x, [str(row[key]) for row in house])
            axes.legend()


def _bars(rows: list[dict[str, Any]], column: str) -> list[float]:
    """The standard errors of a column; NaN, which draws nothing, where a row has none."""
    errors = (row[error_column(column)] for row in rows)
    return [float("nan") if error is None else error for error in errors]


def _of_one_line(rows: list[dict[str, Any]], key: str) -> list[dict[str, Any]]:
    """The rows of each peer that differ in the entry, without repetitions that differ only in others."""
    first: dict[tuple[Any, Any], dict[str, Any]] = {}
    for row in rows:
        first.setdefault((row[key], row["peer"]), row)
    return list(first.values())
