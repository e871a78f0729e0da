"""Batches of trials as tasks for workers, their execution, and their results.

Sums are kept for fixed blocks of 500 trials, however many trials a worker simulates side by side, so results do not depend
on the distribution of the work.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import final

import numpy as np

from evedrop.model.digest import Digests
from evedrop.model.kernels.current import kernels
from evedrop.model.metrics.metric import ScoredSlots
from evedrop.model.process import Floats
from evedrop.model.slot.link import Account, Accountant
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import KnownTraces, theoretical_traces_of
from evedrop.score.leak import HeardBitsStream
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import Scorekeeper
from evedrop.score.slots import Slots
from evedrop.score.sums import SlotHistograms, SlotSums, slot_sums
from evedrop.simulate.chunk import Chunk, PacketTally
from evedrop.simulate.finished_tasks import FinishedTasks
from evedrop.simulate.simulation import Mode, Simulation
from evedrop.simulate.tasks import OnProgress, Stopped, Task

BLOCK_TRIALS = 500
_SIDE_BY_SIDE = 4  # blocks: spreads the overhead of numpy calls over more trials, and the state still fits the cache

_MOST_WORK = (
    500_000_000  # trial-slots and receivers of a task of several blocks: about a minute, lost if it is interrupted
)


@dataclass(frozen=True)
class TrialBlock:
    """The results of one block of trials, by receiver."""

    start: int
    trials: int
    sums: dict[str, SlotSums]
    run_tally: RunTally
    accountants: dict[str, Accountant]
    digests: dict[str, dict[int, Digests]]
    packets: PacketTally


@dataclass(frozen=True)
class BatchResult:
    """The results of a task."""

    start: int
    blocks: list[TrialBlock]
    errors: dict[str, SlotHistograms]
    traces: dict[str, SlotHistograms]
    recorded: list[Slots] = field(default_factory=list)
    """The recorded trials of the task, in parts."""

    @property
    def complete(self) -> bool:
        """Whether every trial has every slot."""
        return all(tally.done == tally.slots for block in self.blocks for tally in block.run_tally.tallies.values())


@final
@dataclass(frozen=True)
class TrialsTask(Task[BatchResult]):
    """Consecutive blocks of trials whose metrics are all kept."""

    mode: Mode

    def carry_out(self, on_progress: OnProgress, stopped: Stopped) -> BatchResult:
        """Simulate the trials."""
        return carry_out(self, on_progress, stopped)

    def example(self) -> BatchResult:
        """A result of one trial without slots, with recorded ones."""
        scenario = Scenario.read(self.scenario)
        expected = {name: np.zeros(scenario.slots) for name in scenario.receivers}
        histograms = {name: SlotHistograms(1, 1.0) for name in scenario.receivers}
        first = replace(self, stop=self.start + 1)
        (block, _) = _empty_block(scenario, first, self.start, expected, HeardBitsStream(scenario))
        block.run_tally.begin()
        return BatchResult(self.start, [block], histograms, histograms, [Slots.example(scenario.receivers)])


def tasks_of(scenario: Scenario, mode: Mode, workers: int, finished: FinishedTasks | None = None) -> list[TrialsTask]:
    """Split the trials, in order, into parts of nearly equal size, the same number for each worker.

    finished: has the results of some tasks, which stay as they are; the trials between them are split.
    """
    tables = scenario.model_dump(mode="json")
    end = scenario.first_trial + scenario.trials
    done = [] if finished is None else finished.ranges(TrialsTask(tables, scenario.first_trial, end, mode))
    work = BLOCK_TRIALS * scenario.slots * len(scenario.receivers)
    side_by_side = max(1, min(_SIDE_BY_SIDE, _MOST_WORK // work))
    bounds, at = list[tuple[int, int]](), scenario.first_trial
    for done_range in (*done, range(end, end)):
        if done_range.start >= at:  # no trial twice
            bounds += [
                *_split(at, done_range.start, workers, side_by_side),
                *([(done_range.start, done_range.stop)] if done_range else []),
            ]
            at = done_range.stop
    return [TrialsTask(tables, start, stop, mode) for start, stop in bounds]


def _split(first: int, end: int, workers: int, side_by_side: int) -> Iterator[tuple[int, int]]:
    """First trials and ends of the parts of some trials, each of whole blocks, at most `side_by_side`."""
    blocks = -(-(end - first) // BLOCK_TRIALS)
    rounds = -(-blocks // (workers * side_by_side))
    if count := min(blocks, rounds * workers):
        yield from pairwise(min(first - BLOCK_TRIALS * (-blocks * i // count), end) for i in range(count + 1))


def carry_out(task: TrialsTask, on_progress: OnProgress, stopped: Stopped, stops: Collection[int] = ()) -> BatchResult:
    """Simulate a task. `on_progress` gets the trial-slots done since its last call; the simulation ends early once `stopped`.

    stops: slots before which `stopped` is asked in any case.
    """
    scenario = Scenario.read(task.scenario)
    names, slots = scenario.receivers, scenario.slots
    trials = range(task.start, task.stop)
    recorded = max(0, min(scenario.first_trial + scenario.record_trials, task.stop) - task.start)
    simulation = Simulation(scenario, trials, task.mode, stops=stops)
    process = scenario.process.process
    scale = float(np.trace(process.Q)) or float(np.trace(process.initial_covariance)) or 1.0  # where there is no noise
    expected = theoretical_traces_of(scenario)
    revealed = HeardBitsStream(scenario)
    blocks, keepers = zip(
        *(_empty_block(scenario, task, start, expected, revealed) for start in trials[::BLOCK_TRIALS]), strict=True
    )
    result = BatchResult(
        task.start,
        list(blocks),
        {name: SlotHistograms(slots, scale) for name in names},
        {name: SlotHistograms(slots, scale) for name in names},
    )
    for chunk in simulation.chunks():
        count = len(next(iter(chunk.receivers.values())).error)
        some = range(chunk.first, chunk.first + count)
        for block, keeper in zip(blocks, keepers, strict=True):
            rows = slice(block.start - task.start, block.start - task.start + block.trials)
            if chunk.slots is None:
                _add(
                    block,
                    task.mode,
                    rows,
                    chunk,
                    {name: receiver[some.start : some.stop] for name, receiver in expected.items()},
                )
            else:
                _score(block, keeper, rows, chunk, chunk.slots)
        for name, receiver in chunk.receivers.items():
            result.errors[name].add_values(chunk.first, receiver.error)
            result.traces[name].add_values(chunk.first, receiver.trace)
        if chunk.slots is not None and recorded:
            result.recorded.append(chunk.slots.part(slice(0, recorded)).copied())
        on_progress(len(trials) * count)
        if stopped():
            break
    # All trials of the task were simulated side by side, so each decision was for all of them.
    result.blocks[0].run_tally.solve_times.merge(simulation.solve_times)
    for block in result.blocks:
        rows = slice(block.start - task.start, block.start - task.start + block.trials)
        block.packets.add_counts(simulation.packets.part(rows))
        for name, digests in simulation.digests.items():
            block.digests[name] = {number: values[rows] for number, values in digests.items()}
    return result


def _empty_block(
    scenario: Scenario, task: TrialsTask, start: int, expected: Mapping[str, Floats], revealed: HeardBitsStream
) -> tuple[TrialBlock, Scorekeeper]:
    """A block that begins with this trial, and the keeper of its score.

    expected: receiver → its theoretical traces, (slots,); revealed: what packets reveal, for the keepers of all blocks.
    """
    names = scenario.receivers
    trials = min(BLOCK_TRIALS, task.stop - start)
    theory = {name: KnownTraces(traces) for name, traces in expected.items()}
    keeper = Scorekeeper(scenario, trials, theory, revealed)
    block = TrialBlock(
        start,
        trials,
        {name: SlotSums.zero(scenario.slots) for name in names},
        keeper.run_tally if task.mode is Mode.EXACT else RunTally.nothing(scenario, trials),
        {name: Accountant(scenario.window(name), trials) for name in names},
        {},
        PacketTally.zero(trials),
    )
    return block, keeper


@np.errstate(over="ignore")
def _score(block: TrialBlock, keeper: Scorekeeper, rows: slice, chunk: Chunk, slots: Slots) -> None:
    """Add a chunk in exact mode to a block, which has some rows of its trials; all counting happens here.

    The square of a naive receiver's error may leave double precision; then it is inf, as it should be.
    """
    part = slots.part(rows)
    receivers, links, errors_and_traces = {}, {}, {}
    for name, values in part.receivers.items():
        account = _account(block, name, rows, chunk)
        # In order, so that kernels need not copy them again and again.
        measured = chunk.receivers[name]
        error, trace, action = map(
            np.ascontiguousarray, (measured.error[:, rows], measured.trace[:, rows], values.action)
        )
        errors_and_traces[name] = error, trace
        receivers[name] = replace(values, action=action, trace=kernels.sums(trace))
        links[name] = account.slots
        keeper.run_tally.tallies[name].count(account)
    for name, scored in keeper.add_slots(Slots(part.sensor, receivers, links), errors_and_traces).items():
        block.sums[name].add_trials(chunk.first, scored.sums)


@np.errstate(over="ignore")
def _add(block: TrialBlock, mode: Mode, rows: slice, chunk: Chunk, expected: Mapping[str, Floats]) -> None:
    """Add a chunk of another mode, which has no estimates, to a block."""
    for name, values in chunk.receivers.items():
        error, trace, action = values.error[:, rows], values.trace[:, rows], values.action[:, rows]
        sums = slot_sums(error, action)
        if values.error is not values.trace:
            sums = slot_sums(error, action, kernels.sums(trace))
        block.sums[name].add_trials(chunk.first, sums)
        tally = block.run_tally.tallies[name]
        tally.watched.add_slots(ScoredSlots(chunk.first, error, action, sums.trace, expected[name]))
        tally.add_slots(chunk.first, error, sums, expected[name])
        if tally.distance is not None:
            tally.distance.add_slots(chunk.first, error, sums.error)
        if (
            tally.conditional is not None and mode is not Mode.COVARIANCE_ONLY
        ):  # there, the error is its own expectation
            tally.conditional.add_actions(action)
        tally.add_traces(chunk.first, trace)
        account = _account(block, name, rows, chunk)
        tally.account(account.slots, action)
        tally.count(account)


def _account(block: TrialBlock, name: str, rows: slice, chunk: Chunk) -> Account:
    """The account of a receiver's link over a chunk, for a block's trials."""
    fates = chunk.receivers[name].fates.part(trials=rows).copied()
    return block.accountants[name].account(range(chunk.first, chunk.first + len(fates.codes)), fates)
