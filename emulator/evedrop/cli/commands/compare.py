"""`evedrop compare`: schemes against adversaries."""

from __future__ import annotations

import argparse
from pathlib import Path

from evedrop.cli.command import Command
from evedrop.cli.in_memory import check_resuming, crew, plan_of, resuming
from evedrop.cli.options import changes_of, entries, output, scenario
from evedrop.cli.tables import tables
from evedrop.errors import UsageError
from evedrop.system.output import print_json


def compare(options: argparse.Namespace) -> int:
    """Compare schemes against adversaries."""
    from evedrop.cli.api import compare as compare_all
    from evedrop.cli.closing_report import report_page
    from evedrop.cli.comparison_report import print_comparison
    from evedrop.cli.progress_line import ProgressLine
    from evedrop.results.folder import results_folder
    from evedrop.results.summary_file import plain
    from evedrop.scenario.loading import value_of

    check_resuming(options)
    changes = changes_of(options)
    parameters = {}
    for text in options.parameters:
        key, equals, value = text.partition("=")
        if not equals:
            raise UsageError(
                f"--with {text}: expected SCHEME.PARAMETER=VALUE, such as innovation.state_probability=0.7"
            )
        parameters[key] = value_of(value)
    with (
        results_folder(options.out, f"compare-{Path(options.scenario).name}") as folder,
        ProgressLine(None, "trial-slots", options.json) as line,
    ):
        comparison = compare_all(
            options.scenario,
            schemes=_names(options.schemes),
            adversaries=_names(options.adversaries),
            parameters=parameters,
            out=folder,
            resume=options.resume,
            plan=plan_of(options),
            on_event=line.on_event,
            **{"trials": 200, **changes},
        )
    if options.json:
        print_json(plain(comparison.as_dict()))
    else:
        print_comparison(comparison, str(folder))
    report_page(folder, options.json)
    return 0


def _names(listed: str | None) -> list[str] | None:
    return None if listed is None else [name.strip() for name in listed.split(",")]


def _compares(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--schemes", metavar="A,B", help="default all that the process allows")
    parser.add_argument("--adversaries", metavar="X,Y", help="default all but learners, which take long")
    parser.add_argument(
        "--with",
        dest="parameters",
        action="append",
        default=[],
        metavar="SCHEME.PARAMETER=VALUE",
        help="a parameter of a scheme other than the scenario's own; repeatable",
    )


COMMANDS = (
    Command(
        "compare",
        compare,
        "compare schemes, each against all adversaries, in memory",
        (scenario, entries, output, _compares, crew, resuming, tables),
        section="study",
        example="compare vehicle --trials 100",
        page="compare",
    ),
)
