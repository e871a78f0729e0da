"""A μ_d for each slot of a short run: the schedule that keeps the legitimate error low and makes an eavesdropper's large.

The problem has the errors that a schedule leads to, and what it is to reach. The schedule is found by climbing over all slots at
once, from several starts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import itemgetter
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from evedrop.errors import UsageError
from evedrop.model.process import Floats, Process
from evedrop.model.theory.covariances import Outcomes, OutcomesAt, misled_covariances
from evedrop.model.theory.json_values import JsonFields, json_value
from evedrop.model.theory.leak import RemainingCovariances

ROUNDING = 1e-12
"""By how much, relatively, a trace may exceed its bound, or a score another one."""


@final
class SlotRecursion:
    """E P_k of one receiver for many schedules at once, slot by slot: its map of a slot is affine in μ_d(k).

    E_0 = p_0 Σ0, E_k = p_k A E_{k−1} Aᵀ + p_d Q + p_i f_k + p_l M_k, with probabilities that are affine in μ_d(k).

    Source: docs/mathematics/secrecy.md, schedules of the state probability.
    """

    def __init__(self, process: Process, outcomes_at: OutcomesAt, slots: int) -> None:
        never, always = outcomes_at(0.0), outcomes_at(1.0)
        self._A, self._Q = process.A, process.Q
        self._base = _probabilities(never)
        self._slope = _probabilities(always) - self._base
        self.initial: Floats = always.initial * process.initial_covariance
        """E P_0, (n, n): the first packet is always the state."""
        self._misled = misled_covariances(process, slots)
        self._remaining = np.zeros_like(self._misled)
        if never.leaked:
            self._remaining[1:] = RemainingCovariances(process).next(slots - 1)

    def next(self, k: int, E: Floats, mu_d: Floats) -> Floats:
        """E P_k, (S, n, n), from E P_{k−1}, (S, n, n), with μ_d(k), (S,)."""
        kept, predicted, misled, leaked = (self._base[:, None] + self._slope[:, None] * mu_d)[:, :, None, None]
        covariance: Floats = (
            kept * (self._A @ E @ self._A.T)
            + predicted * self._Q
            + misled * self._misled[k]
            + leaked * self._remaining[k]
        )
        return covariance

    def traces(self, mu_d: Floats) -> Floats:
        """Trace of E P_k for k = 0 … N−1 of schedules, (S, N) → (S, N); μ_d(0) is taken as 1."""
        traces = np.empty(mu_d.shape)
        E = np.broadcast_to(self.initial, (len(mu_d), *self.initial.shape))
        traces[:, 0] = np.trace(self.initial)
        for k in range(1, mu_d.shape[1]):
            E = self.next(k, E, mu_d[:, k])
            traces[:, k] = np.trace(E, axis1=1, axis2=2)
        return traces


def _probabilities(outcomes: Outcomes) -> Floats:
    return np.array([outcomes.propagated, outcomes.predicted, outcomes.misled, outcomes.leaked])


@dataclass(frozen=True)
class ScheduleProblem:
    """What a schedule is to reach: the largest Σ_k (1 − weight) tr E Pᵉ_k − weight tr E P_k with tr E P_k ≤ Ω in each slot."""

    legitimate: SlotRecursion
    eavesdropper: SlotRecursion
    slots: int
    max_trace: float
    """Ω; inf for no bound."""
    weight: float

    def sums(self, mu_d: Floats) -> Floats:
        """The sum of each schedule, (S, N) → (S,); −inf for those that violate Ω."""
        ours, theirs = self.legitimate.traces(mu_d), self.eavesdropper.traces(mu_d)
        total = ((1.0 - self.weight) * theirs - self.weight * ours).sum(axis=1)
        return np.where((ours <= self.max_trace * (1.0 + ROUNDING)).all(axis=1), total, -np.inf)

    def sum_of(self, mu_d: Floats) -> float:
        """The sum of one schedule, (N,)."""
        return float(self.sums(mu_d[None])[0])


_MOST_PATTERNS, _PATTERN_SLOTS = 24, 240  # starts of each kind: as many as a long schedule leaves time for
_SNAP = 1e-6  # a μ_d nearer than this to 0 or 1 is meant to be it


def patterns(slots: int, blocks: list[slice]) -> list[Floats]:
    """Schedules, (N,), to climb from: states in one block alone, or in all blocks up to one. They need not keep Ω."""
    schedules = []
    count = max(2, min(_MOST_PATTERNS, _PATTERN_SLOTS // slots))
    for i in np.unique(np.linspace(0, len(blocks) - 1, count).astype(np.int64)).tolist():
        for first in (i, 0):
            mu_d = np.zeros(slots)
            mu_d[0] = mu_d[blocks[first].start : blocks[i].stop] = 1.0
            schedules.append(mu_d)
    return schedules


def climbed(problem: ScheduleProblem, start: Floats, blocks: list[slice]) -> Floats:
    """A schedule, (N,), that keeps Ω, by a sequential quadratic program over all blocks at once.

    Every trace is affine in the μ_d of a single slot, so that its derivative is the difference between its values at 1 and 0.
    """
    from scipy.optimize import minimize  # noqa: PLC0415 - slow to import

    slots = problem.slots
    bound = problem.max_trace if math.isfinite(problem.max_trace) else 1.0
    scale = max(abs(float(replace(problem, max_trace=math.inf).sums(np.ones((1, slots)))[0])), 1e-300)
    member = np.zeros((slots, len(blocks)))
    for i, block in enumerate(blocks):
        member[block, i] = 1.0

    def schedule(of: Floats) -> Floats:
        probabilities: Floats = member @ np.clip(of, 0.0, 1.0)
        probabilities[0] = 1.0
        return probabilities

    def derivatives(recursion: SlotRecursion, of: Floats) -> Floats:
        """Of the trace of each slot by the μ_d of each block, (N, B)."""
        mu_d = schedule(of)
        ends = np.repeat(mu_d[None], 2 * (slots - 1), axis=0)
        index = np.arange(slots - 1)
        ends[index, index + 1], ends[index + slots - 1, index + 1] = 0.0, 1.0
        traces = recursion.traces(ends)
        by_slot = np.vstack([np.zeros(slots), traces[slots - 1 :] - traces[: slots - 1]])
        return by_slot.T @ member

    def loss(of: Floats) -> float:
        ours, theirs = (each.traces(schedule(of)[None])[0] for each in (problem.legitimate, problem.eavesdropper))
        return float((problem.weight * ours - (1.0 - problem.weight) * theirs).sum()) / scale

    def slope(of: Floats) -> Floats:
        ours, theirs = (derivatives(each, of) for each in (problem.legitimate, problem.eavesdropper))
        return np.asarray((problem.weight * ours - (1.0 - problem.weight) * theirs).sum(axis=0) / scale)

    constraint: Any = {
        "type": "ineq",
        "fun": lambda of: 1.0 - problem.legitimate.traces(schedule(of)[None])[0, 1:] / bound,
        "jac": lambda of: -derivatives(problem.legitimate, of)[1:] / bound,
    }
    minimum = minimize(
        loss,
        np.array([start[block.start] for block in blocks]),
        jac=slope,
        bounds=[(0.0, 1.0)] * len(blocks),
        constraints=[constraint] if math.isfinite(problem.max_trace) else [],
        method="SLSQP",
        options={"maxiter": 100, "ftol": 1e-10},
    )
    mu_d = schedule(np.nan_to_num(minimum.x, nan=1.0))
    mu_d[mu_d < _SNAP], mu_d[mu_d > 1.0 - _SNAP] = 0.0, 1.0
    return _repaired(problem, mu_d)


def _repaired(problem: ScheduleProblem, mu_d: Floats) -> Floats:
    """The nearest schedule, (N,), on the way from one to states alone that keeps Ω: the legitimate error falls with each μ_d.

    Slots without states keep none, if Ω can be kept so.
    """
    way = np.where(mu_d > 0.0, 1.0 - mu_d, 0.0)
    if not math.isfinite(problem.sum_of(mu_d + way)):
        way = 1.0 - mu_d
    least = _least_of(lambda fractions: problem.sums(mu_d + fractions[:, None] * way), 1.0)
    return mu_d + least * way


def _least_of(sums: Callable[[Floats], Floats], high: float) -> float:
    """The least number from 0 to `high` from which on the sum is finite, to 33⁻⁸ of it; at `high` it is.

    sums: gives the sums for several numbers.
    """
    low = 0.0
    for _ in range(_REFINEMENTS):
        tried = np.linspace(low, high, _POINTS)
        first = int(np.argmax(np.isfinite(sums(tried))))  # that of the last one is finite
        if first == 0:
            return float(tried[0])
        low, high = float(tried[first - 1]), float(tried[first])
    return high


_POINTS, _REFINEMENTS = 33, 8  # the least feasible μ_d of a block is found to 33⁻⁸
_MESH, _ZOOM, _NARROW = 17, 4.0, 1e-3
_PAIR_GAIN = 1e-6
_ASCENDED = 6  # of the schedules found, the best are improved
_DIGIT = 1e-7  # to which a schedule is given
_GAIN = 1e-10  # an improvement of the sum below which the ascent ends, relative


@dataclass(frozen=True)
class MeanSchedule(JsonFields):
    """A schedule with the errors that it leads to."""

    mu_d: tuple[float, ...]
    """μ_d(k) for k = 0 … N−1; the first is 1."""
    legitimate: tuple[float, ...]
    """tr E P_k."""
    eavesdropper: tuple[float, ...]
    """tr E Pᵉ_k."""
    value: float
    """Σ_k (1 − weight) tr E Pᵉ_k − weight tr E P_k."""


@dataclass(frozen=True)
class BestSchedule(JsonFields):
    """The best schedule found, the best that is constant from slot 1 on, and how far the search was exhaustive."""

    best: MeanSchedule
    constant: MeanSchedule
    grid: MeanSchedule
    """The best schedule of the grid, from which the best one was improved."""
    exact: bool
    """Whether `grid` is certainly the best of the grid; otherwise some candidates were dropped."""


@dataclass(frozen=True)
class ScheduleDesign:
    """The best schedules against each eavesdropper of a scenario."""

    schedules: dict[str, BestSchedule]
    left_out: dict[str, str]
    """Eavesdropper → strategy, for those whose error has no closed form."""

    def as_dict(self) -> dict[str, object]:
        """The JSON of `evedrop design --schedule`; `left_out` is present only if it has values."""
        entries: dict[str, object] = {"eavesdroppers": json_value(self.schedules)}
        return {**entries, "left_out": self.left_out} if self.left_out else entries


def best_schedule(
    process: Process,
    mu: float,
    eavesdropper_at: OutcomesAt,
    slots: int,
    max_trace: float = math.inf,
    weight: float = 0.0,
    block: int = 1,
    levels: int = 11,
    capacity: int = 100,
) -> BestSchedule:
    """The μ_d(k) that maximise an eavesdropper's summed error while the legitimate estimator's stays within Ω in every slot.

    eavesdropper_at: μ_d → its outcomes; block: slots, from slot 1 on, that share a μ_d; levels: the number of μ_d in the grid;
    capacity: the most candidates that are kept from slot to slot.

    First the best schedule of the grid, by a dynamic program; then sequential quadratic programs from it and from others; then
    each block's μ_d is set to its best real value, in turn, until nothing improves.

    Raises UsageError if not even sending every state keeps Ω.

    Source: docs/mathematics/secrecy.md, schedules of the state probability.
    """
    legitimate = SlotRecursion(process, lambda mu_d: Outcomes.legitimate(mu, mu_d), slots)
    problem = ScheduleProblem(legitimate, SlotRecursion(process, eavesdropper_at, slots), slots, max_trace, weight)
    least = legitimate.traces(np.ones((1, slots)))[0]
    worst = int(np.argmax(least))
    if not least[worst] <= max_trace:
        raise UsageError(
            f"no schedule keeps the legitimate trace at or below {max_trace:g} in all slots: with μ_d = 1 in each of them, "
            f"where it is least, it is {least[worst]:.6g} in slot {worst}; ask for a trace of at least that, or improve the "
            "legitimate link"
        )
    edges = sorted({*range(1, slots, block), slots})
    blocks = [slice(*bounds) for bounds in pairwise(edges)]
    grid, exact = _best_of_grid(process, problem, blocks, np.linspace(0.0, 1.0, levels), capacity)
    constant = _ascended(problem, np.ones(slots), [slice(1, slots)])
    starts = [grid, constant, _lowest(problem, blocks)]
    schedules = [climbed(problem, start, blocks) for start in (*starts, *patterns(slots, blocks))]
    starts += sorted(schedules, key=problem.sum_of, reverse=True)[:_ASCENDED]
    best = max((_ascended(problem, start, blocks) for start in starts), key=problem.sum_of)
    best = _improved_by_pairs(problem, best, blocks)
    # Upwards, where the legitimate error is smaller: digits beyond these depend on the machine.
    best = np.minimum(np.ceil(best / _DIGIT) * _DIGIT, 1.0).round(7)
    return BestSchedule(_described(problem, best), _described(problem, constant), _described(problem, grid), exact)


def _described(problem: ScheduleProblem, mu_d: Floats) -> MeanSchedule:
    ours, theirs = problem.legitimate.traces(mu_d[None])[0], problem.eavesdropper.traces(mu_d[None])[0]
    value = problem.sum_of(mu_d)
    return MeanSchedule(tuple(mu_d.tolist()), tuple(ours.tolist()), tuple(theirs.tolist()), value)


def _best_of_grid(
    process: Process, problem: ScheduleProblem, blocks: list[slice], levels: Floats, capacity: int
) -> tuple[Floats, bool]:
    """The best schedule whose μ_d are levels, (N,), and whether the search was exhaustive.

    Forward over the slots, with the candidates that no other one dominates: that has a legitimate error at most as large in
    every later slot, an eavesdropper's at least as large, and a sum at least as large so far.
    """
    mu_d = np.ones((1, problem.slots))
    E, F = problem.legitimate.initial[None], problem.eavesdropper.initial[None]
    value, exact = np.zeros(1), True
    for block in blocks:
        count = len(levels)
        mu_d, E, F, value = (np.repeat(array, count, axis=0) for array in (mu_d, E, F, value))
        mu_d[:, block] = np.tile(levels, len(mu_d) // count)[:, None]
        for k in range(block.start, block.stop):
            E, F = problem.legitimate.next(k, E, mu_d[:, k]), problem.eavesdropper.next(k, F, mu_d[:, k])
            ours = np.trace(E, axis1=1, axis2=2)
            value = value + (1.0 - problem.weight) * np.trace(F, axis1=1, axis2=2) - problem.weight * ours
            kept = ours <= problem.max_trace * (1.0 + ROUNDING)
            mu_d, E, F, value = mu_d[kept], E[kept], F[kept], value[kept]
        later = _later_traces(process, np.stack([E, F]), problem.slots - block.stop)
        best = _undominated(np.column_stack([-later[0], later[1], value]))
        if len(best) > capacity:
            exact = False
            by_error = best[np.argsort(later[0][best, 0], kind="stable")]
            # The first one has sent states alone, so it can keep Ω to the end.
            spread = np.linspace(0, len(best) - 1, capacity).astype(np.int64)
            best = np.unique(np.append(by_error[spread], best[np.argmax(value[best])]))
        mu_d, E, F, value = mu_d[best], E[best], F[best], value[best]
    return mu_d[int(np.argmax(value))].copy(), exact


def _later_traces(process: Process, covariances: Floats, slots: int) -> Floats:
    """Trace of A^m P A^mᵀ for m = 0 … slots, (…, n, n) → (…, slots + 1): all of P that matters later."""
    traces = np.empty((*covariances.shape[:-2], slots + 1))
    G = np.eye(process.n)
    for m in range(slots + 1):
        traces[..., m] = (covariances * G).sum(axis=(-2, -1))
        G = process.A.T @ G @ process.A
    return traces


def _undominated(scores: Floats) -> NDArray[np.int64]:
    """The rows, (S, d), that no other row reaches in every column; of equal rows one. Sums rank them, so one pass is enough."""
    scale = np.maximum(np.abs(scores).max(axis=0), 1e-300)
    scores = scores / scale
    order = np.argsort(-scores.sum(axis=1), kind="stable")
    kept = np.empty((len(order), scores.shape[1]))
    rows_kept: list[int] = []
    for row in order.tolist():
        if not (kept[: len(rows_kept)] >= scores[row] - ROUNDING).all(axis=1).any():
            kept[len(rows_kept)] = scores[row]
            rows_kept.append(row)
    return np.array(rows_kept, np.int64)


def _lowest(problem: ScheduleProblem, blocks: list[slice]) -> Floats:
    """The schedule, (N,), whose blocks have the least μ_d, one after the other, with which sending states keeps Ω later."""
    mu_d = np.ones(problem.slots)
    for block in blocks:
        mu_d[block] = _least_feasible(problem, mu_d, block)
    return mu_d


def _ascended(problem: ScheduleProblem, mu_d: Floats, blocks: list[slice]) -> Floats:
    """A schedule, (N,), that no change of a single block improves, from one that keeps Ω.

    The legitimate error falls with each μ_d, so those of a block that keep Ω are all from the least one on.
    """
    mu_d = mu_d.copy()
    best = problem.sum_of(mu_d)
    while True:
        before = best
        for block in blocks:
            low = _least_feasible(problem, mu_d, block)
            tried = np.append(np.linspace(low, 1.0, _POINTS), mu_d[block.start])
            sums = problem.sums(_with(mu_d, block, tried))
            if sums.max() > best:
                best = float(sums.max())
                mu_d[block] = tried[int(np.argmax(sums))]
        if best - before <= _GAIN * abs(best):
            return mu_d


def _improved_by_pairs(problem: ScheduleProblem, mu_d: Floats, blocks: list[slice]) -> Floats:
    """A schedule, (N,), that no change of two neighbouring blocks improves by more than 1e-6, as far as a mesh shows."""
    before = -math.inf
    while (best := problem.sum_of(mu_d)) - before > _PAIR_GAIN * abs(best):
        before = best
        for first_block, second_block in pairwise(blocks):
            middle, width = np.full(2, 0.5), 0.5
            while width > _NARROW:
                axes = (np.clip(np.linspace(at - width, at + width, _MESH), 0.0, 1.0) for at in middle)
                first, second = (axis.reshape(-1) for axis in np.meshgrid(*axes))
                tried = _with(mu_d, first_block, first)
                tried[:, second_block] = second[:, None]
                sums = problem.sums(tried)
                index = int(np.argmax(sums))
                middle, width = np.array([first[index], second[index]]), width / _ZOOM
                best, mu_d = max(((best, mu_d), (float(sums[index]), tried[index])), key=itemgetter(0))
        mu_d = _ascended(problem, mu_d, blocks)
    return mu_d


def _least_feasible(problem: ScheduleProblem, mu_d: Floats, block: slice) -> float:
    return _least_of(lambda tried: problem.sums(_with(mu_d, block, tried)), float(mu_d[block.start]))


def _with(mu_d: Floats, block: slice, tried: Floats) -> Floats:
    schedules = np.repeat(mu_d[None], len(tried), axis=0)
    schedules[:, block] = tried[:, None]
    return schedules
