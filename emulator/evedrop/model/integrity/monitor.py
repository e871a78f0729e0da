"""The detector for the sensor's filter, slot by slot: it draws the watermark, and tests the filter's innovations.

Source: docs/mathematics/attacks.md, integrity.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from evedrop.model.checks import expect_slots
from evedrop.model.integrity import POLICIES, SENSOR_ATTACKS
from evedrop.model.integrity.attacks import SensorAttack
from evedrop.model.integrity.loop import Source, WatermarkedLoop, spread
from evedrop.model.integrity.policies import WatermarkPolicy
from evedrop.model.kernels.elementary import cholesky, inverse, log, semidefinite_factor
from evedrop.model.process import Floats, product
from evedrop.model.streams import Ahead, Batch, BlockReader


@dataclass(frozen=True)
class Suspicion:
    """The distribution of normalised innovations under attack, given the watermark: ε + G e ~ N(0, T)."""

    precision: Floats
    """T⁻¹, (p, p)."""
    log_det: float
    """log det T."""

    @classmethod
    def of(cls, T: Floats) -> Suspicion:
        """The distribution with this covariance, (p, p), which must be positive definite."""
        return cls(inverse(T), 2.0 * sum(log(np.diag(cholesky(T)).copy()).tolist()))

    def llr(self, epsilon: Floats, shift: Floats) -> Floats:
        """½[εᵀε − (ε + G e)ᵀ T⁻¹ (ε + G e) − log det T], (R,), from ε (p, R) and shift = G e (p, R)."""
        moved = epsilon + shift
        return 0.5 * (_squared(epsilon, epsilon) - _squared(moved, product(self.precision, moved)) - self.log_det)


@dataclass(frozen=True)
class MonitorPlan:
    """Everything that the sensor's process must know of watermark, detector and attack; p measurements, m inputs."""

    watermark: Floats
    """Σ_e, (m, m)."""
    shift: Floats
    """G = F⁻¹ C B with F Fᵀ = Σ_g, (p, m)."""
    unmarked: Suspicion
    """The distribution that the detector assumes under attack, after a slot without watermark."""
    marked: Suspicion
    """The same after a slot with one."""
    policy: str
    parameters: Mapping[str, float]
    """The policy's parameters."""
    attack: str | None
    """None if nobody attacks."""
    attack_data: Mapping[str, Any]
    """As `SensorAttack.plain`."""
    spans: Sequence[tuple[int, int]]
    """The slots [from, to) of the attack."""

    def __post_init__(self) -> None:
        expect_slots(*(slot for span in self.spans for slot in span))

    def expect_sizes(self, p: int, m: int) -> None:
        """Raise ValueError unless it is for p measurements and m inputs."""
        shapes = [M.shape for M in (self.watermark, self.shift, self.marked.precision, self.unmarked.precision)]
        if shapes != [(m, m), (p, m), (p, p), (p, p)]:
            raise ValueError(f"its matrices are {shapes}, and there are {m} inputs and {p} measurements")

    @classmethod
    def of(
        cls,
        loop: WatermarkedLoop,
        watermark: Floats,
        policy: tuple[str, Mapping[str, float]],
        attack: tuple[str, Mapping[str, Any]] | None,
        spans: Sequence[tuple[int, int]] = (),
    ) -> MonitorPlan:
        """The plan for a loop; policy and attack: name and entries.

        The detector is designed for this attack; without one, for a replay. Raises ValueError if there is no stationary
        distribution under attack, or if an attack cannot have the covariance of y.
        """
        none = np.zeros_like(watermark)
        made = None
        if attack is not None:
            made = SENSOR_ATTACKS[attack[0]].of(attack[1], loop, none if POLICIES[policy[0]].rests else watermark)
        return cls(
            watermark,
            product(inverse(cholesky(loop.innovation)), product(loop.C, loop.B)),
            Suspicion.of(assumed(loop, made, none)),
            Suspicion.of(assumed(loop, made, watermark)),
            *policy,
            None if attack is None else attack[0],
            {} if made is None else made.plain,
            spans,
        )

    @property
    def made_policy(self) -> WatermarkPolicy:
        """The policy."""
        return POLICIES[self.policy].of(self.parameters)

    def spoofing(self, key: bytes, batch: Batch) -> Callable[[int, Floats], Floats] | None:
        """Maps the measurements of a slot, (p, R), to those that the filter gets; None if nobody attacks.

        key: of the stream `spoofing`. Slots come in order.
        """
        if self.attack is None:
            return None
        feed = SENSOR_ATTACKS[self.attack].read(self.attack_data).feed(key, batch)
        return lambda k, y: feed(k, y, any(start <= k < stop for start, stop in self.spans))


def assumed(loop: WatermarkedLoop, attack: SensorAttack | None, watermark: Floats) -> Floats:
    """T = F⁻¹ S F⁻ᵀ, (p, p), under an attack; None: under a replay. Raises ValueError as `WatermarkedLoop.deceived`."""
    source: Source = loop.nominal(watermark) if attack is None else attack.source(loop, watermark)
    return spread(inverse(cholesky(loop.innovation)), loop.deceived(source, watermark))


@final
class Monitor:
    """The detector of a batch of trials. key: of the stream `watermark`."""

    def __init__(self, plan: MonitorPlan, key: bytes, batch: Batch) -> None:
        self._plan, self._policy = plan, plan.made_policy
        factor = semidefinite_factor(plan.watermark)
        reader = BlockReader(key, batch, len(factor))
        self._drawn = Ahead(reader.ahead, lambda slots: product(factor, reader.normals(slots)))
        self.statistic: Floats = np.zeros(batch.trials)
        """After the last slot, (R,)."""
        self.watermark: Floats = np.zeros((len(factor), batch.trials))
        """e of the last slot, (m, R)."""

    def take(self, k: int, epsilon: Floats, entered: Floats | None) -> None:
        """Test slot k, and draw its watermark.

        epsilon: the innovation divided by a factor of its covariance, (p, R); entered: what the watermark of the slot before
        added to the plant's inputs, (m, R), None in slot 0.
        """
        if entered is not None:
            plan, marked = self._plan, (self.watermark != 0.0).any(axis=0)
            shift = product(plan.shift, entered)
            llr = np.where(marked, plan.marked.llr(epsilon, shift), plan.unmarked.llr(epsilon, shift))
            self.statistic = self._policy.step(self.statistic, llr)
        self.watermark = np.where(self._policy.marks(self.statistic), self._drawn.at(k), 0.0)


def _squared(a: Floats, b: Floats) -> Floats:
    """aᵀ b of every trial, (R,), summed in the same order however many trials there are."""
    total: Floats = a[0] * b[0]
    for i in range(1, len(a)):
        total = total + a[i] * b[i]
    return total
