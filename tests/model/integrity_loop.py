"""A closed loop with a detector, slot by slot, in which every packet arrives: the reference for laws of the steady state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from evedrop.model.controllers.controller import Assignment
from evedrop.model.integrity.monitor import Monitor, MonitorPlan
from evedrop.model.integrity.theory import loop_of
from evedrop.model.local_filter import LocalFilter
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Process, product
from evedrop.model.schemes.plain import PlainEncoder
from evedrop.model.slot.plant import PlantCore
from evedrop.model.slot.sensor import SensorCore
from evedrop.streams import Batch
from tests.builders import stream_keys

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


@dataclass(frozen=True)
class LoopRun:
    """What a simulation has found."""

    statistic: Floats
    """(slots, R)."""
    watermark: Floats
    """(slots, m, R)."""
    epsilon: Floats
    """Normalised innovations, (slots, p, R)."""
    cost: Floats
    """xᵀ W x + uᵀ U u, with u as it is applied, (slots, R)."""


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
    process, plant, loop = assignment.process, assignment.plant, loop_of(assignment)
    keys, batch = stream_keys(1, ("process", "measurement", "watermark", "spoofing")), Batch(slots, trials)
    plan = MonitorPlan.of(loop, watermark, policy, attack, spans)
    states = PlantCore(process, keys["process"], batch, None, plant, np.zeros((slots, 0)))
    local = LocalFilter(process, plant, keys["measurement"], batch, plan.spoofing(keys["spoofing"], batch))
    monitor = Monitor(plan, keys["watermark"], batch)
    sensor = SensorCore(PlainEncoder(), states, local, None, monitor)
    found: tuple[list[Floats], ...] = ([], [], [], [])
    for k in range(slots):
        made = sensor.send(range(k, k + 1))
        assert made.monitored is not None
        statistic, watermark = made.monitored.statistic[0], made.monitored.watermark[0]
        u = -product(loop.L, made.x[0])
        sensor.hold(u)
        applied, x = u + watermark, made.true[0]
        cost = assignment.state_weights @ (x * x) + assignment.input_weights @ (applied * applied)
        for column, values in zip(found, (statistic, watermark, local.normalised, cost), strict=True):
            column.append(values)
    return LoopRun(*map(np.array, found))


def first_alarms(run: LoopRun, threshold: float) -> Floats:
    """The slot of the first alarm of every trial, (R,); infinite without one."""
    raised = run.statistic >= threshold
    return np.where(raised.any(axis=0), raised.argmax(axis=0), np.inf)
