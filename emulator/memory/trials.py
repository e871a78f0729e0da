"""Batches of trials as tasks for workers, their execution, and their results.

Sums are kept for fixed blocks of 500 trials, however many trials a worker simulates side by side, so results do not depend
on the distribution of the work.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from evedrop.expected.expectations import expected_traces_of
from evedrop.figures.figure import ScoredSlots
from evedrop.memory.simulation import Chunk, Mode, ReceiverChunk, Simulation
from evedrop.model.digest import Digests
from evedrop.model.process import Floats
from evedrop.model.slot.account import Accountant
from evedrop.scenario import Scenario
from evedrop.score.histogram import SlotHistograms
from evedrop.score.slots import Slots
from evedrop.score.sums import SlotSums, slot_sums
from evedrop.score.totals import Totals

BLOCK_TRIALS = 500
_SIDE_BY_SIDE = 4  # blocks: spreads the overhead of numpy calls over more trials, and the state still fits the cache


@dataclass(frozen=True)
class Task:
    """Some consecutive blocks of trials of a scenario."""

    scenario: dict[str, Any]
    """The scenario, from `Scenario.model_dump`."""
    mode: Mode
    start: int
    stop: int


@dataclass(frozen=True)
class TrialBlock:
    """The results of one block of trials, by receiver."""

    start: int
    trials: int
    sums: dict[str, SlotSums]
    totals: Totals
    accountants: dict[str, Accountant]
    digests: dict[str, dict[int, Digests]]


@dataclass(frozen=True)
class BatchResult:
    """The results of a task."""

    start: int
    blocks: list[TrialBlock]
    errors: dict[str, SlotHistograms]
    traces: dict[str, SlotHistograms]
    recorded: list[Slots] = field(default_factory=list)
    """The recorded trials of the task, in parts."""


def tasks_of(scenario: Scenario, mode: Mode, workers: int) -> list[Task]:
    """Split the trials, in order, into parts of nearly equal size, the same number for each worker."""
    blocks = -(-scenario.trials // BLOCK_TRIALS)
    rounds = -(-blocks // (workers * _SIDE_BY_SIDE))
    count = min(blocks, rounds * workers)
    first, end = scenario.first_trial, scenario.first_trial + scenario.trials
    bounds = [min(first - BLOCK_TRIALS * (-blocks * i // count), end) for i in range(count + 1)]
    tables = scenario.model_dump(mode="json")
    return [Task(tables, mode, start, stop) for start, stop in pairwise(bounds)]


def carry_out(task: Task, tell: Callable[[int], None], stopped: Callable[[], bool]) -> BatchResult:
    """Simulate a task. `tell` gets the trial-slots done since its last call; the simulation ends early once `stopped`."""
    scenario = Scenario.model_validate(task.scenario)
    names, slots = scenario.receivers, scenario.slots
    trials = range(task.start, task.stop)
    recorded = max(0, min(scenario.first_trial + scenario.record_trials, task.stop) - task.start)
    simulation = Simulation(scenario, trials, recorded if task.mode is Mode.EXACT else 0, task.mode)
    scale = float(np.trace(scenario.process.process.Q))
    result = BatchResult(
        task.start,
        [_empty_block(scenario, task, start) for start in trials[::BLOCK_TRIALS]],
        {name: SlotHistograms(slots, scale) for name in names},
        {name: SlotHistograms(slots, scale) for name in names},
    )
    expected = expected_traces_of(scenario)
    for chunk in simulation.chunks():
        _add(result, chunk, {name: one[chunk.first : chunk.first + _count(chunk)] for name, one in expected.items()})
        _add_plant(result, chunk)
        if chunk.recorded is not None:
            result.recorded.append(chunk.recorded.copied())
        tell(len(trials) * _count(chunk))
        if stopped():
            break
    # All trials of the task were simulated side by side, so each decision was for all of them.
    result.blocks[0].totals.solve_times.merge(simulation.solve_times)
    for block in result.blocks:
        rows = slice(block.start - task.start, block.start - task.start + block.trials)
        for name, digests in simulation.digests.items():
            block.digests[name] = {number: values[rows] for number, values in digests.items()}
    return result


def _empty_block(scenario: Scenario, task: Task, start: int) -> TrialBlock:
    names = scenario.receivers
    trials = min(BLOCK_TRIALS, task.stop - start)
    totals = Totals.of if task.mode is Mode.EXACT else Totals.nothing
    return TrialBlock(
        start,
        trials,
        {name: SlotSums.zero(scenario.slots) for name in names},
        totals(scenario, trials),
        {name: Accountant(scenario.window(name), trials) for name in names},
        {},
    )


@np.errstate(over="ignore")
def _add(result: BatchResult, chunk: Chunk, expected: dict[str, Floats]) -> None:
    """Add a chunk. The square of a naive receiver's error may leave double precision; then it is inf, as it should be."""
    for name, measured in chunk.receivers.items():
        for block, part in _parts(result.blocks, result.start, measured):
            if measured.error is measured.trace:
                sums = slot_sums(part.error, part.action)
            else:
                trace = np.stack([part.trace.sum(axis=1), (part.trace * part.trace).sum(axis=1)], axis=1)
                sums = slot_sums(part.error, part.action, trace)
            block.sums[name].add(chunk.first, sums)
            tally = block.totals.tallies[name]
            rows = slice(block.start - result.start, block.start - result.start + block.trials)
            x = None if chunk.x is None else chunk.x[..., rows]
            tally.watched.add(
                ScoredSlots(chunk.first, part.error, part.action, sums.trace, expected[name], part.late, x, part.x_hat)
            )
            tally.add(chunk.first, part.error, sums, expected[name])
            account = block.accountants[name].account(range(chunk.first, chunk.first + len(part.error)), part.fates)
            tally.account(account.delivered, part.action, account.lost, account.unsent)
            tally.count(account)
            if account.late is not None and part.late is not None:
                tally.account_late(account.late, *part.late)
        result.errors[name].add(chunk.first, measured.error)
        result.traces[name].add(chunk.first, measured.trace)


def _add_plant(result: BatchResult, chunk: Chunk) -> None:
    """Add a chunk's alarms, and the measurements of a plant's controller and filter."""
    for block in result.blocks:
        totals = block.totals
        rows = slice(block.start - result.start, block.start - result.start + block.trials)
        if totals.detection is not None and chunk.alarms is not None:
            totals.detection.add(chunk.first, chunk.alarms[:, rows])
        if totals.loop is not None and chunk.acted is not None:
            totals.loop.add(chunk.acted.part(rows))
        if totals.filter is not None and chunk.true_errors is not None:
            totals.filter.add({name: error[:, rows] for name, error in chunk.true_errors.items()})


def _parts(blocks: list[TrialBlock], start: int, measured: ReceiverChunk) -> Iterator[tuple[TrialBlock, ReceiverChunk]]:
    """Split the measurements into those of each block."""
    for block in blocks:
        rows = slice(block.start - start, block.start - start + block.trials)
        yield (
            block,
            ReceiverChunk(
                measured.error[:, rows],
                measured.trace[:, rows],
                measured.action[:, rows],
                measured.fates.part(trials=rows),
                None if measured.late is None else measured.late[..., rows],
                None if measured.x_hat is None else measured.x_hat[..., rows],
            ),
        )


def _count(chunk: Chunk) -> int:
    return len(next(iter(chunk.receivers.values())).error)
