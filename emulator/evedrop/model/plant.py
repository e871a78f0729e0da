"""The plant behind a process: x_{k+1} = A x_k + B u_k + B_d d_k + w_k, moved by inputs and disturbances.

States here are deviations from the public reference, as they are transmitted. The process's Q is the covariance that network,
estimators and eavesdroppers assume for everything that moves the state; the plant's own noise w has its own covariance.

Source: docs/mathematics.md, closed loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from evedrop.model.process import Floats, product
from evedrop.model.receiver import Flags


@dataclass(frozen=True)
class Plant:
    """A plant except A, which the process has, and the values of disturbances; n states, m inputs, q disturbances."""

    input_matrix: Floats
    """B, (n, m)."""
    disturbance_matrix: Floats
    """B_d, (n, q)."""
    noise: Floats
    """Covariance of w, (n, n); it may be singular, or 0."""
    start: Floats
    """Mean of x_0, (n,)."""
    input_lower: Floats
    """(m,); −inf where there is no limit. The limits below are the same."""
    input_upper: Floats
    state_lower: Floats
    """(n,)."""
    state_upper: Floats
    output_matrix: Floats | None = None
    """C, (p, n), for a sensor that measures y = C x + v and filters; None for a sensor that knows x."""
    measurement_noise: Floats | None = None
    """Covariance of v, (p, p)."""

    @property
    def inputs(self) -> int:
        """The number of inputs."""
        return int(self.input_matrix.shape[1])

    def limited(self, u: Floats) -> Floats:
        """The inputs u (m, R), clipped to their limits."""
        return np.minimum(np.maximum(u, self._lower), self._upper)

    def clips(self, u: Floats) -> Flags:
        """Whether any input of u (…, m, R) is beyond its limits, (…, R)."""
        return np.asarray(((u < self._lower) | (u > self._upper)).any(axis=-2))

    def entering(self, u: Floats, e: Floats) -> Floats:
        """What a watermark e adds to the inputs u, (m, R): e itself, except where the limits clip it."""
        return self.limited(u + e) - self.limited(u)

    def moved(self, u: Floats) -> Floats:
        """B u, (n, R), with the inputs u (m, R) clipped to their limits."""
        return product(self.input_matrix, self.limited(u))

    @cached_property
    def _lower(self) -> Floats:
        return self.input_lower[:, None]

    @cached_property
    def _upper(self) -> Floats:
        return self.input_upper[:, None]


@final
class Drive:
    """The effect of inputs and disturbances on a plant's state, from slot to slot.

    disturbances: d (slots, q).
    """

    def __init__(self, plant: Plant, disturbances: Floats) -> None:
        self._plant = plant
        drift = np.zeros((len(disturbances), len(plant.start)))
        for j in range(disturbances.shape[1]):
            drift += disturbances[:, j, None] * plant.disturbance_matrix[:, j]
        self._drift = drift
        self._start = plant.start[:, None]
        self._u: Floats | None = None
        self._moved: Floats
        self._e: Floats | None = None

    def set_inputs(self, u: Floats) -> None:
        """Apply the inputs u (m, R) from now on, until others come."""
        self._u, self._moved = u, self._plant.moved(u)

    def add_watermark(self, e: Floats) -> None:
        """Add the watermark e, (m, R), to the inputs from now on, until there is another one."""
        self._e = e

    @property
    def entered(self) -> Floats | None:
        """What the watermark adds to the inputs, (m, R); None without a watermark, or before the first inputs."""
        return None if self._u is None or self._e is None else self._plant.entering(self._u, self._e)

    def pushed(self, k: int) -> Floats:
        """What is added to A x and w in slot k, (n, R) or (n, 1): B (u + e)_{k−1} + B_d d_{k−1}; for k = 0 the start."""
        if k == 0:
            return self._start
        drift: Floats = self._drift[k - 1, :, None]
        if self._u is None:
            return drift
        return (self._moved if self._e is None else self._plant.moved(self._u + self._e)) + drift
