"""The base class of controllers and its assignment: from the estimate of a slot to the inputs held from then on."""

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
    """All that a controller knows. States are deviations from the public reference, to which it steers."""

    process: Process
    """Its A is the plant's A."""
    plant: Plant
    period: int
    """Slots between decisions; the inputs are held between them."""
    slot_seconds: float
    """The duration of a slot."""
    state_weights: Floats
    """Diagonal of the weight of the states, (n,)."""
    input_weights: Floats
    """Diagonal of the weight of the inputs, (m,)."""
    rate_weights: Floats
    """Diagonal of the weight of the inputs' change between decisions, (m,)."""
    rate_limits: Floats
    """The largest change of each input between decisions, (m,); inf where there is no limit."""
    parameters: Mapping[str, Any]
    """The strategy's own parameters."""


class Controller(ABC):
    """A control strategy. Each file of this folder defines one, registered by its name in a scenario.

    `parameters` are the entries of the scenario's `[controller]` for this strategy, each with an example.
    """

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    optional: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    """Defaults of the `parameters` that may be left out."""

    def __init__(self, assignment: Assignment, trials: int) -> None:
        self.assignment = assignment
        self.trials = trials
        self.failed: Flags = np.zeros(trials, np.bool_)
        """Whether the last decision failed, (R,), so that the previous inputs were held."""

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Mistakes in parameters, all of them known but some perhaps missing: (entry, value found and expected)."""
        del given
        return []

    @classmethod
    @abstractmethod
    def objections(cls, assignment: Assignment) -> list[tuple[str, str]]:
        """Reasons why it cannot do what is asked: (entry of `[controller]`, value found and expected)."""

    @abstractmethod
    def decide(self, k: int, x_hat: Floats, d: Floats) -> Floats:
        """The inputs (m, R) from slot k on, a multiple of the period; slots come in order.

        x_hat: estimate of the state of slot k, (n, R); d: the disturbances of slot k, (q,), or (q, R) where trials differ.
        Sets `failed`. A trial's inputs must not depend on the other trials.
        """
