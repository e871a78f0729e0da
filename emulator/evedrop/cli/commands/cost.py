"""`evedrop cost`: the energy that secrecy costs."""

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
    from evedrop.studies.secrecy_cost import MeanEstimate, SecrecyCost


def cost(options: argparse.Namespace) -> int:
    """Compare a scenario's scheme with `plain`, trial by trial."""
    from evedrop.studies.secrecy_cost import secrecy_cost

    _, result = studied(options, secrecy_cost)
    if options.json:
        print_json(asdict(result))
    else:
        _print(result)
    return 0


def _print(reproduction: SecrecyCost) -> None:
    """Print the table."""
    from evedrop.cli.report import terminal
    from evedrop.show.report.text_table import TextTable

    names = {"scheme": reproduction.scheme, "plain": "plain", "truth": "the truth"}
    heads = ("mean", "standard error", "95 % interval")
    table = TextTable.headed([""], heads, wrapped=["", *heads])
    for name, measured in reproduction.more_than_plain.items():
        table.add(f"{name.replace('_', ' ')}: {reproduction.scheme} less plain", *_cells(measured, 1.0, " Wh"))
    for pair, measures in reproduction.differences.items():
        ours, _, theirs = pair.partition("_from_")
        for measure, measured in measures.items():
            table.add(f"{measure}: {names[ours]} from {names[theirs]}", *_cells(measured, 100.0, " %"))
    console = terminal()
    console.print(
        f"{reproduction.trials} days, each with {reproduction.scheme} and with plain, over the same link and with the same noise"
    )
    console.show(table)


def _cells(estimate: MeanEstimate, scale: float, unit: str) -> tuple[str, str, str]:
    mean, low, high = (number_text(scale * value, ".3g") for value in (estimate.mean, estimate.low, estimate.high))
    error = ShownNumber(f"{float(f'{scale * estimate.standard_error:.3g}'):.2g}", scale * estimate.standard_error)
    return mean + unit, error, f"{low} to {high}{unit}"


COMMANDS = (
    Command(
        "cost",
        cost,
        "compute the energy that secrecy costs a house",
        (scenario, entries, as_json, keeping, crew, tables),
        section="study",
        example="cost microgrid",
        page="microgrid",
    ),
)
