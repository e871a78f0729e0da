"""`evedrop design`: the choice of μ_d, for all slots or for each, of when to send, and of when to encrypt."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evedrop.cli.command import command, flag, one_of, option, together
from evedrop.cli.options import as_json, changes, changes_of, scenario, tables
from evedrop.errors import UsageError
from evedrop.system.output import print_json

if TYPE_CHECKING:
    from evedrop.model.theory.design import Design
    from evedrop.model.theory.schedules import ScheduleDesign
    from evedrop.scenario.designs import BudgetDesign, PolicyDesign


_DESIGNS = together(
    option(
        "--max-trace",
        "Ω",
        "find the least μ_d whose limiting trace stays below Ω; with --schedule: the trace stays within Ω in every slot",
        type=float,
    ),
    option(
        "--min-ratio",
        "R",
        "find the cheapest μ_d at which every eavesdropper's error is at least R times the estimator's in the limit",
        type=float,
    ),
    option("--plot", "FILE", "draw the errors over μ_d: a picture as .pdf, .png or .svg", type=Path),
    one_of(
        option("--schedule", "N", "a μ_d for each of N slots that makes the eavesdropper's error large", type=int),
        flag("--policy", "when to send, for a scheme that depends on acknowledgements: the Pareto front"),
        option(
            "--budget",
            "E",
            "the threshold from which to encrypt, so that a slot costs an energy of at most E on average",
            type=float,
        ),
    ),
    option("--weight", "β", "weights of the legitimate error, 0 to 1 (default 0, 0.05 … 1)", type=float, nargs="+"),
    option("--price", "λ", "costs of a transmission (default 0)", type=float, nargs="+"),
    option("--states", "N", "holding times that are distinguished (default 10)", type=int),
    option("--block", "L", "slots of --schedule that share a μ_d (default 1)", type=int),
)


@command((scenario, changes, _DESIGNS, as_json, tables), section="study", example="design numerical", page="design")
def design(options: argparse.Namespace) -> int:
    """Choose μ_d, or when to send or encrypt, for a scenario."""
    from evedrop.cli import api
    from evedrop.cli.design_report import print_designed
    from evedrop.cli.report import terminal

    asked = {"--policy": options.policy, "--schedule": options.schedule, "--budget": options.budget}
    kind = next((name for name, value in asked.items() if value is not None and value is not False), None)
    given = {**_given(options, kind), "changes": changes_of(options)}
    if options.plot is not None and kind is not None:
        raise UsageError(f"--plot is for the design of μ_d, and {kind} is another; leave it out")
    designed: Design | PolicyDesign | ScheduleDesign | BudgetDesign
    if kind == "--policy":
        designed = api.design_policy(options.scenario, **given)
    elif kind == "--schedule":
        designed = api.design_schedule(options.scenario, options.schedule, **given)
    elif kind == "--budget":
        designed = api.design_budget(options.scenario, options.budget, **given)
    else:
        designed = api.design(options.scenario, **given)
        if options.plot is not None:
            from evedrop.show.view.design_picture import draw_design

            draw_design(options.plot, designed)
    if options.json:
        print_json(designed.as_dict())
    else:
        print_designed(designed, terminal())
    return 0


_OPTIONS: Mapping[str | None, Mapping[str, str]] = {
    None: {"max_trace": "max_trace", "min_ratio": "min_ratio"},
    "--policy": {"weight": "weights", "price": "prices", "states": "states"},
    "--schedule": {"max_trace": "max_trace", "weight": "weight", "block": "block"},
    "--budget": {},
}
"""The design asked for → the options that it takes, with their names in Python."""


def _given(options: argparse.Namespace, kind: str | None) -> dict[str, Any]:
    """The options of a design that were given, by their names in Python. Raises UsageError for those of another one."""
    takes = _OPTIONS[kind]
    for name in sorted({name for names in _OPTIONS.values() for name in names}):
        if getattr(options, name) is not None and name not in takes:
            able = [f"{kind_ or 'the design of μ_d'}" for kind_, names in _OPTIONS.items() if name in names]
            raise UsageError(f"--{name.replace('_', '-')} is for {' and '.join(able)}; leave it out")
    given = {python: getattr(options, name) for name, python in takes.items() if getattr(options, name) is not None}
    if kind == "--schedule" and "weight" in given:
        if len(given["weight"]) > 1:
            raise UsageError("--weight takes one number for --schedule")
        (given["weight"],) = given["weight"]
    return given


COMMANDS = (design,)
