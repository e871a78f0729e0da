"""What a controller is told, and what it must do: from the estimate of a slot to the inputs that are held from then on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Flags


@dataclass(frozen=True)
class Assignment:
    """What a controller is told. States are deviations from the public reference, which is what it steers to."""

    process: Process
    """Its A is the plant's."""
    plant: Plant
    period: int
    """Slots from one decision to the next: the inputs are held between them."""
    slot_seconds: float
    """What a slot lasts."""
    state_weights: Floats
    """Diagonal of the weight of the states, (n,)."""
    input_weights: Floats
    """Diagonal of the weight of the inputs, (m,)."""
    rate_weights: Floats
    """Diagonal of the weight of the inputs' change from one decision to the next, (m,)."""
    rate_limits: Floats
    """By how much each input may change from one decision to the next, (m,); inf where there is no limit."""
    parameters: Mapping[str, Any]
    """The strategy's own."""

    @property
    def spec(self) -> dict[str, Any]:
        """As plain numbers, for a brief, but for process and plant; None for a limit that is none."""
        weights = {name: getattr(self, name).tolist() for name in ("state_weights", "input_weights", "rate_weights")}
        limits = [value if np.isfinite(value) else None for value in self.rate_limits.tolist()]
        return {
            "period": self.period,
            "slot_seconds": self.slot_seconds,
            **weights,
            "rate_limits": limits,
            "parameters": dict(self.parameters),
        }

    @classmethod
    def of(cls, process: Process, plant: Plant, spec: Mapping[str, Any]) -> Assignment:
        """From its `spec`."""
        arrays = {name: np.array(spec[name], np.float64) for name in ("state_weights", "input_weights", "rate_weights")}
        limits = np.array([np.inf if value is None else value for value in spec["rate_limits"]], np.float64)
        return cls(
            process,
            plant,
            spec["period"],
            spec["slot_seconds"],
            **arrays,
            rate_limits=limits,
            parameters=spec["parameters"],
        )


class Controller(ABC):
    """A strategy of control. A file of this folder holds one, registered by its name in a scenario.

    `parameters` are the entries that the scenario's `[controller]` gives this strategy, each with an example.
    """

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    optional: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    """Those of `parameters` that may be left out, with their defaults."""

    def __init__(self, assignment: Assignment, trials: int) -> None:
        self.assignment = assignment
        self.trials = trials
        self.failed: Flags = np.zeros(trials, np.bool_)
        """Where the last decision could not be made, (R,), and the inputs before were held."""

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """What is wrong with parameters that are all known, if not all there: (entry, what was found and expected)."""
        del given
        return []

    @classmethod
    def objections(cls, assignment: Assignment) -> list[tuple[str, str]]:
        """Why it cannot do what is asked: (entry of `[controller]`, what was found and expected)."""
        del assignment
        return []

    @abstractmethod
    def decide(self, k: int, x_hat: Floats, d: Floats) -> Floats:
        """The inputs (m, R) from slot k on, which is a multiple of the period; slots come in order.

        x_hat: estimate of the state of slot k, (n, R); d: the disturbances of slot k, (q,), or (q, R) where trials differ.
        Sets `failed`. A trial's inputs must not depend on what other trials there are.
        """
