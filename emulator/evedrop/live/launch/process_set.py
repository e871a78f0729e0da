"""Launches one set of processes, watches it to its end, and ends it whatever happens.

Children have sessions of their own, so a Ctrl-C reaches only the launcher. Each holds the other end of a pipe, so none
outlives the launcher, even if that is killed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from evedrop.errors import EvedropError, Interrupted, RunError, UsageError
from evedrop.live.launch.briefs import LAUNCHED_PATIENCE, MOST_SLOTS_AHEAD, RecorderTask, briefs_of
from evedrop.live.launch.children import SILENCE_SECONDS, Children, ProcessExit
from evedrop.live.launch.ports import RouterEndpoints, socket_endpoints
from evedrop.live.launch.private_folder import private_folder, socket_folder
from evedrop.live.launch.starter import FORK_SERVER_LOST, Starter
from evedrop.live.network.control_file import remove_control
from evedrop.names import RECORDER, RELAY, ROUTER
from evedrop.results.folder import HeldFolder, make_private, new_folder
from evedrop.results.resolved_scenario import write_resolved
from evedrop.scenario.progress_events import FolderMoved, OnEvent, RunEnded, ViewOpened
from evedrop.scenario.tables import Scenario
from evedrop.show.view.viewer import Viewer
from evedrop.system.signals import AFTERTHOUGHT_SECONDS, INTERRUPTED
from evedrop.system.threads import ThreadEvent
from evedrop.system.world import world

_POLL_SECONDS = 0.1  # how soon a signal is noticed
_EARLY_SECONDS = 1.0
_LONGER = 1.1
"""How many times as long the launcher waits for a relay as the relay for its router: the relay can say why it gave up."""


@dataclass(frozen=True)
class FinishedRun:
    """A run that has come to its end."""

    status: int
    """Its exit status."""
    viewer: Viewer | None
    """The viewer, if one is still open."""
    folder: Path
    """The results folder, which may have been renamed."""


@dataclass(frozen=True)
class Launch:
    """What one set of processes is launched with."""

    scenario: Scenario
    folder: Path
    """Of the results."""
    view: str
    on_event: OnEvent
    stop: ThreadEvent
    """Ends the run once it is set."""
    starter: Starter
    ahead: int = MOST_SLOTS_AHEAD
    """As for `launch`."""
    paused: bool = False
    shard: bool = False
    """Whether other sets of processes carry further trials."""
    patience: int = LAUNCHED_PATIENCE
    """Seconds for which processes wait for each other."""
    endpoints: RouterEndpoints | None = None
    """None for a socket in a private folder, which other users cannot enter."""


def launch_one(launch: Launch) -> FinishedRun:
    """Run a scenario as `evedrop.live.launch.launcher.launch` does, in one set of processes, until it is stopped."""
    scenario, folder, on_event, stop = launch.scenario, launch.folder, launch.on_event, launch.stop
    with (
        private_folder() as private,
        _endpoints(launch.endpoints, private) as at,
        contextlib.closing(HeldFolder(new_folder(folder))) as held,
    ):
        make_private(folder / "logs")
        viewer = None
        try:
            # At once, so that a run that is interrupted or killed in its first moments can be run again.
            with contextlib.suppress(OSError):  # the recorder writes it, too, and reports why it cannot
                write_resolved(folder, scenario)
            task = RecorderTask(folder.absolute(), launch.view != "off", launch.shard, launch.paused)
            briefs = briefs_of(scenario, at, task, patience=launch.patience, ahead=launch.ahead)
            recorder = briefs.pop(RECORDER)
            # Before all processes: a viewer may take longer to start than they wait for the recorder.
            viewer = Viewer.start(
                launch.view, folder / "logs", folder.absolute() / "recording.rrd", meanwhile=lambda: _heed(stop)
            )
            if viewer is not None:
                on_event(ViewOpened(viewer.address, viewer.warning))
            with Children(held, private, scenario.controller is not None, launch.starter) as children:
                for name in (ROUTER, RELAY):
                    if name in briefs:
                        children.start(briefs.pop(name))
                        _wait_until_listening(children, name, stop, launch.patience)
                for brief in briefs.values():
                    children.start(brief)
                children.start(recorder)
                status = follow_to_end(children, stop, on_event)
                if viewer is not None:
                    viewer.complete()
        except BaseException as error:
            if viewer is not None:
                viewer.stop()
            if isinstance(error, UsageError):
                with contextlib.suppress(OSError):
                    world().disk.remove_tree(folder)  # of a run that was not started, so that the next one can use it
            elif isinstance(error, EvedropError):
                # Tables and theory are slow to import, and a run that ends well needs neither.
                from evedrop.results.ending import note_end  # noqa: PLC0415

                with contextlib.suppress(OSError):
                    note_end(held.now, scenario, "interrupted" if isinstance(error, Interrupted) else str(error))
            if isinstance(error, Interrupted):
                raise Interrupted.with_results(_now(held)) from None
            raise
        finally:
            now = _now(held)
            remove_control(now)
            if now != held.first:
                on_event(FolderMoved(str(now)))
    return FinishedRun(status, viewer, now)


@contextlib.contextmanager
def _endpoints(given: RouterEndpoints | None, private: Path) -> Iterator[RouterEndpoints]:
    """The given endpoints, or a socket in a private folder."""
    if given is not None:
        yield given
        return
    with socket_folder(private) as folder:
        yield socket_endpoints(folder)


def _heed(stop: ThreadEvent) -> None:
    if stop.is_set():
        raise Interrupted


def _wait_until_listening(children: Children, router: str, stop: ThreadEvent, patience: float) -> None:
    """Wait until a router says that it listens: a process that is started earlier might connect to another program there.

    Raises RunError if the router ends, or is silent for longer than `patience` seconds; Interrupted if stopped meanwhile.
    """
    limit = _LONGER * patience
    deadline = world().monotonic() + limit
    while not children.listens(router):
        _heed(stop)
        event = children.next_event(_POLL_SECONDS)
        if isinstance(event, ProcessExit) and not _meant_us_too(event, stop) and not children.restart_router(event):
            raise RunError(children.failure_report(event, None))
        if world().monotonic() > deadline:
            raise RunError(
                f"{router} did not listen within {limit:.0f} s of its start, so no other process was started; run again, "
                f"and look at logs/{router}.log if it happens again"
            )


def _now(held: HeldFolder) -> Path:
    """The results folder, which may have been renamed; its first name if it was removed."""
    try:
        return held.now
    except FileNotFoundError:
        return held.first


def follow_to_end(children: Children, stop: ThreadEvent, on_event: OnEvent) -> int:
    """Follow the run to its end; returns the exit status that the recorder gives it."""
    ending = _ending(children, stop, on_event)
    if ending.status == Interrupted.exit_status:
        raise Interrupted
    if not ending.well:
        raise RunError(children.failure_report(None, ending))
    children.wait_all()
    return ending.status


def _ending(children: Children, stop: ThreadEvent, on_event: OnEvent) -> RunEnded:
    """Follow the run until its recorder says how it ended. Raises RunError if that cannot be awaited, Interrupted if stopped."""
    early: tuple[ProcessExit, float] | None = None
    while True:
        if early is not None and not children.over and world().monotonic() - early[1] > _EARLY_SECONDS:
            return _lost(children, early[0], on_event)
        if stop.is_set():
            return _stopped(children, on_event)
        if children.silent_seconds > SILENCE_SECONDS:
            raise RunError(children.failure_report(None, RunEnded(RunError.exit_status, "", [RECORDER])))
        event = children.next_event(_POLL_SECONDS)
        if isinstance(event, ProcessExit):
            if _meant_us_too(event, stop):
                if event.process == RECORDER:  # it says no more
                    raise Interrupted
            elif event.process != RECORDER and (event.status == 0 or children.restart_router(event)):
                # A process that leaves at the end may be faster than the event that the run is over.
                early = early or ((event, world().monotonic()) if event.status == 0 else None)
            else:
                return _lost(children, event, on_event)
        elif event is not None:
            on_event(event)
            if isinstance(event, RunEnded):
                return event


def _lost(children: Children, lost: ProcessExit, on_event: OnEvent) -> RunEnded:
    """End a run that has lost a process; returns its end if it was complete before. Raises RunError otherwise."""
    # A recorder that has just ended may still report so; a running one would wait for the lost process in vain.
    ending = None if lost.process == RECORDER else children.conclude(on_event)
    if ending is None or not ending.well:
        raise RunError(children.failure_report(lost, ending))
    return ending


def _stopped(children: Children, on_event: OnEvent) -> RunEnded:
    """End the run after a signal; returns its end if it was complete before. Raises Interrupted otherwise."""
    ending = children.conclude(on_event)
    if ending is None or not ending.well:
        raise Interrupted
    return ending


def _meant_us_too(ended: ProcessExit, stop: ThreadEvent) -> bool:
    """Whether the signal that ended a child soon reaches the launcher, too, as when a closing terminal hangs up on all.

    A fork server that several shards share is given up by the first of them that hears it.
    """
    if ended.status == FORK_SERVER_LOST:
        return stop.is_set()
    return ended.status == INTERRUPTED and stop.wait(AFTERTHOUGHT_SECONDS)
