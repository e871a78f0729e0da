"""`evedrop run` and `evedrop demo`: live runs."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.cli.command import command, option
from evedrop.cli.options import (
    entries,
    hold,
    loaded,
    output,
    over_wire,
    paused,
    print_so_far,
    scenario,
    tables,
    verbose,
)
from evedrop.errors import Interrupted, RunError, UsageError

if TYPE_CHECKING:
    from evedrop.cli.console import ProgressLine
    from evedrop.live.launch.hosts_file import HostsPlan
    from evedrop.live.launch.process_set import FinishedRun
    from evedrop.scenario.progress_events import OnEvent
    from evedrop.scenario.tables import Scenario
    from evedrop.show.view.viewer import Viewer


_LIVE = (
    entries,
    output,
    verbose,
    option("--view", help_text="default auto", choices=("auto", "native", "web", "off"), default="auto"),
    option("--listen", "ENDPOINT", "the router's endpoint, such as tls/127.0.0.1:PORT; by default no port"),
    option("--relay", "ENDPOINT", "the second router's endpoint, if the scenario has two"),
    option("--metrics", "HOST:PORT", "serve metrics for Prometheus while the run goes on, such as 127.0.0.1:9464"),
    paused,
    tables,
)


@command(_LIVE, section="run", example="demo", page="run")
def demo(options: argparse.Namespace) -> int:
    """Run the built-in scenario `vehicle` live, with the view."""
    options.scenario = "vehicle"
    return run.run(options)


_OVER_SSH = option("--hosts", "FILE", "start processes on other hosts, over ssh, as FILE says", type=Path)


@command((scenario, over_wire, *_LIVE, _OVER_SSH), section="run", example="run vehicle --view web", page="run")
def run(options: argparse.Namespace) -> int:
    """Run a scenario live: separate processes over a network, with a view and results."""
    from evedrop.live.launch.starter import process_starter

    with process_starter():  # the servers make their imports while the scenario is read
        ended = _run(options)
    if ended.viewer is not None:
        _keep_open(ended.viewer)
    return ended.status


def _run(options: argparse.Namespace) -> FinishedRun:
    from evedrop.cli.console import ProgressLine
    from evedrop.live.launch.launcher import launch
    from evedrop.results.folder import results_folder

    scenario = loaded(options)
    hosts = _hosts_of(options, scenario)
    with results_folder(options.out, options.scenario) as folder:
        with (
            ProgressLine(scenario.slots, "slots", options.json) as line,
            _metrics(options, scenario, folder, line) as on_event,
        ):
            try:
                ended = launch(
                    scenario,
                    folder,
                    options.view,
                    options.listen,
                    on_event,
                    options.relay,
                    paused=options.paused,
                    hosts=hosts,
                )
            except (RunError, Interrupted) as error:
                print_so_far(line.moved or folder, options, error.exit_status, error)
                raise
        print_so_far(ended.folder, options, ended.status)
    return ended


@contextlib.contextmanager
def _metrics(options: argparse.Namespace, scenario: Scenario, folder: Path, line: ProgressLine) -> Iterator[OnEvent]:
    """Serve the metrics of `--metrics` during the block; gives what takes the events."""
    if options.metrics is None:
        yield line.on_event
        return
    from evedrop.live.launch.metrics_server import MetricsAddress, RunMetrics, metrics_served
    from evedrop.system.output import warn

    address = MetricsAddress.of(options.metrics)
    metrics = RunMetrics(scenario, folder, line.on_event)
    with contextlib.closing(metrics), metrics_served(address, metrics) as page:
        if not options.json:
            line.console.print(f"metrics are served at {page}", soft_wrap=True)
        if address.warning is not None:
            warn(address.warning)
        yield metrics.on_event


def _hosts_of(options: argparse.Namespace, scenario: Scenario) -> HostsPlan | None:
    """The hosts of `--hosts`; None without it."""
    path: Path | None = getattr(options, "hosts", None)
    if path is None:
        return None
    if options.listen is not None or options.relay is not None:
        raise UsageError(f"--listen and --relay: {path} says where the routers listen; leave them out")
    from evedrop.live.launch.hosts_file import load_hosts

    return load_hosts(path, scenario)


def _keep_open(viewer: Viewer) -> None:
    """Keep the view open until it is closed or Ctrl-C, if started from a terminal; otherwise end it with the command."""
    if sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty() and viewer.alive():
        where = f" at {viewer.address}" if viewer.address else ""
        print(f"the view stays open{where}; Ctrl-C ends it", file=sys.stderr)
        hold(viewer)
    else:
        viewer.stop()


COMMANDS = (demo, run)
