"""The launcher: runs a scenario in one set of processes, or in one set for each of its shards.

It imports neither zenoh nor rerun. It alone decides how the run ended.
"""

from __future__ import annotations

from pathlib import Path

from evedrop.errors import UsageError
from evedrop.live.launch.ports import loopback_places
from evedrop.live.launch.preloading import process_starter
from evedrop.live.launch.process_set import Ended, launch_one
from evedrop.news import Tell
from evedrop.scenario import Scenario
from evedrop.signals import stop_on_signals
from evedrop.view.viewer import choose


def launch(
    scenario: Scenario,
    folder: Path,
    view: str,
    listen: str | None,
    tell: Tell,
    relay: str | None = None,
    *,
    paused: bool = False,
) -> Ended:
    """Run a scenario live into a results folder; `tell` gets the observer's news as they come.

    view: auto, native, web or off; listen, relay: the endpoints of router and relay, if there is one; free ports by default;
    paused: whether the run is held before slot 0, until the operator lets it go on.

    Raises UsageError before any process is started, RunError if the run failed, Interrupted on Ctrl-C or SIGTERM; in the
    last two cases the results so far are in the folder and no process is left.
    """
    view = choose(view)
    with stop_on_signals() as stop, process_starter() as start:
        if scenario.shards == 1:
            places = loopback_places(listen, relay, scenario.relayed)
            return launch_one(scenario, folder, view, places, tell, stop, start, paused=paused)
        from evedrop.live.launch.shards import launch_shards  # noqa: PLC0415 - not needed for one set of processes

        given = {"--listen": listen, "--relay": relay}
        for option, endpoint in given.items():
            if endpoint is not None:
                raise UsageError(
                    f"{option} {endpoint} is one router's endpoint, and each of the {scenario.shards} shards has its own; "
                    "leave it out, or give --set shards=1"
                )
        if paused:
            raise UsageError(f"--paused: a run in {scenario.shards} shards cannot be steered; give --set shards=1")
        return launch_shards(scenario, folder, view, tell, stop, start)
