"""The terminal output of `evedrop design --budget`: thresholds with their energy and errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from evedrop.cli.report import left_out_line, terminal
from evedrop.model.metrics.text import finite_text, number_text
from evedrop.show.report.text_table import TextTable

if TYPE_CHECKING:
    from evedrop.scenario.expected.energy_budget import BudgetDesign


def print_budget(design: BudgetDesign) -> None:
    """Print the thresholds as a table, the one for the budget among them."""
    console = terminal()
    console.print(
        f"an unencrypted packet costs {design.unencrypted:g}, an encrypted one {design.encrypted:g}; errors are traces in the "
        f"limit; the user's is {finite_text(design.user)}"
    )
    names = list(design.best.eavesdroppers)
    errors = [f"error of {name}" for name in names]
    shown = TextTable.headed([], ["threshold θ", "encrypted", "energy", *errors], [""])
    for choice in sorted({round(each.threshold, 9): each for each in (*design.others, design.best)}.items()):
        metrics = choice[1]
        shown.add(
            number_text(metrics.threshold, ".6g"),
            number_text(metrics.encrypted_fraction, ".4f"),
            number_text(metrics.energy, ".6g"),
            *(finite_text(metrics.eavesdroppers[name]) for name in names),
            "the budget's" if metrics is design.best else "",
        )
    console.show(shown)
    if design.left_out:
        console.print(left_out_line(design.left_out, "no closed form of its error is known under this scheme"))
    console.print(f"threshold = {design.best.threshold!r}")
