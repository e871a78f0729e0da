"""The entries of briefs about a closed loop: the plant, its disturbances, and the controller's assignment and connections.

Source: docs/protocol.md, the brief.
"""

from __future__ import annotations

from base64 import b64decode, b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from evedrop.model.controllers.controller import Assignment
from evedrop.model.entries import (
    LIMITS,
    MATRIX,
    NUMBERS,
    SLOT,
    anything,
    entry,
    flag,
    inner,
    listed,
    maybe,
    named,
    not_negative,
    number,
    row,
    text,
    whole,
)
from evedrop.model.integrity.monitor import MonitorPlan, Suspicion
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Process

Matrix = Sequence[Sequence[float]]
Limits = Sequence[float | None]
"""None for a limit that does not exist."""


def encoded(disturbances: Floats) -> str:
    """Disturbances (slots, q) as text for a brief: little-endian float64 in base64."""
    return b64encode(disturbances.astype("<f8").tobytes()).decode()


def decoded(disturbances: str, slots: int) -> Floats:
    """The disturbances of a brief, (slots, q). Raises ValueError if the slots do not all have equally many."""
    return np.frombuffer(b64decode(disturbances), "<f8").reshape(slots, -1)


@dataclass(frozen=True, kw_only=True)
class PlantEntry:
    """A plant as plain numbers."""

    input_matrix: Matrix = field(metadata=entry(MATRIX))
    disturbance_matrix: Matrix = field(metadata=entry(MATRIX))
    noise: Matrix = field(metadata=entry(MATRIX))
    start: Sequence[float] = field(metadata=entry(NUMBERS))
    output_matrix: Matrix | None = field(default=None, metadata=entry(MATRIX, left_out=True))
    """Only if the sensor filters."""
    measurement_noise: Matrix | None = field(default=None, metadata=entry(MATRIX, left_out=True))
    input_lower: Limits = field(metadata=entry(LIMITS))
    input_upper: Limits = field(metadata=entry(LIMITS))
    state_lower: Limits = field(metadata=entry(LIMITS))
    state_upper: Limits = field(metadata=entry(LIMITS))

    @classmethod
    def of(cls, plant: Plant, **own: str) -> Self:
        """The entry of a plant; own: further entries of a subclass."""
        measured = ("output_matrix", "measurement_noise") if plant.output_matrix is not None else ()
        matrices = ("input_matrix", "disturbance_matrix", "noise", "start", *measured)
        limits = ("input_lower", "input_upper", "state_lower", "state_upper")
        found: dict[str, Any] = {name: getattr(plant, name).tolist() for name in matrices}
        found |= {name: _with_none(getattr(plant, name)) for name in limits} | own
        return cls(**found)

    @property
    def plant(self) -> Plant:
        """The plant. Raises ValueError if its matrices do not fit together."""
        n = len(self.start)
        measured = {
            name: np.array(value)
            for name in ("output_matrix", "measurement_noise")
            if (value := getattr(self, name)) is not None
        }
        return Plant(
            input_lower=_limits(self.input_lower, -np.inf),
            input_upper=_limits(self.input_upper, np.inf),
            state_lower=_limits(self.state_lower, -np.inf),
            state_upper=_limits(self.state_upper, np.inf),
            input_matrix=np.array(self.input_matrix, np.float64).reshape(n, -1),
            disturbance_matrix=np.array(self.disturbance_matrix, np.float64).reshape(n, -1),
            noise=np.array(self.noise),
            start=np.array(self.start),
            **measured,
        )


@dataclass(frozen=True, kw_only=True)
class SensorPlantEntry(PlantEntry):
    """The plant of a sensor, which knows the disturbances."""

    disturbances: str = field(metadata=entry(text))
    """As `encoded`."""


@dataclass(frozen=True)
class MonitorEntry:
    """The watermark, the detector for the sensor's filter and the attack on its measurements, as plain numbers."""

    watermark: Matrix = field(metadata=entry(MATRIX))
    """Σ_e."""
    shift: Matrix = field(metadata=entry(MATRIX))
    """G, as in `MonitorPlan`."""
    unmarked: Matrix = field(metadata=entry(MATRIX))
    """T⁻¹ after a slot without watermark."""
    unmarked_log_det: float = field(metadata=entry(number))
    marked: Matrix = field(metadata=entry(MATRIX))
    """T⁻¹ after a slot with one."""
    marked_log_det: float = field(metadata=entry(number))
    policy: str = field(metadata=entry(text))
    parameters: Mapping[str, float] = field(metadata=entry(named(number)))
    attack: str | None = field(metadata=entry(maybe(text)))
    """None if nobody attacks."""
    attack_data: Mapping[str, Any] = field(metadata=entry(named(anything)))
    spans: Sequence[tuple[int, int]] = field(metadata=entry(listed(row(SLOT, SLOT))))
    """The slots [from, to) of the attack."""

    @classmethod
    def of(cls, plan: MonitorPlan) -> MonitorEntry:
        """The entry of a plan."""
        return cls(
            plan.watermark.tolist(),
            plan.shift.tolist(),
            plan.unmarked.precision.tolist(),
            plan.unmarked.log_det,
            plan.marked.precision.tolist(),
            plan.marked.log_det,
            plan.policy,
            dict(plan.parameters),
            plan.attack,
            dict(plan.attack_data),
            [(start, stop) for start, stop in plan.spans],
        )

    @property
    def plan(self) -> MonitorPlan:
        """The plan."""
        return MonitorPlan(
            np.array(self.watermark, np.float64),
            np.array(self.shift, np.float64),
            Suspicion(np.array(self.unmarked, np.float64), self.unmarked_log_det),
            Suspicion(np.array(self.marked, np.float64), self.marked_log_det),
            self.policy,
            self.parameters,
            self.attack,
            self.attack_data,
            self.spans,
        )


@dataclass(frozen=True)
class AssignmentEntry:
    """A controller's assignment as plain numbers, without process and plant."""

    period: int = field(metadata=entry(whole(1)))
    slot_seconds: float = field(metadata=entry(not_negative))
    state_weights: Sequence[float] = field(metadata=entry(NUMBERS))
    input_weights: Sequence[float] = field(metadata=entry(NUMBERS))
    rate_weights: Sequence[float] = field(metadata=entry(NUMBERS))
    rate_limits: Limits = field(metadata=entry(LIMITS))
    parameters: Mapping[str, Any] = field(metadata=entry(named(anything)))

    @classmethod
    def of(cls, assignment: Assignment) -> AssignmentEntry:
        """The entry of an assignment."""
        return cls(
            assignment.period,
            assignment.slot_seconds,
            assignment.state_weights.tolist(),
            assignment.input_weights.tolist(),
            assignment.rate_weights.tolist(),
            _with_none(assignment.rate_limits),
            dict(assignment.parameters),
        )

    def assignment(self, process: Process, plant: Plant) -> Assignment:
        """The assignment for a process and a plant."""
        return Assignment(
            process,
            plant,
            self.period,
            self.slot_seconds,
            np.array(self.state_weights, np.float64),
            np.array(self.input_weights, np.float64),
            np.array(self.rate_weights, np.float64),
            _limits(self.rate_limits, np.inf),
            self.parameters,
        )


@dataclass(frozen=True)
class Wiring:
    """A controller's connections, for the routers."""

    acts_on: str = field(metadata=entry(text))
    """`estimate` or `truth`."""
    knows_input: bool = field(metadata=entry(flag))
    """Whether the legitimate estimator receives the inputs."""

    @property
    def on_truth(self) -> bool:
        """Whether the controller receives the true state."""
        return self.acts_on == "truth"


@dataclass(frozen=True)
class SensorLoopPart:
    """The sensor's part in the loop."""

    period: int = field(metadata=entry(whole(1)))
    """Slots between decisions."""
    acts_on: str = field(metadata=entry(text))
    """As in `Wiring`."""


@dataclass(frozen=True)
class EstimatorLoopPart(SensorLoopPart):
    """The legitimate estimator's part in the loop."""

    plant: PlantEntry | None = field(metadata=inner(PlantEntry, or_null=True))
    """None if it does not know the inputs."""


def _with_none(limits: Floats) -> Limits:
    return [value if np.isfinite(value) else None for value in limits.tolist()]


def _limits(limits: Limits, without: float) -> Floats:
    return np.array([without if value is None else value for value in limits], np.float64)
