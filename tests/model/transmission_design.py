"""When to send, if the sensor knew the holding times of both receivers: the optimal policy, by value iteration.

Source: Leong, Quevedo, Dolz, Dey (2019); docs/mathematics.md, schedules by holding time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats, Process

_TOLERANCE = 1e-10


@dataclass(frozen=True)
class Policy:
    """The optimal decision by the holding times of user (row) and eavesdropper (column), which are cut off at the end."""

    send: NDArray[np.bool_]
    """(states, states)."""
    value: Floats
    """Discounted cost to go, (states, states)."""

    def threshold(self, eavesdropper: int) -> int:
        """The least holding time of the user at which to send, for one of the eavesdropper; `states` if there is none."""
        column = self.send[:, eavesdropper]
        return int(np.argmax(column)) if column.any() else len(column)


def best_policy(process: Process, mu: float, mu_e: float, weight: float, states: int, discount: float = 0.95) -> Policy:
    """Minimise Σ discount^k (weight tr P_k − (1−weight) tr Pᵉ_k) over whether to send, with holding times below `states`.

    A holding time i has P = Σ_{j<i} A^j Q A^jᵀ; the last one stands for all longer ones, which keeps the costs of an unstable
    process finite. For each holding time of the eavesdropper the optimal policy is a threshold on the user's.

    Source: docs/mathematics.md, schedules by holding time.
    """
    traces = np.zeros(states)
    W = np.zeros_like(process.Q)
    for i in range(1, states):
        W = process.A @ W @ process.A.T + process.Q
        traces[i] = np.trace(W)
    cost = weight * traces[:, None] - (1.0 - weight) * traces[None, :]
    later = np.minimum(np.arange(states) + 1, states - 1)
    value = np.zeros((states, states))
    scale = max(1.0, float(np.abs(cost).max()))
    while True:
        total = cost + discount * value
        silent = total[np.ix_(later, later)]
        heard = mu_e * total[:, :1] + (1.0 - mu_e) * total[:, later]
        sent = mu * heard[:1] + (1.0 - mu) * heard[later]
        best = np.minimum(silent, sent)
        change = float(np.abs(best - value).max())
        value = best
        if change <= _TOLERANCE * scale:
            return Policy(sent < silent, value)
