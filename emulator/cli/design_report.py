"""The design of μ_d on the terminal."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.table import Table

from evedrop.cli.report import terminal
from evedrop.figures.text import finite_text

if TYPE_CHECKING:
    from evedrop.model.theory.design import Design


def print_design(design: Design) -> None:
    """Print a design as text: bounds, intervals, optima and the price of secrecy."""
    console = terminal()
    console.print(f"spectral radius {design.rho:.6g}; legitimate link quality μ = {design.mu:g}")
    if design.remark is not None:
        console.print(design.remark)
    else:
        found = "error is unbounded"
        if math.isfinite(design.trace):
            found = (
                f"trace is {design.trace:.4g}, {design.cost:.3g} times that of sending every state "
                f"({design.plain_trace:.4g})"
            )
        console.print(
            f"admissible: {design.bound:.6g} < μ_d ≤ 1; at this scenario's μ_d = {design.mu_d:g} the legitimate {found}"
        )
    if design.minimum is not None:
        console.print(f"least μ_d for the wanted trace: {design.minimum:.6g}")
    table = Table(box=SIMPLE_HEAD)
    table.add_column("against", no_wrap=True)
    for head in (
        "bounded from",
        "perfect secrecy",
        "relative secrecy",
        "best J_r",
        "best J_r/J",
        "its trace",
        "holds from slot",
    ):
        table.add_column(head, justify="right", no_wrap=True)
    for name, against in design.eavesdroppers.items():
        table.add_row(
            name,
            finite_text(against.bound, ".6g"),
            "none" if against.perfect is None else _half_open(against.perfect, against.bound),
            "none"
            if not against.relative
            else " ∪ ".join(f"({low:.5f}, {high:.5f})" for low, high in against.relative),
            "–" if against.best_difference is None else f"{against.best_difference:.5f}",
            "–" if against.best_ratio is None else f"{against.best_ratio:.5f}",
            finite_text(against.trace, ".6g"),
            "–" if against.relative_from is None else str(against.relative_from),
        )
    console.print(table)
    if design.omission is not None:
        console.print(design.omission)


def _half_open(interval: tuple[float, float], bound: float) -> str:
    """The interval of perfect secrecy; closed at its upper end, unless that is 1 and the error is bounded there."""
    low, high = interval
    return f"({low:.5f}, {high:.5f}{')' if high == bound == 1.0 else ']'}"
