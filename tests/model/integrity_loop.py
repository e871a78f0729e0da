"""Two closed loops with a detector, in which every packet arrives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from evedrop.model.controllers import Assignment
from evedrop.model.integrity.monitor import MonitorPlan
from evedrop.model.integrity.theory import loop_of
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Process
from evedrop.model.slot.monitored_loop import LoopRun, simulate

INF = np.array([np.inf])
ONE = np.array([[1.0]])
SCALAR = Assignment(
    Process(1.05 * ONE, 0.1 * ONE, 0.17 * ONE),
    Plant(ONE, np.zeros((1, 0)), 0.1 * ONE, np.zeros(1), -INF, INF, -INF, INF, ONE, 0.1 * ONE),
    1, 1.0, np.ones(1), np.array([0.1]), np.zeros(1), INF, {},
)  # fmt: skip
"""a = 1.05, b = c = 1, q = r = 0.1, weights 1 and 0.1."""
_INF2 = np.full(2, np.inf)
PLANAR = Assignment(
    Process(np.array([[1.0, 0.1], [0.0, 0.9]]), 0.1 * np.eye(2), 0.2 * np.eye(2)),
    Plant(
        np.array([[0.0, 0.2], [0.5, 0.1]]), np.zeros((2, 0)), np.array([[0.02, 0.0], [0.0, 0.05]]), np.zeros(2),
        -_INF2, _INF2, -_INF2, _INF2, np.array([[1.0, 0.0], [0.5, 1.0]]), np.array([[0.05, 0.01], [0.01, 0.1]]),
    ),
    1, 1.0, np.array([1.0, 0.2]), np.array([0.1, 0.3]), np.zeros(2), _INF2, {},
)  # fmt: skip
"""Two states, inputs and measurements."""
REPLACED = ("replace", {"matrix": [[0.8]]})
ALWAYS = ("always", {"threshold": 8.0})


def simulated(
    watermark: Floats,
    slots: int,
    trials: int,
    attack: tuple[str, Mapping[str, Any]] | None = None,
    spans: Sequence[tuple[int, int]] = (),
    policy: tuple[str, Mapping[str, float]] = ALWAYS,
    assignment: Assignment = SCALAR,
) -> LoopRun:
    """A batch of loops with seed 1."""
    return simulate(assignment, MonitorPlan.of(loop_of(assignment), watermark, policy, attack, spans), slots, trials)
