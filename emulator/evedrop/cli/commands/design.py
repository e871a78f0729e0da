"""`evedrop design`: the choice of μ_d, for all slots or for each, of when to send, and of when to encrypt."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from evedrop.cli.options import as_json, changes, changes_of, command, scenario
from evedrop.cli.tables import tables
from evedrop.errors import UsageError
from evedrop.system.output import print_json


def _designs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--max-trace",
        type=float,
        metavar="Ω",
        help="find the least μ_d whose limiting trace stays below Ω; with --schedule: the trace stays within Ω in every slot",
    )
    parser.add_argument(
        "--min-ratio",
        type=float,
        metavar="R",
        help="find the cheapest μ_d at which every eavesdropper's error is at least R times the estimator's in the limit",
    )
    parser.add_argument(
        "--plot", type=Path, metavar="FILE", help="draw the errors over μ_d: a picture as .pdf, .png or .svg"
    )
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument(
        "--schedule", type=int, metavar="N", help="a μ_d for each of N slots that makes the eavesdropper's error large"
    )
    kind.add_argument(
        "--policy",
        action="store_true",
        help="when to send, for a scheme that depends on acknowledgements: the Pareto front",
    )
    kind.add_argument(
        "--budget",
        type=float,
        metavar="E",
        help="the threshold from which to encrypt, so that a slot costs an energy of at most E on average",
    )
    parser.add_argument(
        "--weight",
        type=float,
        nargs="+",
        metavar="β",
        help="weights of the legitimate error, 0 to 1 (default 0, 0.05 … 1)",
    )
    parser.add_argument("--price", type=float, nargs="+", metavar="λ", help="costs of a transmission (default 0)")
    parser.add_argument("--states", type=int, metavar="N", help="holding times that are distinguished (default 10)")
    parser.add_argument("--block", type=int, metavar="L", help="slots of --schedule that share a μ_d (default 1)")


@command((scenario, changes, _designs, as_json, tables), section="study", example="design numerical", page="design")
def design(options: argparse.Namespace) -> int:
    """Choose μ_d, or when to send or encrypt, for a scenario."""
    from evedrop.cli import api
    from evedrop.cli.design_report import print_budget, print_design, print_policies, print_schedules
    from evedrop.cli.report import terminal

    chosen = {"--policy": options.policy, "--schedule": options.schedule, "--budget": options.budget}
    kind = next((name for name, value in chosen.items() if value is not None and value is not False), None)
    given, changed = _given(options, kind), changes_of(options)
    if options.plot is not None and kind is not None:
        raise UsageError(f"--plot is for the design of μ_d, and {kind} is another; leave it out")
    if kind == "--policy":
        policies = api.design_policy(options.scenario, changes=changed, **given)
        return _show(options, policies, lambda: print_policies(policies, terminal()))
    if kind == "--schedule":
        schedules = api.design_schedule(options.scenario, options.schedule, changes=changed, **given)
        return _show(options, schedules, lambda: print_schedules(schedules, terminal()))
    if kind == "--budget":
        budget = api.design_budget(options.scenario, options.budget, changes=changed)
        return _show(options, budget, lambda: print_budget(budget, terminal()))
    designed = api.design(options.scenario, changes=changed, **given)
    if options.plot is not None:
        from evedrop.show.view.design_picture import draw_design

        draw_design(options.plot, designed)
    return _show(options, designed, lambda: print_design(designed, terminal()))


_OPTIONS: Mapping[str | None, Mapping[str, str]] = {
    None: {"max_trace": "max_trace", "min_ratio": "min_ratio"},
    "--policy": {"weight": "weights", "price": "prices", "states": "states"},
    "--schedule": {"max_trace": "max_trace", "weight": "weight", "block": "block"},
    "--budget": {},
}
"""The design asked for → the options that it takes, with their names in Python."""


class _Printable(Protocol):
    def as_dict(self) -> Mapping[str, object]: ...


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


def _show(options: argparse.Namespace, designed: _Printable, show: Callable[[], None]) -> int:
    if options.json:
        print_json(designed.as_dict())
    else:
        show()
    return 0


COMMANDS = (design,)
