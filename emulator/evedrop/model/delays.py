"""Delay models of links by their name in a scenario: a class each, and those of other modules.

A delay model makes the delay of every packet, in slots, from random numbers.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from evedrop.model.checks import Parametrised, is_number, number_mistakes
from evedrop.model.kernels.elementary import exp, log
from evedrop.model.process import Floats
from evedrop.model.registry import Registry

LONGEST = 1e6
"""The longest delay in slots; longer delays are cut to it, since no receiver waits that long."""


def length_mistakes(given: Mapping[str, Any], *names: str) -> list[tuple[str, str]]:
    """A mistake for every one of the names that is given and is not a length of time."""
    return [mistake for name in names for mistake in number_mistakes(given, name, 0.0, LONGEST)]


class DelayModel(Parametrised, ABC):
    """Decides delays from random numbers, for all trials at once, slot by slot.

    `parameters` are the entries that the scenario gives it, each with an example; lengths of time are in slots.
    """

    optional: ClassVar[frozenset[str]] = frozenset()
    recorded: ClassVar[str | None] = None
    """The parameter that gets the contents of the recording `file`; None if there is none. Only for built-in models."""
    lengths: ClassVar[tuple[str, ...]] = ()
    """The parameters that are lengths of time, and may therefore be given in seconds."""
    normal: ClassVar[bool] = False
    """Whether it needs standard normal numbers; otherwise it gets uniform ones."""

    @abstractmethod
    def delays(self, first: int, numbers: Floats) -> Floats:
        """Delay of each packet of the next slots in slots, (slots, R), at least 0, from one number each, (slots, R)."""

    @abstractmethod
    def arrived(self, lag: int) -> float | None:
        """Probability that a delay is below lag + 1 slots, so that the packet has arrived; None if slots differ."""


class ConstantDelay(DelayModel):
    """A delay of `value`.

    Source: docs/mathematics/links.md, late packets.
    """

    parameters = MappingProxyType({"value": 2.0})
    lengths = ("value",)

    def __init__(self, value: float) -> None:
        self._value = float(value)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """The length is not negative."""
        return length_mistakes(given, "value")

    def delays(self, first: int, numbers: Floats) -> Floats:  # noqa: ARG002 - every slot alike
        """The constant."""
        return np.full(numbers.shape, self._value)

    def arrived(self, lag: int) -> float | None:
        """1 if the delay is shorter, otherwise 0."""
        return float(self._value < lag + 1)


class Normal(DelayModel):
    """Delays max(0, mean + standard_deviation · N(0, 1)), independent, so packets may overtake each other.

    Source: docs/mathematics/links.md, late packets.
    """

    parameters = MappingProxyType({"mean": 2.0, "standard_deviation": 0.5})
    lengths = ("mean", "standard_deviation")
    normal = True

    def __init__(self, mean: float, standard_deviation: float) -> None:
        self._mean, self._standard_deviation = float(mean), float(standard_deviation)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Neither length is negative."""
        return length_mistakes(given, "mean", "standard_deviation")

    def delays(self, first: int, numbers: Floats) -> Floats:  # noqa: ARG002 - every slot alike
        """Each from a standard normal number."""
        scattered: Floats = self._mean + self._standard_deviation * numbers
        return np.maximum(0.0, scattered)

    def arrived(self, lag: int) -> float | None:
        """Φ((lag + 1 − mean) / standard_deviation)."""
        if self._standard_deviation == 0.0:
            return float(self._mean < lag + 1)
        return 0.5 * math.erfc(-(lag + 1 - self._mean) / (self._standard_deviation * math.sqrt(2.0)))


class Pareto(DelayModel):
    """Delays least · U^(−1/shape), independent: P(delay > d) = (least/d)^shape for d ≥ least.

    Source: docs/mathematics/links.md, late packets.
    """

    parameters = MappingProxyType({"least": 0.5, "shape": 2.0})
    lengths = ("least",)
    shapes: ClassVar[tuple[float, float]] = (0.1, 1000.0)
    """The least and the largest shape."""

    def __init__(self, least: float, shape: float) -> None:
        self._least, self._shape = float(least), float(shape)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A length, and a positive shape."""
        return length_mistakes(given, "least") + number_mistakes(given, "shape", *cls.shapes)

    def delays(self, first: int, numbers: Floats) -> Floats:  # noqa: ARG002 - every slot alike
        """Each from a uniform number in [0, 1)."""
        stretched: Floats = self._least * exp(log(1.0 - numbers) / -self._shape)
        return np.minimum(LONGEST, stretched)

    def arrived(self, lag: int) -> float | None:
        """1 − (least / (lag + 1))^shape."""
        return 1.0 - (self._least / (lag + 1)) ** self._shape if lag + 1 > self._least else 0.0


MOST_DELAYS = 900_000
"""The most recorded delays of all links of a scenario together: the results contain them in their copy of the scenario."""


class RecordedDelay(DelayModel):
    """The packet of slot k takes `values[k]`, repeated without end, and the same in every trial.

    A scenario names a `file`; loading it replaces the name by its numbers, as `values`.
    """

    parameters = MappingProxyType({"values": [0.5, 2.0, 1.25]})
    lengths = ("values",)
    recorded = "values"

    def __init__(self, values: list[float]) -> None:
        self._values = np.array(values, np.float64)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Delays, and at least one."""
        values = given.get("values", [0.0])
        if not isinstance(values, list) or not 1 <= len(values) <= MOST_DELAYS:
            return [("values", f"is not a list of 1 to {MOST_DELAYS} delays; expected values = [0.5, 2.0]")]
        wrong = next((i for i, delay in enumerate(values) if not is_number(delay, 0.0, LONGEST)), None)
        if wrong is not None:
            return [(f"values.{wrong}", f"is not a delay; expected a number from 0 to {LONGEST:.0f}")]
        return []

    def delays(self, first: int, numbers: Floats) -> Floats:
        """The delays of these slots, the same in every trial."""
        places = np.arange(first, first + len(numbers)) % len(self._values)
        return np.repeat(self._values[places][:, None], numbers.shape[1], axis=1)

    def arrived(self, lag: int) -> float | None:  # noqa: ARG002 - slots differ
        """None, because slots differ."""
        return None


_BUILT_IN: Mapping[str, type[DelayModel]] = {
    "constant": ConstantDelay,
    "normal": Normal,
    "pareto": Pareto,
    "trace": RecordedDelay,
}
DELAY_MODELS: Registry[DelayModel] = Registry("delay model", DelayModel, "evedrop.delays", _BUILT_IN, ("model", "unit"))  # type: ignore[type-abstract]


def delay_of(spec: Mapping[str, Any]) -> DelayModel:
    """The delay model that a link's specification describes: `{"model": …, …parameters}`, lengths in slots."""
    parameters = {name: value for name, value in spec.items() if name != "model"}
    return DELAY_MODELS[spec["model"]](**parameters)
