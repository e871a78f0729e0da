"""The effect of a slot on the estimate, the believed covariance, the actual covariance and the error.

| action | x̂ | believed P | actual P | error e = x − x̂ |
|---|---|---|---|---|
| lost, discarded | A x̂ | A P Aᵀ + Q | A P Aᵀ + Q | A e + w |
| state used | z | 0 | 0 | 0 |
| innovation decoded | A x̂ + w | A P Aᵀ | A P Aᵀ | A e |
| misled: innovation used as the state | z | 0 | f_k = 2 A Σ_{k−1} Aᵀ | A x_{k−1} − χ_k |

Before slot 0 there is the prior of x_0 itself, so slot 0 is not predicted: a lost packet leaves x̂ = 0, P = Σ0, e = x_0.

Source: Theorem IV.1, Lemma V.1; docs/mathematics.md, eavesdroppers.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Action, Codes, Flags, cleared, select

_STATE, _INNOVATION = int(Action.STATE), int(Action.INNOVATION)  # numpy compares with an int ten times as fast


def estimate(
    process: Process, k: int, x_hat: Floats, action: Codes, z: Floats, w: Callable[[], Floats] | None = None
) -> Floats:
    """x̂_k (n, R) from x̂_{k−1}, the actions (R,), the packets z (n, R) and, for a decoder, w_{k−1} = z − χ (n, R)."""

    def kept() -> Floats:
        predicted = process.predict(x_hat) if k else x_hat
        if w is None:
            return predicted
        return select(action == _INNOVATION, lambda: predicted + w(), lambda: predicted)

    return select(action == _STATE, lambda: z, kept)


def believed_covariance(process: Process, k: int, P: Floats, action: Codes) -> Floats:
    """P_k (n, n, R) as a receiver believes it, from P_{k−1} and the actions (R,)."""

    def kept() -> Floats:
        if k == 0:
            return P
        carried = process.carry(P)
        return select(action == _INNOVATION, lambda: carried, lambda: process.diffuse(carried))

    return cleared(action == _STATE, P.shape, kept)


def actual_covariance(process: Process, k: int, P: Floats, action: Codes, nu: Flags, f: Floats) -> Floats:
    """P_k (n, n, R) of the error, from P_{k−1}, given the events: the mean of e eᵀ over all states and noises.

    action (R,); nu (R,): the packet contains an innovation; f (n, n): f_k of `theory.misled_covariances`. Its mean over
    trials estimates `theory.expected_covariances`.
    """
    return select(
        (action == _STATE) & nu,
        lambda: np.repeat(f[:, :, None], P.shape[2], axis=2),
        lambda: believed_covariance(process, k, P, action),
    )


def error(process: Process, e: Floats, action: Codes, nu: Flags, w: Floats, misled: Callable[[], Floats]) -> Floats:
    """e_k (n, R) from e_{k−1}, the actions (R,), ν (R,), w_{k−1} (n, R), and A x_{k−1} − χ_k (n, R) for a misled receiver.

    Nothing cancels, so it is accurate even where x exceeds all precision. Before slot 0, e is 0, and w is then x_0.
    """

    def kept() -> Floats:
        carried = process.predict(e)
        return select(action == _INNOVATION, lambda: carried, lambda: carried + w)

    return select(
        (action == _STATE) & nu,
        misled,
        lambda: cleared(action == _STATE, e.shape, kept),
    )
