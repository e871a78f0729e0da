"""The legitimate estimator that knows the inputs: in a slot without a packet it predicts A x̂ + B u instead of A x̂.

A packet that is decoded already contains B u, so nothing else changes; P is the same.

Source: docs/mathematics.md, closed loop.
"""

from __future__ import annotations

from typing import final

import numpy as np

from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Process, product
from evedrop.model.receiver import Action, Belief, Codes, Flags, Receiver, Reception


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
        """The difference in the next slot, (n, R), from the estimator's action (R,); u (m, R): the inputs of this slot."""
        c = product(self._A, self._c) + np.where(guessed(action), self._moved, 0.0)
        self._c = np.where(action == int(Action.STATE), 0.0, c)
        self._moved = self._plant.moved(u)
        return self._c
