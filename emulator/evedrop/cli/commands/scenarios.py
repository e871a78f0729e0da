"""The scenarios: `evedrop list`, `new`, `show` and `check`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from evedrop.cli.command import command, option, together
from evedrop.cli.options import changes, changes_of
from evedrop.counting import counted
from evedrop.errors import UsageError
from evedrop.system.output import YELLOW, tell


@command(name="list", section="make", example="list", page="scenario")
def list_scenarios(_: argparse.Namespace) -> int:
    """List built-in scenarios."""
    import tomllib

    from evedrop.cli.parser import print_names
    from evedrop.scenarios import shipped

    print_names({name: tomllib.loads(path.read_text(encoding="utf-8"))["title"] for name, path in shipped().items()})
    return 0


_ORIGIN = option("--from", "NAME", "copy this built-in scenario", dest="origin")


@command(
    (option("file", "FILE", type=Path), _ORIGIN),
    section="make",
    example="new my-scenario.toml --from vehicle",
    page="scenario",
)
def new(options: argparse.Namespace) -> int:
    """Write a scenario to start from: commented, or a copy of a built-in one."""
    from evedrop.scenarios import write_new

    write_new(options.file, options.origin)
    print(f"{options.file} written; change it, then: evedrop run {options.file}")
    return 0


_NAME = option("name", "NAME", "the name of a built-in scenario, as evedrop list prints it")


@command((_NAME,), section="make", example="show vehicle", page="scenario")
def show(options: argparse.Namespace) -> int:
    """Print the file of a built-in scenario."""
    from evedrop.scenarios import built_in_text

    print(built_in_text(options.name), end="")
    return 0


_SCENARIOS = option("scenarios", "SCENARIO", nargs="*")


_CLASSES = together(
    *(
        option(
            f"--{kind}",
            "NAME",
            f"check {subject}: MODULE:CLASS of a module in this folder or an installed one; --set gives its parameters",
        )
        for kind, subject in (
            ("scheme", "a scheme, or the scheme to check an eavesdropper with"),
            ("eavesdropper", "an eavesdropper"),
            ("link", "a loss model"),
            ("delay", "a delay model"),
        )
    )
)


@command((_SCENARIOS, changes, _CLASSES), section="make", example="check my-scenario.toml", page="scenario")
def check(options: argparse.Namespace) -> int:
    """Check scenarios or classes of your own, and start nothing."""
    from evedrop.scenario.estimates import warnings_of
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
            tell(error.illustrated, stream=sys.stderr)
            status = error.exit_status
            continue
        tell(
            f"{name}: {scenario.title}: {counted(scenario.slots, 'slot')}, {', '.join(scenario.receivers)}: no mistakes"
        )
        for warning in warnings_of(scenario, several=True):
            tell(f"  warning: {warning}", "warning:", YELLOW)
    return status


def _check_classes(names: dict[str, str], parameters: dict[str, Any]) -> int:
    from evedrop.scenario.conformance.examine import examined

    status = 0
    for examination in examined(names, parameters):
        broken = [verdict for verdict in examination.verdicts if verdict.broken is not None]
        rules = len(examination.verdicts)
        result = f"{len(broken)} of {rules} rules are broken" if broken else f"all {rules} rules hold"
        print(f"{examination.title}: {result}")
        for verdict in examination.verdicts:
            tell(f"  {'ok' if verdict.broken is None else 'BROKEN':<8}{verdict.rule}", "BROKEN")
            if verdict.broken is not None:
                tell(f"          {verdict.broken}")
        status = UsageError.exit_status if broken else status
    return status


COMMANDS = (list_scenarios, show, new, check)
