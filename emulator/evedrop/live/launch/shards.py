"""A live run in shards: contiguous ranges of its trials, each carried by a run of its own, all under one launcher.

Trials share only the scenario, and every random number is addressed by its trial. So a shard is a complete run, with router,
sensor, receivers and recorder, independent of all others. `gathering` merges their results.

Source: docs/performance.md, shards.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import final

from msgspec import structs

from evedrop.errors import Interrupted, RunError, UsageError
from evedrop.live.launch.gathering import SHARDS_FOLDER, Shard, shards_of
from evedrop.live.launch.ports import RouterEndpoints, loopback_endpoints
from evedrop.live.launch.process_set import FinishedRun, Launch, launch_one
from evedrop.model.kernels.elementary import sum_in_order
from evedrop.results.folder import HeldFolder, new_folder
from evedrop.results.resolved_scenario import write_resolved
from evedrop.scenario.progress_events import (
    ConnectionOutage,
    FolderMoved,
    OnEvent,
    ProgressEvent,
    RunEnded,
    RunProgress,
    Started,
)
from evedrop.scenario.tables import Scenario
from evedrop.show.view.viewer import Viewer
from evedrop.system.waiting import wait_for_thread
from evedrop.system.world import world

_POLL_SECONDS = 0.25


@final
class OneProgress:
    """Merges the events of all shards into those of one run, whose progress is the slowest shard's; thread-safe."""

    def __init__(self, shards: Sequence[Shard], on_event: OnEvent) -> None:
        self._trials = {shard.number: shard.scenario.trials for shard in shards}
        self._slots = shards[0].scenario.slots
        self._on_event = on_event
        self._lock = world().lock()
        self._latest: dict[int, RunProgress] = {}
        self._waited_for = set(self._trials)
        self.started: float | None = None
        """When the first shard began, by the monotonic clock."""

    def of(self, shard: Shard) -> OnEvent:
        """A function that takes the events of one shard."""

        def on_event(event: ProgressEvent) -> None:
            with self._lock:
                self._take(shard.number, event)

        return on_event

    def _take(self, number: int, event: ProgressEvent) -> None:
        match event:
            case Started():
                self.started = world().monotonic() if self.started is None else self.started
                self._waited_for.discard(number)
                if not self._waited_for:
                    self._on_event(event)
            case RunProgress():
                self._latest[number] = event
                if len(self._latest) == len(self._trials):
                    self._on_event(self._all())
            case FolderMoved():
                pass  # a shard's folder moves with the run's, which is reported separately
            case ConnectionOutage():
                self._on_event(structs.replace(event, shard=number))
            case _:
                if isinstance(event, RunEnded) and event.well and number in self._latest:
                    # Its last slots were too few for a progress report.
                    self._latest[number] = structs.replace(self._latest[number], done=self._slots)
                self._on_event(event)

    def _all(self) -> RunProgress:
        """The slowest shard's progress and rate, with the errors over all trials."""
        slowest = min(self._latest.values(), key=lambda progress: progress.done)
        trials = sum(self._trials.values())
        errors = {
            name: sum_in_order(
                self._trials[number] * progress.squared_errors[name] for number, progress in self._latest.items()
            )
            / trials
            for name in slowest.squared_errors
        }
        return structs.replace(slowest, squared_errors=errors)


@final
@dataclass
class _ShardsState:
    """The state of the shards so far."""

    failures: list[tuple[Shard, BaseException]] = field(default_factory=list)
    """In order of time."""
    viewer: Viewer | None = None

    def launched(self, shard: Shard, launch: Launch) -> None:
        """Run one shard to its end; if it ends early, all shards end."""
        try:
            ended = launch_one(launch)
        except BaseException as error:
            self.failures.append((shard, error))
            launch.stop.set()
        else:
            self.viewer = self.viewer or ended.viewer

    @property
    def fault(self) -> tuple[Shard, BaseException] | None:
        """The first shard that failed, and its error, which ended the others; None if all ended well or the user ended them."""
        failures = (failure for failure in self.failures if not isinstance(failure[1], Interrupted))
        return next(failures, None)


def launch_shards(run: Launch) -> FinishedRun:
    """Run a scenario in its shards, all at the same time, into one results folder; raises as `launch` does.

    The view shows the first shard, which has the recorded trials.
    """
    scenario, folder, on_event, stop = run.scenario, run.folder, run.on_event, run.stop
    endpoints = _endpoints(scenario.shards) if scenario.relayed else [None] * scenario.shards
    held = HeldFolder(new_folder(folder))
    with contextlib.suppress(OSError):  # it is written again when the shards are merged, and an error reported then
        write_resolved(folder, scenario)
    shards = shards_of(scenario, folder)
    progress, state = OneProgress(shards, on_event), _ShardsState()
    launches = [
        replace(
            run,
            scenario=shard.scenario,
            folder=shard.folder,
            view=run.view if shard.number == 1 else "off",
            on_event=progress.of(shard),
            shard=True,
            endpoints=at,
        )
        for shard, at in zip(shards, endpoints, strict=True)
    ]
    threads = [
        world().thread(state.launched, shard, launch, name="shard", daemon=False)
        for shard, launch in zip(shards[1:], launches[1:], strict=True)
    ]
    for thread in threads:
        thread.start()
    # On this thread, not on another one: a viewer ends with the thread that started it.
    state.launched(shards[0], launches[0])
    try:
        for thread in threads:
            while thread.is_alive() and not stop.is_set():  # a run lasts as long as it lasts
                thread.join(_POLL_SECONDS)
            wait_for_thread(thread)
        now = held.now
        if now != folder:
            on_event(FolderMoved(str(now)))
            shards = [_moved(shard, now) for shard in shards]
        return FinishedRun(_made_one(scenario, now, shards, state, progress.started), state.viewer, now)
    except BaseException as error:
        if state.viewer is not None:
            state.viewer.stop()
        if isinstance(error, FileNotFoundError):
            raise RunError(
                f"{folder} was removed while the run went on; run again, and leave it where it is"
            ) from error
        raise
    finally:
        held.close()


def _moved(shard: Shard, now: Path) -> Shard:
    """A shard of a run whose folder has moved; now: where that is. A shard that began after the move is at the old place."""
    folder = now / SHARDS_FOLDER / str(shard.number)
    return replace(shard, folder=folder) if folder.is_dir() else shard


def _endpoints(shards: int) -> list[RouterEndpoints | None]:
    """The endpoints of two routers for each shard; free ports may coincide as long as no router listens on them."""
    every_end: list[RouterEndpoints | None] = []
    taken = set[str]()
    while len(every_end) < shards:
        endpoints = loopback_endpoints(None, None, relayed=True)
        ports = {str(endpoint.listen) for endpoint in (endpoints.router, endpoints.relay) if endpoint is not None}
        if not ports & taken:
            every_end.append(endpoints)
            taken |= ports
    return every_end


def _made_one(
    scenario: Scenario, folder: Path, shards: Sequence[Shard], state: _ShardsState, started: float | None
) -> int:
    """Merge the shards' results into the run's; returns its exit status. Raises the error that ended it, if there was one."""
    from evedrop.live.launch.gathering import gather  # noqa: PLC0415 - slow to import: start the run first

    fault, how = state.fault, "interrupted" if state.failures else "complete"
    if fault is not None:
        shard, error = fault
        if isinstance(error, UsageError):
            world().disk.remove_tree(folder)  # the run was not started
        if not isinstance(error, RunError):
            raise error
        how = shard.of_run(error)
    try:
        summary = gather(scenario, folder, shards, started, how)
    except OSError as error:
        raise RunError(
            f"the results of the shards cannot be merged ({error}); those of each are in {folder / SHARDS_FOLDER}; free some "
            "space, and run again"
        ) from error
    if fault is not None:
        raise RunError(how)
    if state.failures:
        raise Interrupted.with_results(folder)
    if summary.ended != how:  # a metric failed
        raise RunError(summary.ended)
    return 1 if summary.failed_expectations else 0
