"""Monte Carlo: simulates the trials of a live run in memory, with the same bits, without a network.

The tasks of a study are shared out here, the one place that knows whether they run on this machine or on a cluster.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from evedrop.errors import Interrupted, RunError, UsageError
from evedrop.model.digest import RunDigest, block_starts
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.outcomes import eavesdropper_outcomes
from evedrop.model.theory.horizon import horizon
from evedrop.results.folder import HeldFolder, disk_errors
from evedrop.results.resolved_scenario import write_resolved
from evedrop.results.summary_file import write_summary
from evedrop.results.writer import ResultsWriter
from evedrop.scenario.arguments import number_argument, refuse_unless
from evedrop.scenario.input_files import states_of
from evedrop.scenario.progress_events import FolderMoved, OnEvent, RunProgress
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import theoretical_traces_of
from evedrop.scenario.words import listed
from evedrop.score.expectations_held import replay_of
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import RunOutcome, events_of, summary_of
from evedrop.score.slots import concatenated
from evedrop.score.summary import Summary
from evedrop.score.sums import SlotHistograms, SlotSums, squared_errors
from evedrop.simulate.chunk import PacketTally
from evedrop.simulate.cluster import REACH_SECONDS, Cluster, connected
from evedrop.simulate.finished_tasks import FinishedTasks, finished_tasks, study_of
from evedrop.simulate.simulation import Mode
from evedrop.simulate.splitting import rare_estimates, work_of
from evedrop.simulate.tasks import OnProgress, R, Stopped, Task
from evedrop.simulate.trials import BLOCK_TRIALS, BatchResult, tasks_of
from evedrop.simulate.workers import in_processes, in_this_process, usable_cores
from evedrop.system.lacks import preload_within_limit
from evedrop.system.signals import stop_on_signals


@final
@dataclass(frozen=True)
class Crew:
    """Where tasks are carried out: in this process, in worker processes on this machine, or on a Dask cluster."""

    workers: int
    """Worker processes on this machine; 1: this process."""
    cluster: Cluster | None = None

    def results(
        self, tasks: Sequence[Task[R]], on_progress: OnProgress, stopped: Stopped, finished: FinishedTasks | None = None
    ) -> Generator[R]:
        """Carry out tasks; yields their results in task order.

        on_progress: gets the trial-slots done since its last call; finished: where complete results are kept, and from
        where those that it has are read. After a stop, the last results may be incomplete.

        Raises RunError if a worker fails, OSError if a result cannot be kept.
        """
        read = {number for number, task in enumerate(tasks) if finished is not None and finished.has(task)}
        left = [number for number in range(len(tasks)) if number not in read]
        held: dict[int, R] = {}
        due = 0
        with contextlib.closing(self._as_they_come([tasks[number] for number in left], on_progress, stopped)) as new:
            while True:
                while due in read or due in held:
                    if due in held:
                        yield held.pop(due)
                    elif finished is not None and not stopped():
                        yield finished.load(tasks[due])
                        on_progress(tasks[due].work)
                    else:
                        return
                    due += 1
                if (following := next(new, None)) is None:
                    return
                number, result = left[following[0]], following[1]
                held[number] = result
                # A study of one task is complete with it.
                if finished is not None and result.complete and len(tasks) > 1:
                    finished.keep(tasks[number], result)

    def _as_they_come(
        self, tasks: Sequence[Task[R]], on_progress: OnProgress, stopped: Stopped
    ) -> Generator[tuple[int, R]]:
        """The results, with the numbers of their tasks."""
        if not tasks:
            return
        if self.cluster is not None:
            for number, result in self.cluster.results(tasks, stopped):
                on_progress(tasks[number].work)
                yield number, result
        elif self.workers == 1 or len(tasks) == 1:
            yield from enumerate(in_this_process(tasks, on_progress, stopped))
        else:
            yield from in_processes(tasks, min(self.workers, len(tasks)), on_progress, stopped)


_WORTH_A_PROCESS = 2_000_000  # trial-slots and receivers: below, starting workers costs more than it saves
_TELL_SECONDS = 0.1


@dataclass(frozen=True)
class Plan:
    """How to simulate: the mode, and the workers."""

    mode: Mode = Mode.EXACT
    """Or its name, such as "covariance-only"."""
    workers: int | None = None
    """None: chosen for this machine and the amount of work."""
    scheduler: str | None = None
    """Address of a Dask scheduler whose cluster then does the work."""
    patience: float = REACH_SECONDS
    """Seconds for the scheduler to answer."""
    rare: bool = False
    """Whether to estimate means that rare events carry by splitting, too."""

    def __post_init__(self) -> None:
        """Raise UsageError for an unknown mode, a number of workers below 1, an address that is no text, and the like."""
        modes = [mode.value for mode in Mode]
        refuse_unless(self.mode in modes, "mode", self.mode, listed(modes))
        object.__setattr__(self, "mode", Mode(self.mode))  # which may have been given by its name
        if self.workers is not None:
            number_argument("workers", self.workers, whole=True)
            refuse_unless(self.workers >= 1, "workers", self.workers, "1 or more")
        number_argument("patience", self.patience)
        refuse_unless(self.patience > 0.0, "patience", self.patience, "seconds above 0")
        refuse_unless(isinstance(self.rare, bool), "rare", self.rare, "True or False")
        if self.scheduler is not None and not isinstance(self.scheduler, str):
            raise UsageError(
                f"scheduler={self.scheduler!r:.60}: expected the address of a Dask scheduler, such as "
                '"tcp://127.0.0.1:8786"; that of a LocalCluster is its scheduler_address'
            )

    def workers_for(self, scenario: Scenario) -> int:
        """The number of workers."""
        if self.workers is not None:
            return self.workers
        work = scenario.trials * scenario.slots * len(scenario.receivers)
        return usable_cores() if work > _WORTH_A_PROCESS else 1

    @contextlib.contextmanager
    def crew(self, scenarios: Iterable[Scenario]) -> Iterator[Crew]:
        """Where the trials of these scenarios are carried out.

        Raises UsageError if the scheduler does not answer, MemoryError if a limit leaves no room for what summaries need.
        """
        preload_within_limit()
        with connected(self.scheduler, self.patience) as cluster:
            yield Crew(max(map(self.workers_for, scenarios)), cluster)


def simulate(scenario: Scenario, folder: Path, on_event: OnEvent, plan: Plan = Plan(), *, resume: bool = False) -> int:
    """Run all trials of a scenario into a results folder; returns the exit status. `on_event` gets progress as it is made.

    resume: go on with the study in the folder, which was interrupted.

    Raises UsageError for an unusable folder, plan or scheduler; Interrupted on Ctrl-C and RunError if a worker fails, with
    the results so far in the folder.
    """
    check_mode(scenario, plan.mode)
    study = study_of("montecarlo", {"mode": plan.mode.value, "rare": plan.rare}, [scenario])
    failure: RunError | None = None
    merger = Merger(scenario, plan.mode)

    def ending(how: str) -> RunOutcome:
        return RunOutcome(finished.seconds, how, replay_of(folder, scenario, plan.mode.value))

    with stop_on_signals() as stop, plan.crew([scenario]) as crew, finished_tasks(folder, study, resume) as finished:
        tasks = tasks_of(scenario, plan.mode, crew.workers, finished)
        on_progress = progress_counter(on_event, scenario.trials * scenario.slots)
        with contextlib.closing(HeldFolder(folder)) as held, disk_errors(folder):
            write_resolved(folder, scenario)
            with (
                ResultsWriter(folder, scenario, at="") as writer,
                contextlib.closing(crew.results(tasks, on_progress, stop.is_set, finished)) as results,
            ):
                try:
                    for result in results:
                        merger.add_batch(result, writer)
                        if plan.rare or not merger.complete:  # otherwise all of it follows at once
                            writer.checkpoint(
                                merger.at, lambda: merger.summary(ending("")), lambda: merger.write(writer)
                            )
                except RunError as error:
                    failure = error
                how = str(failure) if failure else "complete" if merger.complete else "interrupted"
                if merger.trials:
                    merger.write(writer)
                    summary = merger.summary(ending(how))
                    if plan.rare and how == "complete":
                        on_progress = progress_counter(on_event, work_of(scenario))
                        estimates = rare_estimates(scenario, _split_mode(scenario, plan.mode), stop.is_set, on_progress)
                        summary = summary.with_rare_estimates(estimates)
                    writer.settle(merger.at, summary)
            if not merger.trials:
                finished.remove_unless_any()
                raise failure or finished.interrupted("any trials were done")
            place = held.now
            write_summary(place, summary)
            if place != folder:
                on_event(FolderMoved(str(place)))
        if failure is not None:
            raise failure
        if not merger.complete or (plan.rare and stop.is_set()):
            raise Interrupted.with_results(place)
        finished.forget()
    if summary.ended != how:  # a metric failed
        raise RunError(summary.ended)
    return 1 if summary.failed_expectations else 0


def check_mode(scenario: Scenario, mode: Mode) -> None:
    """Raise UsageError if a mode cannot simulate the scenario: a receiver reads packets, or numbers leave double precision.

    The exact mode can simulate all but states that come from a program.
    """
    if mode is Mode.EXACT:
        states_of(scenario)
        return
    if mode is Mode.ERROR_COORDINATES and scenario.of_model:
        why = "the plant's inputs and disturbances depend on states" if scenario.driven else "the states are given"
        raise UsageError(
            f"--{mode.value} follows errors, not states, and {why}; leave "
            f"--{mode.value} out{_shorter(scenario)}, or give --{Mode.COVARIANCE_ONLY.value} instead, for the covariances alone"
        )
    _check_scheme(scenario, mode)
    for name in scenario.receivers:
        if scenario.timeline.outages[name] or scenario.window(name):
            raise UsageError(
                f"{name} uses late packets or goes away, which --{mode.value} cannot follow; "
                f"leave --{mode.value} out, or remove the window and the outages of {name} from the scenario"
            )
    for name, table in scenario.eavesdroppers.items():
        if not STRATEGIES[table.strategy].follows_gamma(table.parameters):
            raise UsageError(
                f"--{mode.value} follows events, not packets, and the actions of {name} (strategy {table.strategy}) "
                f"depend on more; leave --{mode.value} out{_shorter(scenario)}, or remove {name} from the scenario"
            )
    for name, expected in theoretical_traces_of(scenario).items():
        beyond = np.flatnonzero(np.isinf(expected))
        if beyond.size:
            raise UsageError(
                f"{name}'s expected error leaves double precision at slot {beyond[0]}; "
                f"give {beyond[0]} slots or fewer, or remove {name} from the scenario"
            )


def _shorter(scenario: Scenario) -> str:
    """What the exact mode asks for besides, in words: as many slots as float64 can follow; empty if it can follow all."""
    last = horizon(scenario.process.process, scenario.slots)
    return "" if last is None or last < 0 else f" and give at most {last + 1:,} slots"


def _split_mode(scenario: Scenario, mode: Mode) -> Mode:
    """The mode in which the trials of a study of this mode are split: covariances scatter less than errors of the same mean.

    With a plant or given states, the means of errors differ from those of the model's covariances.
    """
    if mode is Mode.EXACT and scenario.of_model:
        return Mode.EXACT
    try:
        check_mode(scenario, Mode.COVARIANCE_ONLY)
    except UsageError:
        return Mode.EXACT
    return Mode.COVARIANCE_ONLY


def _check_scheme(scenario: Scenario, mode: Mode) -> None:
    """Raise UsageError if events alone do not determine the errors of a scheme, or of a receiver that reads its packets."""
    name = scenario.encoding.scheme
    scheme = scenario.make_scheme()
    reasons = {
        "reads its packets": scheme.reads_packets,
        "acts on acknowledgements": scheme.needs_acknowledgements,
        "may stay silent": scheme.may_be_silent,
    }
    for does, so in reasons.items():
        if so:
            raise UsageError(
                f"--{mode.value} follows events, not packets, and the scheme {name} {does}; leave --{mode.value} out"
            )
    for receiver, table in scenario.eavesdroppers.items():
        follows = STRATEGIES[table.strategy].follows_gamma(table.parameters)
        if follows and eavesdropper_outcomes(scheme, table.strategy, table.parameters) is None:
            raise UsageError(
                f"--{mode.value} follows events, not packets, and {receiver} (strategy {table.strategy}) reads the "
                f"packets of the scheme {name}; leave --{mode.value} out, or remove {receiver} from the scenario"
            )


def progress_counter(on_event: OnEvent, total: int) -> Callable[[int], None]:
    """A function that takes counts of trial-slots and reports progress and rate a few times a second."""
    started = told = time.monotonic()
    done = 0

    def take(count: int) -> None:
        nonlocal told, done
        done += count
        now = time.monotonic()
        if now - told > _TELL_SECONDS:
            told = now
            on_event(RunProgress(done, done / (now - started), "trial-slots/s", {}, total))

    return take


@final
class Merger:
    """Merges results in trial order."""

    def __init__(self, scenario: Scenario, mode: Mode) -> None:
        self._scenario = scenario
        self._mode = mode
        names = scenario.receivers
        self._sums = {name: SlotSums.zero(scenario.slots) for name in names}
        self._run_tallies: list[RunTally] = []
        self._packets: list[PacketTally] = []
        self._digests = {name: RunDigest() for name in scenario.digested}
        self._errors: dict[str, SlotHistograms] = {}
        self._traces: dict[str, SlotHistograms] = {}
        self._whole = mode is Mode.EXACT
        self.trials = 0

    @classmethod
    def of(cls, scenario: Scenario, mode: Mode, results: Iterable[BatchResult]) -> Merger:
        """All these results, merged."""
        merger = cls(scenario, mode)
        for result in results:
            merger.add_batch(result)
        return merger

    @property
    def at(self) -> str:
        """How far it has come, in words."""
        return f"{self.trials} of {self._scenario.trials} trials"

    @property
    def complete(self) -> bool:
        """Whether every trial has every slot."""
        done = (tally.done == tally.slots for run_tally in self._run_tallies for tally in run_tally.tallies.values())
        return self.trials == self._scenario.trials and all(done)

    @np.errstate(over="ignore")
    def add_batch(self, result: BatchResult, writer: ResultsWriter | None = None) -> None:
        """Add the next batch; writes its digests and recorded trials if there is a writer."""
        for block in result.blocks:
            self.trials += block.trials
            self._run_tallies.append(block.run_tally)
            self._packets.append(block.packets)
            for name in self._scenario.receivers:
                self._sums[name].add_trials(0, block.sums[name])
            if self._mode is Mode.EXACT:
                self._add_digests(block.start, block.digests, writer)
        for mine, theirs in ((self._errors, result.errors), (self._traces, result.traces)):
            for name, histograms in theirs.items():
                if name in mine:
                    mine[name].merge(histograms)
                else:
                    mine[name] = histograms
        if writer is not None and result.recorded:
            recorded = concatenated(result.recorded)
            for start in range(0, recorded.trials, BLOCK_TRIALS):  # the order of rows does not depend on the tasks
                slots = recorded.part(slice(start, start + BLOCK_TRIALS))
                writer.input_rows(slots, result.start + start)
                errors = {
                    name: squared_errors(slots.sensor.x, receiver.x_hat) for name, receiver in slots.receivers.items()
                }
                writer.trial_rows(slots, errors, result.start + start)

    def _add_digests(self, start: int, digests: Mapping[str, Mapping[int, Any]], writer: ResultsWriter | None) -> None:
        if writer is not None:
            writer.digest_rows(start, digests)
        for name, of_blocks in digests.items():
            self._whole &= sorted(of_blocks) == block_starts(self._scenario.slots, self._scenario.outage_bounds(name))
            if self._whole:
                self._digests[name].add(of_blocks)

    @np.errstate(over="ignore")
    def write(self, writer: ResultsWriter) -> None:
        """Write the rows of all slots that any trial reached, replacing the rows written before."""
        writer.restart_slots()
        expected = theoretical_traces_of(self._scenario)
        for name in self._scenario.receivers:
            sums = self._sums[name].measured()
            quantiles = np.hstack([self._errors[name].quantiles(), self._traces[name].quantiles()])
            count = len(sums.trials)
            covariances = self._mode is Mode.COVARIANCE_ONLY
            writer.slot_rows(0, name, sums, expected[name][:count], quantiles[:count], covariances)

    @property
    def run_tally(self) -> RunTally:
        """The tally of all added batches."""
        return RunTally.merged(self._run_tallies)

    @property
    def packets(self) -> PacketTally:
        """The counts of packets in all added batches, at least one; in exact mode only."""
        return PacketTally.merged(self._packets)

    @np.errstate(over="ignore", invalid="ignore")
    def summary(self, ending: RunOutcome) -> Summary:
        """The summary of all added batches; fills in mode and events."""
        run_tally = self.run_tally
        whole = self._whole and self.complete
        digests = {name: digest.hexadecimal if whole else None for name, digest in self._digests.items()}
        events = events_of(self._scenario, min(tally.done for tally in run_tally.tallies.values()))
        return summary_of(self._scenario, run_tally, digests, replace(ending, mode=self._mode.value, events=events))
