"""A closed loop with watermark, detector and attack, slot by slot, in which every packet arrives: no network, no other receivers.

Its sensor, filter, plant and monitor are those of live runs.

Source: docs/mathematics/attacks.md, integrity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evedrop.model.controllers import Assignment
from evedrop.model.integrity.monitor import Monitor, MonitorPlan
from evedrop.model.integrity.theory import loop_of
from evedrop.model.local_filter import LocalFilter
from evedrop.model.process import Floats, product
from evedrop.model.schemes.plain import PlainEncoder
from evedrop.model.slot.cores import PlantCore, SensorCore
from evedrop.model.streams import Batch, root_of_seed, stream_key


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

    def first_alarms(self, threshold: float) -> Floats:
        """The slot of the first alarm of every trial, (R,); infinite without one."""
        raised = self.statistic >= threshold
        return np.where(raised.any(axis=0), raised.argmax(axis=0), np.inf)


def simulate(assignment: Assignment, plan: MonitorPlan, slots: int, trials: int, seed: int = 1) -> LoopRun:
    """A batch of loops whose controller is the regulator of the assignment, without limits of the inputs."""
    process, plant, loop = assignment.process, assignment.plant, loop_of(assignment)
    root, batch = root_of_seed(seed), Batch(slots, trials)
    keys = {name: stream_key(root, name) for name in ("process", "measurement", "watermark", "spoofing")}
    spoofing = plan.spoofing(keys["spoofing"], batch)
    local = LocalFilter(process, plant, keys["measurement"], batch, spoofing)
    states = PlantCore(
        process, keys["process"], batch, None, plant, np.zeros((slots, plant.disturbance_matrix.shape[1]))
    )
    monitor = Monitor(plan, keys["watermark"], batch)
    sensor = SensorCore(PlainEncoder(), states, local, None, monitor)
    columns: tuple[list[Floats], ...] = ([], [], [], [])
    for k in range(slots):
        made = sensor.send(range(k, k + 1)).slots
        u = -product(loop.L, made.x[0])
        sensor.set_inputs(u)
        applied, x = u + monitor.watermark, made.states[0]
        cost = assignment.state_weights @ (x * x) + assignment.input_weights @ (applied * applied)
        for column, values in zip(columns, (monitor.statistic, monitor.watermark, local.normalised, cost), strict=True):
            column.append(values)
    return LoopRun(*map(np.array, columns))
