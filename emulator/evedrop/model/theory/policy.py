"""When to send, if the sensor knew the holding times of both receivers: the optimal policy, by value iteration.

Source: Leong, Quevedo, Dolz, Dey (2019); docs/mathematics.md, the best policy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats, Process

_TOLERANCE = 1e-11
_LAZY = 0.5  # how much of the old values an iteration keeps: it then converges for periodic chains, too
_WEIGHT = 1e-4
_AS_GOOD = 1e-9  # relative difference below which silence is as good as a packet


@dataclass(frozen=True)
class Policy:
    """The optimal decision by the holding times 1, 2 … S of user (row) and eavesdropper (column); S stands for longer ones."""

    send: NDArray[np.bool_]
    """(S, S)."""
    gain: float
    """Its average cost per slot."""
    value: Floats
    """The cost of starting from these holding times, less that of starting from S and S, (S, S)."""

    @property
    def thresholds(self) -> tuple[int, ...]:
        """For each holding time of the eavesdropper: the least one of the user at which to send; S + 1 if there is none."""
        return tuple(int(silent) + 1 for silent in (~self.send).sum(axis=0))

    @property
    def ever_sends(self) -> bool:
        """Whether it sends at the beginning, when neither receiver has heard a packet: otherwise it never will."""
        return bool(self.send[-1, -1])


def held_traces(process: Process, states: int) -> Floats:
    """Trace of W_i = Σ_{l<i} A^l Q A^lᵀ for i = 0 … states, (states + 1,): the error i slots after a state.

    Source: docs/mathematics.md, the best policy.
    """
    traces = np.zeros(states + 1)
    W = np.zeros_like(process.Q)
    for i in range(1, states + 1):
        W = process.A @ W @ process.A.T + process.Q
        traces[i] = np.trace(W)
    return traces


def best_policy(process: Process, mu: float, mu_e: float, weight: float, states: int, price: float = 0.0) -> Policy:
    """Minimise the average of weight · tr P − (1 − weight) · tr Pᵉ + price · [sent] over all rules by two holding times.

    Holding times longer than `states` slots count as `states`, which keeps the cost of an unstable process finite. By
    relative value iteration. For each holding time of the eavesdropper the policy is a threshold on the user's. μ must be
    above 0. Where silence is as good as a packet it is silent.

    Source: docs/mathematics.md, the best policy.
    """
    traces = held_traces(process, states - 1)  # indices are holding times at the end of a slot: 0 … states−1
    cost = weight * traces[:, None] - (1.0 - weight) * traces[None, :]
    later = np.minimum(np.arange(states) + 1, states - 1)
    scale = max(1e-300, float(np.abs(cost).max()), price)
    value = np.zeros((states, states))
    while True:
        total = cost + value
        silent = total[np.ix_(later, later)]
        heard = mu_e * total[:, :1] + (1.0 - mu_e) * total[:, later]
        sent = price + mu * heard[:1] + (1.0 - mu) * heard[later]
        change = np.minimum(silent, sent) - value
        if np.ptp(change) <= _TOLERANCE * scale:
            return Policy(sent < silent - _AS_GOOD * scale * (1.0 - mu), float(change.mean()), value)
        value = value + _LAZY * change
        value -= value[-1, -1]


def least_weight(process: Process, mu: float, mu_e: float, price: float, states: int) -> float | None:
    """The weight, to 1e-4, from which on the best policy sends at all; None if it does not even at 1.

    Source: docs/mathematics.md, the best policy.
    """

    def sends(weight: float) -> bool:
        return best_policy(process, mu, mu_e, weight, states, price).ever_sends

    if not sends(1.0):
        return None
    low, high = 0.0, 1.0
    while high - low > _WEIGHT:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if sends(middle) else (middle, high)
    return high
