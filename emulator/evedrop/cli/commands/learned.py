"""`evedrop learned`: how much learning eavesdroppers know of the process by a slot, and how that affects their error."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import TYPE_CHECKING

from evedrop.cli.command import Command
from evedrop.cli.in_memory import crew, keeping, studied
from evedrop.cli.options import as_json, entries, scenario
from evedrop.cli.tables import tables
from evedrop.model.metrics.text import ShownNumber, number_text
from evedrop.system.output import print_json

if TYPE_CHECKING:
    from evedrop.studies.learning_curve import LearningRow

_ROUNDING = 1e-12  # a standard error that is smaller, over the mean, is rounding


def learned(options: argparse.Namespace) -> int:
    """Print what has been learned after 8, 16, 32, … slots."""
    from evedrop.studies.learning_curve import learning_curve

    scenario, rows = studied(options, learning_curve)
    if options.json:
        print_json([asdict(row) for row in rows])
    else:
        _print(rows, scenario.trials)
    return 0


def _print(rows: list[LearningRow], trials: int) -> None:
    """Print both tables."""
    from evedrop.cli.report import terminal
    from evedrop.show.report.text_table import TextTable

    console = terminal()
    console.print(
        f"{trials} trials: the error of each estimate over the truth, median over trials (mean ± standard error)"
    )
    heads = ["slots", "learner", "A", "Q", "μ_d"]
    table = TextTable.headed([], heads, wrapped=heads)
    for row in rows:
        for learner, values in row.parameters.items():
            cells = (
                number_text(measured.median, ".3g") + f" ({_with_error(measured.mean, measured.standard_error)})"
                for measured in values.values()
            )
            table.add(str(row.stop), learner, *cells)
    console.show(table)
    console.print("mean |x − x̂|² of the slots between, ± standard error, and the learner's over it")
    ratios_of = [f"{name} / it" for name in rows[0].parameters]
    heads = ["from slot", "before", "receiver", "mean |x − x̂|²", *ratios_of]
    table = TextTable.headed([], heads, wrapped=heads)
    for row in rows:
        for name, error in row.errors.items():
            ratios = (measured.get(name) for measured in row.ratios.values())
            cells = (
                ShownNumber("", None) if measured is None else _with_error(measured.ratio, measured.standard_error)
                for measured in ratios
            )
            table.add(str(row.first), str(row.stop), name, _with_error(error, row.standard_errors[name]), *cells)
    console.show(table)


def _with_error(value: float, error: float | None) -> ShownNumber:
    if error is None:
        return number_text(value, ".3g")
    return ShownNumber(f"{value:.3g} ± {error if error > _ROUNDING * abs(value) else 0.0:.1g}", value, error)


COMMANDS = (
    Command(
        "learned",
        learned,
        "show what eavesdroppers that learn the process know, slot by slot",
        (scenario, entries, as_json, keeping, crew, tables),
        section="study",
        example="learned learning --trials 20",
        page="learning",
    ),
)
