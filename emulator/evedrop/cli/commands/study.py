"""The studies in memory: `evedrop montecarlo`, `sweep`, `compare`, `cost` and `learned`."""

from __future__ import annotations

import argparse
import itertools
import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.cli.command import command, flag, option, together
from evedrop.cli.in_memory import MEMORY, check_resuming, crew, default_trials, keeping, plan_of, resuming, studied
from evedrop.cli.options import (
    as_json,
    changes_of,
    entries,
    loaded,
    output,
    over_wire,
    print_so_far,
    scenario,
    tables,
    verbose,
)
from evedrop.counting import counted
from evedrop.errors import Interrupted, UsageError
from evedrop.model.metrics.text import ShownNumber, finite_text, number_text
from evedrop.system.output import print_json

if TYPE_CHECKING:
    from evedrop.studies.learning_curve import LearningRow
    from evedrop.studies.secrecy_cost import MeanEstimate, SecrecyCost


_RARE = flag(
    "--rare",
    "also estimate the mean errors that rare events carry: split trials with large errors (docs/montecarlo.md)",
)


@command(
    (scenario, over_wire, *MEMORY, verbose, _RARE, tables),
    section="run",
    example="montecarlo vehicle --trials 200",
    page="montecarlo",
)
def montecarlo(options: argparse.Namespace) -> int:
    """Simulate the trials of a scenario in memory (1000 unless told otherwise)."""
    from evedrop.cli.console import ProgressLine
    from evedrop.results.folder import results_folder
    from evedrop.simulate.montecarlo import simulate

    check_resuming(options)
    default_trials(options, 1000)
    plan = plan_of(options)
    scenario = loaded(options, beyond_horizon=options.mode != "exact")
    with results_folder(options.out, options.scenario) as folder:
        with ProgressLine(scenario.trials * scenario.slots, "trial-slots", options.json) as line:
            try:
                status = simulate(scenario, folder, line.on_event, plan, resume=options.resume)
            except Interrupted as error:
                print_so_far(line.moved or folder, options, error.exit_status, error)
                raise
        print_so_far(line.moved or folder, options, status)
    return status


_OVER = option(
    "--over",
    "KEY=VALUES",
    "an entry and its values, first:last:step or a,b,c; repeatable",
    action="append",
    required=True,
)


@command(
    (scenario, _OVER, *MEMORY, tables),
    section="study",
    example="sweep numerical --over encoding.state_probability=0.6,0.7,0.8",
    page="montecarlo",
)
def sweep(options: argparse.Namespace) -> int:
    """Simulate a scenario in memory over a grid of values."""
    from evedrop.cli.console import ProgressLine
    from evedrop.cli.report import print_sweep, report_page
    from evedrop.results.folder import results_folder
    from evedrop.results.summary_file import plain
    from evedrop.studies.sweep import grid_of, sweep_over

    check_resuming(options)
    default_trials(options, 1000)
    grid = grid_of(options.over)
    plan = plan_of(options)
    with (
        results_folder(options.out, f"{Path(options.scenario).stem}-sweep") as folder,
        ProgressLine(None, "trial-slots", options.json) as line,
    ):
        table = sweep_over(
            options.scenario, changes_of(options), grid, folder, line.on_event, plan, resume=options.resume
        )
    if options.json:
        print_json(plain(table.to_pylist()))
    else:
        print_sweep(table, tuple(grid), str(folder))
    report_page(folder, options.json)
    return 0


_COMPARES = together(
    option("--schemes", "A,B", "default all that the process allows"),
    option("--adversaries", "X,Y", "default all but learners, which take long"),
    option(
        "--with",
        "SCHEME.PARAMETER=VALUE",
        "a parameter of a scheme other than the scenario's own; repeatable",
        dest="parameters",
        action="append",
        default=[],
    ),
)


@command(
    (scenario, entries, output, verbose, _COMPARES, crew, resuming, tables),
    section="study",
    example="compare vehicle --trials 100",
    page="compare",
)
def compare(options: argparse.Namespace) -> int:
    """Compare schemes, each against all adversaries, in memory."""
    from evedrop.cli.console import ProgressLine
    from evedrop.cli.report import print_comparison, report_page
    from evedrop.results.folder import results_folder
    from evedrop.results.summary_file import plain
    from evedrop.scenario.loading import value_of
    from evedrop.studies.compare import compare_all
    from evedrop.studies.matchups import matchups_of

    check_resuming(options)
    default_trials(options, 200)
    parameters = {}
    for text in options.parameters:
        key, equals, value = text.partition("=")
        if not equals:
            raise UsageError(
                f"--with {text}: expected SCHEME.PARAMETER=VALUE, such as innovation.state_probability=0.7"
            )
        parameters[key] = value_of(value)
    plan = plan_of(options)
    matchups = matchups_of(loaded(options), _names(options.schemes), _names(options.adversaries), parameters)
    with (
        results_folder(options.out, f"compare-{Path(options.scenario).name}") as folder,
        ProgressLine(None, "trial-slots", options.json) as line,
    ):
        comparison = compare_all(matchups, folder, line.on_event, plan, resume=options.resume)
    if options.json:
        print_json(plain(comparison.as_dict()))
    else:
        print_comparison(comparison, str(folder), options.verbose)
    report_page(folder, options.json)
    return 0


def _names(listed: str | None) -> list[str] | None:
    return None if listed is None else [name.strip() for name in listed.split(",")]


@command(
    (scenario, entries, as_json, keeping, crew, tables), section="study", example="cost microgrid", page="microgrid"
)
def cost(options: argparse.Namespace) -> int:
    """Compute the energy that secrecy costs a house."""
    from evedrop.results.summary_file import plain
    from evedrop.studies.secrecy_cost import secrecy_cost

    _, result = studied(options, secrecy_cost)
    if options.json:
        print_json(plain(asdict(result)))
    else:
        _print_cost(result)
    return 0


def _print_cost(reproduction: SecrecyCost) -> None:
    """Print the table."""
    from evedrop.cli.report import terminal
    from evedrop.show.report.text_table import TextTable

    names = {"scheme": reproduction.scheme, "plain": "plain", "truth": "the truth"}
    heads = ("mean", "standard error", "95 % from", "to")
    table = TextTable.headed([""], heads, wrapped=["", *heads])
    for name, measured in reproduction.more_than_plain.items():
        table.add(f"{name.replace('_', ' ')}: {reproduction.scheme} less plain", *_cells(measured, 1.0, " Wh"))
    for pair, measures in reproduction.differences.items():
        ours, _, theirs = pair.partition("_from_")
        for measure, measured in measures.items():
            table.add(f"{measure}: {names[ours]} from {names[theirs]}", *_cells(measured, 100.0, " %"))
    console = terminal()
    console.say(
        f"{reproduction.trials} trials, each with {reproduction.scheme} and with plain, over the same link, with the same noise"
    )
    console.show(table)


def _cells(estimate: MeanEstimate, scale: float, unit: str) -> tuple[str, str, str, str]:
    if not math.isfinite(estimate.mean):  # a fraction of an energy that is 0
        dash = number_text(None)
        return dash if math.isnan(estimate.mean) else finite_text(estimate.mean) + unit, dash, dash, dash
    mean, low, high = (number_text(scale * value, ".3g") for value in (estimate.mean, estimate.low, estimate.high))
    error = ShownNumber(f"{float(f'{scale * estimate.standard_error:.3g}'):.2g}", scale * estimate.standard_error)
    return mean + unit, error, low + unit, high + unit


_ROUNDING = 1e-12  # a standard error that is smaller, over the mean, is rounding


@command(
    (scenario, entries, as_json, keeping, crew, tables),
    section="study",
    example="learned learning --trials 20",
    page="learning",
)
def learned(options: argparse.Namespace) -> int:
    """Show what eavesdroppers that learn the process know after 8, 16, 32 … slots."""
    from evedrop.results.summary_file import plain
    from evedrop.studies.learning_curve import learning_curve

    scenario, rows = studied(options, learning_curve)
    if options.json:
        print_json(plain([asdict(row) for row in rows]))
    else:
        _print_learned(rows, scenario.trials)
    return 0


def _print_learned(rows: list[LearningRow], trials: int) -> None:
    """Print both tables."""
    from evedrop.cli.report import terminal
    from evedrop.show.report.text_table import TextTable

    console = terminal()
    console.say(
        f"{counted(trials, 'trial')}: the error of each estimate over the truth, median over trials, and mean ± standard error"
    )
    heads = ["slots", "learner", *(head for name in ("A", "Q", "μ_d") for head in (name, f"mean {name}"))]
    table = TextTable.headed([], heads, wrapped=heads)
    for row in rows:
        for learner, values in row.parameters.items():
            pairs = (
                (number_text(measured.median, ".3g"), _with_error(measured.mean, measured.standard_error))
                for measured in values.values()
            )
            table.add(str(row.stop), learner, *itertools.chain.from_iterable(pairs))
    console.show(table)
    console.say("mean |x − x̂|² of the slots between, ± standard error, and the learner's over it")
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


COMMANDS = (montecarlo, sweep, compare, cost, learned)
