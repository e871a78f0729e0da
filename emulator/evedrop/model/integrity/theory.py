"""The closed forms of quickest detection with a watermark: divergence, delay, false alarms and cost.

Source: docs/mathematics/attacks.md, integrity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evedrop.model.controllers import Assignment, riccati
from evedrop.model.integrity.attacks import SensorAttack
from evedrop.model.integrity.loop import WatermarkedLoop, spread
from evedrop.model.integrity.monitor import assumed
from evedrop.model.kernels.elementary import cholesky, inverse
from evedrop.model.local_filter import settled
from evedrop.model.process import Floats, product


def loop_of(assignment: Assignment) -> WatermarkedLoop:
    """The steady state of a regulator's loop. Raises ValueError if its filter or its regulator has none.

    The regulator decides in every slot, and does not weigh the inputs' changes.
    """
    process, plant = assignment.process, assignment.plant
    step = settled(process, plant)
    assert plant.output_matrix is not None  # noqa: S101 - else the filter has no steady state
    L, weight = riccati(assignment)
    n = process.n
    B = plant.input_matrix
    cost = np.diag(assignment.input_weights) + spread(B.T, weight[:n, :n])
    return WatermarkedLoop(process.A, B, plant.output_matrix, step.gain, step.expected, L[:, :n], cost)


@dataclass(frozen=True)
class WatermarkTheory:
    """What a watermark achieves and costs."""

    divergence: float
    """D, in nats per slot: how fast evidence of the attack grows."""
    cost: float
    """tr[(BᵀΠB + U) Σ_e], in each slot with a watermark."""

    @classmethod
    def of(cls, loop: WatermarkedLoop, attack: SensorAttack, watermark: Floats) -> WatermarkTheory:
        """For a watermark of this covariance, (m, m), against an attack. Raises ValueError as `WatermarkedLoop.deceived`."""
        T = assumed(loop, attack, watermark)
        shift = product(inverse(cholesky(loop.innovation)), product(loop.C, loop.B))
        log_det = 2.0 * float(np.log(np.diag(cholesky(T))).sum())
        divergence = 0.5 * (float(np.trace(T + spread(shift, watermark))) - len(T) - log_det)
        return cls(divergence, watermark_cost(loop, watermark))


def watermark_cost(loop: WatermarkedLoop, watermark: Floats) -> float:
    """tr[(BᵀΠB + U) Σ_e]."""
    return float(np.trace(product(loop.weight, watermark)))
