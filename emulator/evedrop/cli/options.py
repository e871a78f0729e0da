"""Shared by several commands: options, the scenario with its changes, and the report of a run.

Slow imports are made only when they are needed, so that `evedrop --help` and a peer start quickly.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evedrop.cli.command import flag, option, together
from evedrop.errors import EvedropError, UsageError
from evedrop.system.output import say, warn
from evedrop.system.signals import leave_after

if TYPE_CHECKING:
    from evedrop.scenario.tables import Scenario
    from evedrop.show.view.viewer import Viewer


_SET_HELP = "change an entry of the scenario by its dotted key; the value is read as TOML, else as a string; repeatable"
scenario = option("scenario", "SCENARIO", "a built-in scenario, a file, or a results folder")
changes = option("--set", "KEY=VALUE", _SET_HELP, dest="changes", action="append", default=[])
entries = together(
    changes,
    option("--seed", "N", "seed of all random numbers", type=int),
    option("--slots", "N", "number of slots", type=int),
    option("--trials", "N", "number of trials", type=int),
    option("--first-trial", "N", "number of the first trial", type=int),
    option("--record-trials", "N", "how many trials are recorded in full", type=int),
    option("--pace", "SECONDS", "seconds per slot; 0 = as fast as possible", type=float),
    option("--secret", "FILE", "a secret that is not derived from the seed", type=Path),
)
"""`--set`, and an option for each of the entries that are changed most often."""
verbose = flag("--verbose", "also print further notes or tables of the report page")
as_json = flag("--json", "print JSON")
output = together(
    option("--out", "DIR", "results folder, new or empty", type=Path),
    flag("--json", "print only the summary, as JSON, on standard output"),
)
tables = together(
    option("--csv", "FILE", "also write the table as CSV, at full precision", type=Path),
    option("--latex", "FILE", "also write the table as a tabular of LaTeX", type=Path),
)
"""For the tables that the command prints, which `evedrop.cli.tables` writes."""
served = option("--serve", "HOST:PORT", "show the run to browsers, at this address and port (and the next port)")
paused = flag("--paused", "hold the run before slot 0, until `evedrop resume` or `evedrop step`")


def changes_of(options: argparse.Namespace) -> dict[str, Any]:
    """The changes of the scenario that `changes` or `entries` took. Raises UsageError for one that is not KEY=VALUE."""
    from evedrop.scenario.loading import value_of

    changes: dict[str, Any] = {}
    for change in options.changes:
        key, equals, value = change.partition("=")
        if not equals or not key:
            raise UsageError(f"--set {change}: expected KEY=VALUE, such as --set seed=3")
        changes.pop(key, None)  # changes are made in order: the last one of an entry after those of tables around it
        changes[key] = value_of(value)
    for name in ("seed", "slots", "trials", "first_trial", "record_trials", "pace"):
        value = getattr(options, name, None)
        if value is not None:
            changes[name] = value
    if getattr(options, "secret", None) is not None:
        changes["secret_file"] = str(options.secret.absolute())
    return changes


over_wire = together(
    option("--wire", "FILE", "take links and events from this wire file", type=Path),
    option(
        "--wire-key",
        "KEY",
        "the key that the packets have on the wire; default the key of the program that gives the states",
    ),
    option(
        "--wire-side",
        "PROCESS=SIDE",
        "the side of the wire that the sensor or a receiver is on; default the side of its name; repeatable",
        action="append",
        default=[],
    ),
)
"""A wire as the network."""


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


def print_so_far(folder: Path, options: argparse.Namespace, status: int, failure: EvedropError | None = None) -> None:
    """Print the closing report of a run, if it has results, and write its page; options: those of `output`.

    status, failure: how the run has ended, which a signal that comes meanwhile does not change.
    """
    from evedrop.cli.report import print_results, report_page

    def tell() -> None:
        if failure is not None:
            say(failure.illustrated, "evedrop:")

    with leave_after(tell, status), contextlib.suppress(UsageError):
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
