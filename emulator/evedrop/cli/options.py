"""Shared by several commands: options, the scenario with its changes, and the report of a run.

Slow imports are made only when they are needed, so that `evedrop --help` and a peer start quickly.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evedrop.errors import UsageError
from evedrop.system.output import warn

if TYPE_CHECKING:
    from evedrop.scenario.tables import Scenario
    from evedrop.show.view.viewer import Viewer


Option = Callable[[argparse.ArgumentParser], None]
"""A function that adds an option, or several, to a command's parser."""


@dataclass(frozen=True)
class Command:
    """A command: its name, the function that carries it out, its description, and its options."""

    name: str
    run: Callable[[argparse.Namespace], int]
    """Takes the options, and returns the exit status. Slow imports belong inside: all commands are loaded for `--help`."""
    does: str
    """In a few words, for `--help`."""
    options: tuple[Option, ...] = ()
    group: str | None = None
    """The word before its name, such as `links` in `links fit`; None if it has no such word."""
    section: str = "other commands"
    """The title under which `--help` lists it."""
    example: str = ""
    """A command line that shows its use, without the program's name."""
    page: str = ""
    """The page of the documentation about it, such as `links`, as `evedrop docs` knows it."""


def command(
    options: tuple[Option, ...] = (), name: str = "", **more: str
) -> Callable[[Callable[[argparse.Namespace], int]], Command]:
    """Make a command of a function, with its name unless another is given; its docstring says what the command does.

    more: other entries of `Command`.
    """

    def made(run: Callable[[argparse.Namespace], int]) -> Command:
        sentence = str(run.__doc__).partition("\n")[0]
        does = f"{sentence[0].lower()}{sentence[1:].removesuffix('.')}"
        return Command(name or run.__name__, run, does, options, **more)

    return made


_SET_HELP = "change an entry of the scenario by its dotted key; the value is read as TOML, else as a string; repeatable"


def option(*names: str, **how: Any) -> Option:
    """An option, or an argument, as `ArgumentParser.add_argument` takes it."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(*names, **how)

    return add


def number_type(least: float, most: float, words: str) -> Callable[[str], float]:
    """The type of an option that is a number from `least` to `most`; words: what it must be, for the message."""

    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{text} is not {words}")
        return value

    return number


scenario = option("scenario", metavar="SCENARIO", help="a built-in scenario, a file, or a results folder")
changes = option("--set", dest="changes", action="append", default=[], metavar="KEY=VALUE", help=_SET_HELP)


def entries(parser: argparse.ArgumentParser) -> None:
    """Add `--set`, and an option for each of the entries that are changed most often."""
    changes(parser)
    for name, help_text in (
        ("seed", "seed of all random numbers"),
        ("slots", "number of slots"),
        ("trials", "number of trials"),
        ("first-trial", "number of the first trial"),
        ("record-trials", "how many trials are recorded in full"),
    ):
        parser.add_argument(f"--{name}", type=int, metavar="N", help=help_text)
    parser.add_argument("--pace", type=float, metavar="SECONDS", help="seconds per slot; 0 = as fast as possible")
    parser.add_argument("--secret", type=Path, metavar="FILE", help="a secret that is not derived from the seed")


def output(parser: argparse.ArgumentParser) -> None:
    """Add the options for the results folder and for JSON."""
    parser.add_argument("--out", type=Path, metavar="DIR", help="results folder, new or empty")
    as_json(parser, "print only the summary, as JSON, on standard output")
    verbose(parser)


verbose = option("--verbose", action="store_true", help="print everything that the report page says")


def as_json(parser: argparse.ArgumentParser, help_text: str = "print JSON") -> None:
    """Add `--json`, for JSON instead of text; help_text: the help."""
    parser.add_argument("--json", action="store_true", help=help_text)


served = option(
    "--serve", metavar="HOST:PORT", help="show the run to browsers, at this address and port (and the next port)"
)


def changes_of(options: argparse.Namespace) -> dict[str, Any]:
    """The changes of the scenario that `changes` or `entries` took. Raises UsageError for one that is not KEY=VALUE."""
    from evedrop.scenario.loading import value_of

    changes: dict[str, Any] = {}
    for change in options.changes:
        key, equals, value = change.partition("=")
        if not equals or not key:
            raise UsageError(f"--set {change}: expected KEY=VALUE, such as --set seed=3")
        changes[key] = value_of(value)
    for name in ("seed", "slots", "trials", "first_trial", "record_trials", "pace"):
        value = getattr(options, name, None)
        if value is not None:
            changes[name] = value
    if getattr(options, "secret", None) is not None:
        changes["secret_file"] = str(options.secret.absolute())
    return changes


def over_wire(parser: argparse.ArgumentParser) -> None:
    """Add the options for a wire as the network."""
    parser.add_argument("--wire", type=Path, metavar="FILE", help="take links and events from this wire file")
    parser.add_argument(
        "--wire-key",
        metavar="KEY",
        help="the key that the packets have on the wire; default the key of the program that gives the states",
    )
    parser.add_argument(
        "--wire-side",
        action="append",
        default=[],
        metavar="PROCESS=SIDE",
        help="the side of the wire that the sensor or a receiver is on; default the side of its name; repeatable",
    )


def _of_wire(options: argparse.Namespace, scenario: Scenario) -> dict[str, Any]:
    """The changes that give a scenario the network of `--wire`; none without it."""
    sides = [assignment.partition("=") for assignment in getattr(options, "wire_side", ())]
    if getattr(options, "wire", None) is None:
        if sides or getattr(options, "wire_key", None) is not None:
            raise UsageError("--wire-key and --wire-side belong to a wire; give --wire FILE as well")
        return {}
    if wrong := next((name for name, equals, side in sides if not (name and equals and side)), None):
        raise UsageError(f"--wire-side {wrong}: expected PROCESS=SIDE, such as --wire-side sensor=robot")
    from evedrop.wire.file import load_wire
    from evedrop.wire.scenario_network import over_wire

    return over_wire(scenario, load_wire(options.wire), options.wire_key, {name: side for name, _, side in sides})


def loaded(options: argparse.Namespace, beyond_horizon: bool = False) -> Scenario:
    """Load the scenario of a command, with its changes; prints warnings."""
    from evedrop.scenario.estimates import warnings_of
    from evedrop.scenario.loading import checked, load

    scenario = load(options.scenario, changes_of(options), beyond_horizon=beyond_horizon)
    if network := _of_wire(options, scenario):
        tables = scenario.model_dump(mode="json", exclude_none=True)
        scenario = checked(tables, str(options.wire), network, beyond_horizon=beyond_horizon)
    for warning in warnings_of(scenario):
        warn(warning)
    return scenario


def print_so_far(folder: Path, options: argparse.Namespace) -> None:
    """Print the closing report of a run, if it has results, and write its page; options: those of `output`."""
    from evedrop.cli.report import print_results, report_page

    with contextlib.suppress(UsageError):
        print_results(folder, options.json, options.verbose)
        sys.stdout.flush()  # the words first: the page takes a tenth of a second
        report_page(folder, options.json)


def hold(viewer: Viewer) -> None:
    """Wait until the view is closed, or end it on Ctrl-C or SIGTERM."""
    from evedrop.system.signals import stop_on_signals

    with stop_on_signals() as stop:
        while viewer.alive() and not stop.wait(0.1):
            pass
    viewer.stop()
