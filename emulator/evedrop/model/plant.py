"""The plant behind a process: x_{k+1} = A x_k + B u_k + B_d d_k + w_k, moved by inputs and disturbances.

The legitimate estimator that knows the inputs predicts A x̂ + B u instead of A x̂ in a slot without a packet.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from evedrop.model.checks import expect_shapes
from evedrop.model.process import Floats, Limits, Process, product
from evedrop.model.receiver import Action, Belief, Codes, Flags, Receiver, Reception


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
    input_lower: Limits
    """(m,); −inf where there is no limit. The limits below are the same."""
    input_upper: Limits
    state_lower: Limits
    """(n,)."""
    state_upper: Limits
    output_matrix: Floats | None = None
    """C, (p, n), for a sensor that measures y = C x + v and filters; None for a sensor that knows x."""
    measurement_noise: Floats | None = None
    """Covariance of v, (p, p)."""

    def expect_possible(self) -> None:
        """Raise ValueError unless all matrices and vectors have the shapes that go together."""
        n, m, q = self.start.size, self.input_matrix.shape[-1], self.disturbance_matrix.shape[-1]
        shapes = {"input_matrix": (n, m), "disturbance_matrix": (n, q), "noise": (n, n), "start": (n,)}
        shapes |= {"input_lower": (m,), "input_upper": (m,), "state_lower": (n,), "state_upper": (n,)}
        if self.output_matrix is not None:
            p = len(self.output_matrix)
            shapes |= {"output_matrix": (p, n), "measurement_noise": (p, p)}
        expect_shapes(self, shapes)

    @property
    def inputs(self) -> int:
        """The number of inputs."""
        return int(self.input_matrix.shape[1])

    def limited(self, u: Floats) -> Floats:
        """The inputs u (…, m, R), clipped to their limits."""
        return np.minimum(np.maximum(u, self._lower), self._upper)

    def clips(self, u: Floats) -> Flags:
        """Whether any input of u (…, m, R) is beyond its limits, (…, R)."""
        return np.asarray(((u < self._lower) | (u > self._upper)).any(axis=-2))

    def entering(self, u: Floats, e: Floats) -> Floats:
        """What a watermark e adds to the inputs u, (m, R): e itself, except where the limits clip it."""
        return self.limited(u + e) - self.limited(u)

    def moved(self, u: Floats) -> Floats:
        """B u, (n, R) or (c, n, R), with the inputs u, (m, R) or (c, m, R), clipped to their limits."""
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


def guessed(action: Codes) -> Flags:
    """Whether an estimate is a prediction, (…, R), because no packet was decoded."""
    unread: Flags = (action == int(Action.LOST)) | (action == int(Action.DISCARDED))
    return unread


@final
class InputAwareEstimator(Receiver):
    """A receiver that knows the inputs.

    window: the number of slots by which a packet may be late; the inputs of that many slots are kept.
    """

    def __init__(self, receiver: Receiver, plant: Plant, window: int = 0) -> None:
        super().__init__(receiver.process, receiver.trials)
        self._receiver, self._plant, self._window = receiver, plant, window
        self._moved: dict[int, Floats] = {}

    def learn(self, k: int, u: Floats) -> None:
        """Store the inputs of slot k, (m, R), for every slot in order, each before the packet of the next slot."""
        self._moved[k] = self._plant.moved(u)
        self._moved.pop(k - self._window - 1, None)

    def prior(self, first: int = 0) -> Belief:
        """The wrapped receiver's prior."""
        return self._receiver.prior(first)

    def act(self, k: int, gamma: Flags) -> Codes:
        """The wrapped receiver's action."""
        return self._receiver.act(k, gamma)

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """The wrapped receiver's belief, plus B u_{k−1} where no packet was decoded."""
        after = self._receiver.step(k, belief, heard)
        if k == 0:
            return after
        moved = np.where(guessed(after.action), self._moved[k - 1], 0.0)
        return after._replace(x_hat=after.x_hat + moved)


@final
class Offset:
    """The difference between the estimates with and without knowledge of the inputs, from the same packets.

    Both are the same linear recursion: c ← A c + B u where no packet was decoded, A c at an innovation, 0 at a state.
    """

    def __init__(self, process: Process, plant: Plant, trials: int) -> None:
        self._A = process.A
        self._plant = plant
        self._c = np.zeros((process.n, trials))
        self._moved: Floats = self._c

    def next(self, action: Codes, u: Floats) -> Floats:
        """The difference in the next slots, (c, n, R), from the estimator's actions (c, R); u (c, m, R): their inputs."""
        differences, moved = np.empty((len(u), *self._c.shape)), self._plant.moved(u)
        predicts, resets = guessed(action), action == int(Action.STATE)
        for row, difference in enumerate(differences):
            c = product(self._A, self._c) + np.where(predicts[row], self._moved, 0.0)
            difference[:] = np.where(resets[row], 0.0, c)
            self._c, self._moved = difference, moved[row]
        return differences
