"""`evedrop design`: the choice of μ_d, and of when to send."""

from __future__ import annotations

import argparse
import json

from evedrop.cli.options import as_json, changes, changes_of, scenario
from evedrop.command import Command
from evedrop.errors import UsageError


def design(options: argparse.Namespace) -> int:
    """Print the admissible μ_d, and the cost and secrecy of each choice; or, with --policy, the best policies of sending."""
    _check(options)
    if options.policy:
        return _policy(options)
    from evedrop.api import design as design_of
    from evedrop.cli.report import print_design

    found = design_of(options.scenario, max_trace=options.max_trace, changes=changes_of(options))
    if options.json:
        print(json.dumps(found.as_dict(), ensure_ascii=False))
    else:
        print_design(found)
    return 0


def _policy(options: argparse.Namespace) -> int:
    from evedrop.api import design_policy
    from evedrop.cli.policy_report import print_policies

    asked = {key: getattr(options, name) for name, key in _POLICY.items() if getattr(options, name) is not None}
    found = design_policy(options.scenario, changes=changes_of(options), **asked)
    if options.json:
        print(json.dumps(found.as_dict(), ensure_ascii=False))
    else:
        print_policies(found)
    return 0


_POLICY = {"weight": "weights", "price": "prices", "states": "states"}


def _check(options: argparse.Namespace) -> None:
    """Refuse options of another design than the one asked for."""
    others = ["max_trace"] if options.policy else list(_POLICY)
    for name in others:
        if getattr(options, name) is not None:
            option = f"--{name.replace('_', '-')}"
            raise UsageError(f"{option} is {'not ' if options.policy else ''}for --policy; leave one of the two out")


def _designs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--max-trace", type=float, metavar="Ω", help="find the least μ_d whose limiting trace stays below Ω"
    )
    parser.add_argument(
        "--policy",
        action="store_true",
        help="when to send, for a scheme that goes by acknowledgements: the Pareto front",
    )
    parser.add_argument(
        "--weight", type=float, nargs="+", metavar="β", help="weights of the user's error, 0 to 1 (default 0, 0.05 … 1)"
    )
    parser.add_argument("--price", type=float, nargs="+", metavar="λ", help="costs of a transmission (default 0)")
    parser.add_argument("--states", type=int, metavar="N", help="holding times that are told apart (default 10)")


COMMANDS = (
    Command(
        "design",
        design,
        "admissible μ_d, secrecy, optimum, per eavesdropper; when to send",
        (scenario, changes, _designs, as_json),
    ),
)
