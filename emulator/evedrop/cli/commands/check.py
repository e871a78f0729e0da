"""`evedrop check`: validates scenarios, or checks classes of a user's own against the rules."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from evedrop.cli.command import Command
from evedrop.cli.options import changes, changes_of
from evedrop.errors import UsageError


def check(options: argparse.Namespace) -> int:
    """Validate scenarios, or check classes against the rules."""
    from evedrop.scenario.expected.estimates import warnings_of
    from evedrop.scenario.loading import load

    names = {kind: name for kind in ("scheme", "eavesdropper", "link", "delay") if (name := getattr(options, kind))}
    if bool(names) == bool(options.scenarios):
        raise UsageError("check: expected scenarios, or classes by --scheme, --eavesdropper, --link or --delay")
    if names:
        return _check_classes(names, changes_of(options))
    status = 0
    for name in options.scenarios:
        try:
            scenario = load(name, changes_of(options))
        except UsageError as error:
            print(error, file=sys.stderr)
            status = error.exit_status
            continue
        print(f"{name}: {scenario.title}: {scenario.slots} slots, {', '.join(scenario.receivers)}: no mistakes")
        for warning in warnings_of(scenario):
            print(f"  warning: {warning}")
    return status


def _check_classes(names: dict[str, str], parameters: dict[str, Any]) -> int:
    from evedrop.scenario.conformance.examine import examined

    status = 0
    for examination in examined(names, parameters):
        broken = [verdict for verdict in examination.verdicts if verdict.broken is not None]
        print(
            f"{examination.title}: {f'{len(broken)} broken' if broken else 'all'} of {len(examination.verdicts)} rules"
            + ("" if broken else " kept")
        )
        for verdict in examination.verdicts:
            print(f"  {'ok' if verdict.broken is None else 'BROKEN':<8}{verdict.rule}")
            if verdict.broken is not None:
                print(f"          {verdict.broken}")
        status = UsageError.exit_status if broken else status
    return status


def _scenarios(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO")


def _classes(parser: argparse.ArgumentParser) -> None:
    for kind, subject in (
        ("scheme", "a scheme, or the scheme to check an eavesdropper with"),
        ("eavesdropper", "an eavesdropper"),
        ("link", "a loss model"),
        ("delay", "a delay model"),
    ):
        text = (
            f"check {subject}: MODULE:CLASS of a module in this folder or an installed one; --set gives its parameters"
        )
        parser.add_argument(f"--{kind}", metavar="NAME", help=text)


COMMANDS = (
    Command(
        "check",
        check,
        "check scenarios or classes of your own, and start nothing",
        (_scenarios, changes, _classes),
        section="make",
        example="check my-scenario.toml",
        page="scenario",
    ),
)
