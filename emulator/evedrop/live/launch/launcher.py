"""The launcher: runs a scenario in one set of processes, or in one set for each of its shards.

It imports neither zenoh nor rerun. It alone decides how the run ended.
"""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.errors import UsageError
from evedrop.live.launch.briefs import MOST_SLOTS_AHEAD
from evedrop.live.launch.ports import loopback_endpoints, warn_if_exposed
from evedrop.live.launch.process_set import FinishedRun, Launch, launch_one
from evedrop.live.launch.starter import process_starter
from evedrop.scenario.progress_events import OnEvent
from evedrop.scenario.tables import Scenario
from evedrop.show.view.viewer import choose
from evedrop.system.output import say
from evedrop.system.world import world

if TYPE_CHECKING:
    from evedrop.live.launch.hosts_file import HostsPlan

_HOSTS_PATIENCE = 120  # seconds; some hosts take long to start Python


def launch(
    scenario: Scenario,
    folder: Path,
    view: str,
    listen: str | None,
    on_event: OnEvent,
    relay: str | None = None,
    *,
    paused: bool = False,
    hosts: HostsPlan | None = None,
    ahead: int = MOST_SLOTS_AHEAD,
) -> FinishedRun:
    """Run a scenario live into a results folder; `on_event` gets the recorder's events as they come.

    view: auto, native, web or off; listen, relay: the endpoints of router and relay, if there is one; by default no
    port, or free ports for two routers; paused: whether the run is held before slot 0, until the operator lets it continue;
    hosts: the hosts of processes that are not on this machine, and the endpoints of the routers then; ahead: how many
    slots at most the sensor may be ahead of the process that has done the fewest.

    Raises UsageError before any process is started, RunError if the run failed, Interrupted on Ctrl-C or SIGTERM; in the
    last two cases the results so far are in the folder and no process is left.
    """
    view = choose(view)
    pausing = f"; to pause it, type `evedrop pause {shlex.quote(str(folder))}`" if scenario.shards == 1 else ""

    def suspended() -> None:
        say(f"the processes of the run go on, and only this command stops{pausing}; `fg` continues the command")

    this = world().process
    with this.stop_on_signals() as stop, this.told_when_suspended(suspended), process_starter(stop) as start:
        run = Launch(scenario, folder, view, on_event, stop, start, ahead=ahead, paused=paused)
        if hosts is not None:
            return _on_hosts(run, hosts)
        if scenario.shards == 1:
            endpoints = None
            if listen is not None or relay is not None or scenario.relayed:
                endpoints = loopback_endpoints(listen, relay, scenario.relayed)
                warn_if_exposed(endpoints)
            return launch_one(replace(run, endpoints=endpoints))
        from evedrop.live.launch.shards import launch_shards  # noqa: PLC0415 - not needed for one set of processes

        given = {"listen": listen, "relay": relay}
        for option, endpoint in given.items():
            if endpoint is not None:
                raise UsageError(
                    f"{option}: {endpoint} is one router's endpoint, and each of the {scenario.shards} shards has its own; "
                    "leave it out, or give shards=1"
                )
        if paused:
            raise UsageError(f"--paused: a run in {scenario.shards} shards cannot be steered; give --set shards=1")
        return launch_shards(run)


def _on_hosts(run: Launch, hosts: HostsPlan) -> FinishedRun:
    """Run a scenario as `launch` does, with processes on other hosts."""
    # Not needed on one machine.
    from evedrop.live.launch.other_hosts import ssh_starter  # noqa: PLC0415

    if run.scenario.shards > 1:
        raise UsageError(
            f"--hosts: the scenario has {run.scenario.shards} shards, and hosts carry one run; give --set shards=1"
        )
    warn_if_exposed(hosts.endpoints)
    with ssh_starter(hosts, run.starter, run.stop, run.scenario.longest_outage) as start:
        return launch_one(replace(run, endpoints=hosts.endpoints, starter=start, patience=_HOSTS_PATIENCE))
