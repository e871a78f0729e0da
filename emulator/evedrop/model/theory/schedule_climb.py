"""Climbing to a schedule of μ_d over all slots at once, from several starts.

Source: docs/mathematics.md, schedules of μ_d.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from evedrop.model.process import Floats
from evedrop.model.theory.schedule_problem import ScheduleProblem, SlotRecursion

_MOST_PATTERNS, _PATTERN_SLOTS = 24, 240  # starts of each kind: as many as a long schedule leaves time for
_POINTS, _REFINEMENTS = 33, 8
_SNAP = 1e-6  # a μ_d nearer than this to 0 or 1 is meant to be it


def patterns(slots: int, blocks: list[slice]) -> list[Floats]:
    """Schedules, (N,), to climb from: states in one block alone, or in all blocks up to one. They need not keep Ω."""
    found = []
    count = max(2, min(_MOST_PATTERNS, _PATTERN_SLOTS // slots))
    for i in np.unique(np.linspace(0, len(blocks) - 1, count).astype(np.int64)).tolist():
        for first in (i, 0):
            mu_d = np.zeros(slots)
            mu_d[0] = mu_d[blocks[first].start : blocks[i].stop] = 1.0
            found.append(mu_d)
    return found


def climbed(problem: ScheduleProblem, start: Floats, blocks: list[slice]) -> Floats:
    """A schedule, (N,), that keeps Ω, by a sequential quadratic program over all blocks at once.

    Every trace is affine in the μ_d of a single slot, so that its derivative is the difference between its values at 1 and 0.
    """
    from scipy.optimize import minimize  # noqa: PLC0415 - slow to import

    slots = problem.slots
    bound = problem.max_trace if math.isfinite(problem.max_trace) else 1.0
    scale = max(abs(float(replace(problem, max_trace=math.inf).sums(np.ones((1, slots)))[0])), 1e-300)
    member = np.zeros((slots, len(blocks)))
    for i, one in enumerate(blocks):
        member[one, i] = 1.0

    def schedule(of: Floats) -> Floats:
        found: Floats = member @ np.clip(of, 0.0, 1.0)
        found[0] = 1.0
        return found

    def derivatives(recursion: SlotRecursion, of: Floats) -> Floats:
        """Of the trace of each slot by the μ_d of each block, (N, B)."""
        mu_d = schedule(of)
        ends = np.repeat(mu_d[None], 2 * (slots - 1), axis=0)
        index = np.arange(slots - 1)
        ends[index, index + 1], ends[index + slots - 1, index + 1] = 0.0, 1.0
        traces = recursion.traces(ends)
        by_slot = np.vstack([np.zeros(slots), traces[slots - 1 :] - traces[: slots - 1]])
        found: Floats = by_slot.T @ member
        return found

    def loss(of: Floats) -> float:
        ours, theirs = (each.traces(schedule(of)[None])[0] for each in (problem.user, problem.eavesdropper))
        return float((problem.weight * ours - (1.0 - problem.weight) * theirs).sum()) / scale

    def slope(of: Floats) -> Floats:
        ours, theirs = (derivatives(each, of) for each in (problem.user, problem.eavesdropper))
        found: Floats = (problem.weight * ours - (1.0 - problem.weight) * theirs).sum(axis=0) / scale
        return found

    constraint: Any = {
        "type": "ineq",
        "fun": lambda of: 1.0 - problem.user.traces(schedule(of)[None])[0, 1:] / bound,
        "jac": lambda of: -derivatives(problem.user, of)[1:] / bound,
    }
    found = minimize(
        loss,
        np.array([start[one.start] for one in blocks]),
        jac=slope,
        bounds=[(0.0, 1.0)] * len(blocks),
        constraints=[constraint] if math.isfinite(problem.max_trace) else [],
        method="SLSQP",
        options={"maxiter": 100, "ftol": 1e-10},
    )
    mu_d = schedule(np.nan_to_num(found.x, nan=1.0))
    mu_d[mu_d < _SNAP], mu_d[mu_d > 1.0 - _SNAP] = 0.0, 1.0
    return _repaired(problem, mu_d)


def _repaired(problem: ScheduleProblem, mu_d: Floats) -> Floats:
    """The nearest schedule, (N,), on the way from one to states alone that keeps Ω: the user's error falls with each μ_d.

    Slots without states keep none, if Ω can be kept so.
    """
    way = np.where(mu_d > 0.0, 1.0 - mu_d, 0.0)
    if not math.isfinite(problem.sum_of(mu_d + way)):
        way = 1.0 - mu_d
    low, high = 0.0, 1.0
    for _ in range(_REFINEMENTS):
        fractions = np.linspace(low, high, _POINTS)
        keeps = np.isfinite(problem.sums(mu_d + fractions[:, None] * way))
        first = int(np.argmax(keeps))  # the last one keeps it: the whole way, or the end of the step before
        if first == 0:
            high = float(fractions[0])
            break
        low, high = float(fractions[first - 1]), float(fractions[first])
    found: Floats = mu_d + high * way
    return found
