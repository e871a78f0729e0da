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

    _, found = studied(options, secrecy_cost)
    if options.json:
        print_json(asdict(found))
    else:
        _print(found)
    return 0


def _print(found: SecrecyCost) -> None:
    """Print the table."""
    from evedrop.cli.report import terminal
    from evedrop.show.report.text_table import TextTable

    names = {"scheme": found.scheme, "plain": "plain", "truth": "the truth"}
    heads = ("mean", "standard error", "95 % interval")
    table = TextTable.headed([""], heads, wrapped=["", *heads])
    for name, one in found.more_than_plain.items():
        table.add(f"{name.replace('_', ' ')}: {found.scheme} less plain", *_cells(one, 1.0, " Wh"))
    for pair, measures in found.differences.items():
        ours, _, theirs = pair.partition("_from_")
        for measure, one in measures.items():
            table.add(f"{measure}: {names[ours]} from {names[theirs]}", *_cells(one, 100.0, " %"))
    console = terminal()
    console.print(
        f"{found.trials} days, each with {found.scheme} and with plain, over the same link and with the same noise"
    )
    console.show(table)


def _cells(one: MeanEstimate, scale: float, unit: str) -> tuple[str, str, str]:
    mean, low, high = (number_text(scale * value, ".3g") for value in (one.mean, one.low, one.high))
    error = ShownNumber(f"{float(f'{scale * one.standard_error:.3g}'):.2g}", scale * one.standard_error)
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
