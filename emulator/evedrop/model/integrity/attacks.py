"""Attacks on the sensor's measurements: other numbers take their place in some slots.

`replace`: the sensor reports a stationary process of the attacker's own, z⁺ = A_a z + w_a, instead of y. `replay`: the sensor
reports again what it reported some slots before, so that an attack repeats the slots before it, over and over.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Self, final

import numpy as np

from evedrop.model.checks import MOST_SLOTS
from evedrop.model.integrity.loop import Source, WatermarkedLoop, spread, stationary
from evedrop.model.kernels.elementary import is_semidefinite, semidefinite_factor
from evedrop.model.process import Floats, product
from evedrop.model.streams import Ahead, Batch, BlockReader

MeasurementFeed = Callable[[int, Floats, bool], Floats]
"""(slot k, the measurements that were made, (p, R), whether the attack is on) → those that the filter gets, (p, R).

Slots come in order from slot 0 on.
"""


class SensorAttack(ABC):
    """An attack on measurements. Each file defines one, registered by its name in a scenario.

    `parameters` are its entries in the scenario, each with an example.
    """

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    optional: ClassVar[tuple[str, ...]] = ()
    """Those of `parameters` that may be left out."""

    @classmethod
    @abstractmethod
    def objections(cls, given: Mapping[str, Any], loop: WatermarkedLoop, first: int) -> list[tuple[str, str]]:
        """Reasons why it is impossible: (entry, value found and expected). first: the slot in which it begins."""

    @classmethod
    @abstractmethod
    def of(cls, given: Mapping[str, Any], loop: WatermarkedLoop, watermark: Floats) -> Self:
        """The attack on a loop whose inputs have a watermark of this covariance, (m, m); given: its entries."""

    @abstractmethod
    def source(self, loop: WatermarkedLoop, watermark: Floats) -> Source:
        """The distribution of the measurements that it makes the sensor report."""

    @property
    @abstractmethod
    def plain(self) -> dict[str, Any]:
        """Its data as numbers and lists of numbers, from which `read` makes it."""

    @classmethod
    @abstractmethod
    def read(cls, plain: Mapping[str, Any]) -> Self:
        """The attack with this data."""

    @abstractmethod
    def feed(self, key: bytes, batch: Batch) -> MeasurementFeed:
        """What it makes the sensors of a batch report; key: of the stream `spoofing`."""


MATRIX, NOISE = "matrix", "noise"


@final
@dataclass(frozen=True)
class Replacement(SensorAttack):
    """A stationary process of the attacker: z⁺ = A_a z + w_a.

    z is stationary from slot 0 on, so that an attack may begin in any slot.
    """

    A: Floats
    """A_a, (p, p)."""
    noise: Floats
    """The covariance of w_a, (p, p)."""

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({MATRIX: [[0.8]], NOISE: [[0.1]]})
    optional = (NOISE,)

    @classmethod
    def objections(cls, given: Mapping[str, Any], loop: WatermarkedLoop, first: int) -> list[tuple[str, str]]:
        """Matrices of a wrong shape, a z that is not stationary, and a noise that is not a covariance."""
        del first
        p = len(loop.C)
        for name in (MATRIX, NOISE):
            rows = given.get(name)
            if rows is not None and [*map(len, rows)] != [p] * p:
                return [
                    (name, f"has rows of {[*map(len, rows)]} numbers; expected {p} × {p}, as output_matrix has rows")
                ]
        A = np.array(given[MATRIX], np.float64)
        try:
            stationary(A, np.eye(p))
        except ValueError:
            radius = float(np.abs(np.linalg.eigvals(A)).max())
            grows = f"has the spectral radius {radius:.4g}, so that the reported values would grow"
            return [(MATRIX, f"{grows}; expected less than 1")]
        rows = given.get(NOISE)
        if rows is None:
            return []
        noise = np.array(rows, np.float64)
        if not np.array_equal(noise, noise.T) or not is_semidefinite(noise):
            return [(NOISE, "is not symmetric with eigenvalues of 0 or more; expected a covariance, such as [[0.1]]")]
        return []

    @classmethod
    def of(cls, given: Mapping[str, Any], loop: WatermarkedLoop, watermark: Floats) -> Replacement:
        """Without `noise`, z has the covariance that y has when nobody attacks. Raises ValueError if it cannot have it."""
        A = np.array(given[MATRIX], np.float64)
        if given.get(NOISE) is not None:
            return cls(A, np.array(given[NOISE], np.float64))
        Y = loop.measurement(watermark)
        noise = Y - spread(A, Y)
        if not is_semidefinite(noise):
            raise ValueError("with this matrix z cannot have the covariance of y")
        return cls(A, noise)

    def source(self, loop: WatermarkedLoop, watermark: Floats) -> Source:
        """The distribution of z itself."""
        del loop, watermark
        return Source(self.A, self.noise, np.eye(len(self.A)))

    @property
    def plain(self) -> dict[str, Any]:
        """Both matrices."""
        return {MATRIX: self.A.tolist(), NOISE: self.noise.tolist()}

    @classmethod
    def read(cls, plain: Mapping[str, Any]) -> Replacement:
        """The attack with this data."""
        return cls(np.array(plain[MATRIX], np.float64), np.array(plain[NOISE], np.float64))

    def feed(self, key: bytes, batch: Batch) -> MeasurementFeed:
        """The values z of every trial."""
        return _Stationary(self, key, batch).take


@final
class _Stationary:
    def __init__(self, attack: Replacement, key: bytes, batch: Batch) -> None:
        self._A = attack.A
        first = semidefinite_factor(stationary(attack.A, attack.noise))
        later = semidefinite_factor(attack.noise)
        reader = BlockReader(key, batch, len(attack.A))

        def drawn(slots: range) -> Floats:
            factors = np.repeat(later[None], len(slots), axis=0)
            if slots.start == 0:
                factors[0] = first
            return product(factors, reader.normals(slots))

        self._noise = Ahead(reader.ahead, drawn)
        self._z: Floats = np.zeros((len(attack.A), batch.trials))

    def take(self, k: int, y: Floats, on: bool) -> Floats:
        self._z = product(self._A, self._z) + self._noise.at(k)
        return self._z if on else y


RECORDED = "recorded"


@final
@dataclass(frozen=True)
class Replay(SensorAttack):
    """The last measurements before the attack, in a loop. Its distribution is that of measurements when nobody attacks."""

    recorded: int
    """The number of slots that were recorded."""

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({RECORDED: 100})

    @classmethod
    def objections(cls, given: Mapping[str, Any], loop: WatermarkedLoop, first: int) -> list[tuple[str, str]]:
        """A recording that would begin before slot 0."""
        del loop
        recorded = given[RECORDED]
        if recorded <= first:
            return []
        wanted = "expected at most as many slots as pass before it"
        return [(RECORDED, f"is {recorded}, but the attack begins in slot {first}; {wanted}")]

    @classmethod
    def of(cls, given: Mapping[str, Any], loop: WatermarkedLoop, watermark: Floats) -> Replay:
        """The attack with this recording."""
        del loop, watermark
        return cls(given[RECORDED])

    def source(self, loop: WatermarkedLoop, watermark: Floats) -> Source:
        """The loop's own measurements, of a time that has passed."""
        return loop.nominal(watermark)

    @property
    def plain(self) -> dict[str, Any]:
        """The number of slots."""
        return {RECORDED: self.recorded}

    @classmethod
    def read(cls, plain: Mapping[str, Any]) -> Replay:
        """The attack with this data."""
        recorded = plain[RECORDED]
        if type(recorded) is not int or not 1 <= recorded <= MOST_SLOTS:
            raise ValueError(f"{RECORDED} is {recorded!r:.40}, expected a number of slots from 1 to {MOST_SLOTS}")
        return cls(recorded)

    def feed(self, key: bytes, batch: Batch) -> MeasurementFeed:
        """The recording of every trial."""
        del key, batch
        return _Recording(self.recorded).take


@final
class _Recording:
    """The slot k of the attack repeats slot k − recorded, so both are at the same place, k modulo `recorded`.

    Of an earlier attack, it repeats what the filter got: nothing is recorded while the attacker's numbers are reported.
    """

    def __init__(self, recorded: int) -> None:
        self._recorded = recorded
        self._measurements: Floats | None = None

    def take(self, k: int, y: Floats, on: bool) -> Floats:
        if self._measurements is None:
            self._measurements = np.zeros((self._recorded, *y.shape))
        if not on:
            self._measurements[k % self._recorded] = y
        again: Floats = self._measurements[k % self._recorded]
        return again
