"""The effect of a slot on the estimate, the reported covariance, the actual covariance and the error.

| action | x̂ | reported P | actual P | error e = x − x̂ |
|---|---|---|---|---|
| lost, discarded | A x̂ | A P Aᵀ + Q | A P Aᵀ + Q | A e + w |
| state used | z | 0 | 0 | 0 |
| innovation decoded | A x̂ + w | A P Aᵀ | A P Aᵀ | A e |
| misled: innovation used as the state | z | 0 | f_k = 2 A Σ_{k−1} Aᵀ | A x_{k−1} − χ_k |

Before slot 0 there is the prior of x_0 itself, so slot 0 is not predicted: a lost packet leaves x̂ = 0, P = Σ0, e = x_0.

Source: Theorem IV.1, Lemma V.1; docs/mathematics/eavesdroppers.md, eavesdroppers.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Action, Belief, Beliefs, Codes, Flags, cleared, select

_STATE, _INNOVATION = int(Action.STATE), int(Action.INNOVATION)  # numpy compares with an int ten times as fast


def reported_covariance(process: Process, k: int, P: Floats, action: Codes) -> Floats:
    """P_k (n, n, R) as a receiver reports it, from P_{k−1} and the actions (R,)."""
    covariance: Floats = kernels.follow_covariance(process.A, process.Q, P, action[None], k == 0)[0]
    return covariance


def belief(process: Process, k: int, before: Belief, action: Codes, z: Floats, chi: Floats | None = None) -> Belief:
    """The belief after slot k, from the one before it, the actions (R,), the packets z and, for a decoder, χ_k, (n, R) each."""
    noise = None if chi is None else chi[None]
    x_hat, P = kernels.follow(process.A, process.Q, (before.x_hat, before.P), action[None], z[None], noise, k == 0)
    return Belief(x_hat[0], P[0], action)


def beliefs(
    process: Process, first: int, before: Belief, action: Codes, z: Floats, chi: Floats | None = None
) -> Beliefs:
    """The same for c consecutive slots from `first` on: action (c, R), z and χ (c, n, R)."""
    start = (before.x_hat, before.P)
    return Beliefs(*kernels.follow(process.A, process.Q, start, action, z, chi, first == 0), action)


def actual_covariance(process: Process, k: int, P: Floats, action: Codes, nu: Flags, f: Floats) -> Floats:
    """P_k (n, n, R) of the error, from P_{k−1}, given the events: the mean of e eᵀ over all states and noises.

    action (R,); nu (R,): the packet contains an innovation; f (n, n): f_k of `theory.misled_covariances`. Its mean over
    trials estimates `theory.theoretical_covariances`.
    """
    return select(
        (action == _STATE) & nu,
        lambda: np.repeat(f[:, :, None], P.shape[2], axis=2),
        lambda: reported_covariance(process, k, P, action),
    )


def error(process: Process, e: Floats, action: Codes, nu: Flags, w: Floats, misled: Callable[[], Floats]) -> Floats:
    """e_k (n, R) from e_{k−1}, the actions (R,), ν (R,), w_{k−1} (n, R), and A x_{k−1} − χ_k (n, R) for a misled receiver.

    Nothing cancels, so it is accurate even where x exceeds all precision. Before slot 0, e is 0; w is then x_0 less its estimate.
    """

    def predicted() -> Floats:
        carried = process.predict(e)
        return select(action == _INNOVATION, lambda: carried, lambda: carried + w)

    return select(
        (action == _STATE) & nu,
        misled,
        lambda: cleared(action == _STATE, e.shape, predicted),
    )
