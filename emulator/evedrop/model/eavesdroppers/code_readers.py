"""Eavesdroppers that read what a code leaves readable.

The eavesdropper of references reads state-secrecy codes with the references that it heard itself. The eavesdropper of unencrypted
states reads what partial encryption leaves: a Kalman filter without measurement noise.
"""

from __future__ import annotations

import numpy as np

from evedrop.model.eavesdroppers.eavesdropper import Knowledge, PacketReader
from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats, product
from evedrop.model.receiver import Action, Belief, Flags, Reception
from evedrop.model.reference_code import (
    NEGLIGIBLE,
    ReferenceReceiver,
    initial_factor,
    squares,
    triangular_solutions,
)
from evedrop.model.schemes.partial_encryption import UNENCRYPTED_INNOVATION
from evedrop.model.staircase import ROUNDING_OF_PACKETS, is_singular
from evedrop.model.streams import Batch


class Reference(PacketReader):
    """Follows the headers as the legitimate estimator does; it needs no knowledge, because the code has no secret.

    Intended only for the schemes `acknowledged`, `open-loop`, `random-code` and `threshold-code`, against which it is optimal
    until it is told a state (`ReferenceReceiver.informed`).

    Source: docs/mathematics/schemes.md, acknowledged references.
    """

    only_against = (
        ("acknowledged", "open-loop", "random-code", "threshold-code"),
        "follows references, and there are none: it is the same as naive here",
    )

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._reader = ReferenceReceiver(knowledge.process, batch.trials)

    def prior(self, first: int = 0) -> Belief:
        """The prior, without references in memory."""
        return self._reader.prior(first)

    def knowing(self, k: int, x: Floats, belief: Belief) -> Belief:
        """It can read every packet with a reference to slot k; its previous reference stays valid, and it learns no older one."""
        return self._reader.informed(k, x, belief)

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Reads with the reference that the header names."""
        return self._reader.step(k, belief, heard)


class ClearStates(PacketReader):
    """Reads the unencrypted states, and innovations, as the header says; exact MMSE without the pads.

    `Belief.memory` is a factor X of P = X Xᵀ, (n, n, R). An unencrypted state is a measurement without noise; the rows of X are
    made triangular, the unencrypted ones first, so no difference of covariances is taken.

    Source: docs/mathematics/schemes.md, partial encryption.
    """

    only_against = (
        "partial-encryption",
        "reads a header that says which states are encrypted, and there is none: it is the same as naive here",
    )

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._singular = is_singular(knowledge.process)

    def prior(self, first: int = 0) -> Belief:
        """With a factor of the state's covariance."""
        X = initial_factor(self.process, max(0, first - 1))
        return super().prior(first)._replace(memory=(np.repeat(X[:, :, None], self.trials, axis=2),))

    def knowing(self, k: int, x: Floats, belief: Belief) -> Belief:
        """No error."""
        return super().knowing(k, x, belief)._replace(memory=(np.zeros_like(belief.P),))

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Predicted; with the innovation added; or conditioned on the unencrypted states. Without a header all of them are."""
        header = np.zeros(self.trials, np.int64) if heard.header is None else heard.header[0]
        innovation = heard.gamma & (header == UNENCRYPTED_INNOVATION)
        x_hat, X = self._predicted(k, belief, innovation)
        x_hat = np.where(innovation, x_hat + heard.z, x_hat)
        action = np.where(innovation, np.uint8(Action.INNOVATION), np.uint8(Action.LOST))
        state = heard.gamma & ~innovation
        for mask in np.unique(header[state]).tolist():
            some = np.flatnonzero(state & (header == mask))
            hidden = np.array([bool(mask >> i & 1) for i in range(self.process.n)])
            before, z = X[:, :, some], heard.z[:, some]
            if self._singular:
                before = _with_rounding(before, hidden, np.abs(x_hat[:, some]) + np.abs(z))
            x_hat[:, some], X[:, :, some] = _read(x_hat[:, some], before, hidden, z)
            read = Action.DISCARDED if hidden.all() else Action.INNOVATION if hidden.any() else Action.STATE
            action[some] = np.uint8(read)
        return Belief(x_hat, squares(X), action, (X,))

    def _predicted(self, k: int, belief: Belief, innovation: Flags) -> tuple[Floats, Floats]:
        """A x̂ (n, R), and a factor of A P Aᵀ + Q, or of A P Aᵀ where the innovation is known, (n, n, R)."""
        (X,) = belief.memory
        if not k:
            return belief.x_hat.copy(), X.copy()
        n, noise = self.process.n, self.process.noise_factor
        moved = product(self.process.A, X.reshape(n, -1)).reshape(X.shape)
        joint = np.concatenate([moved, np.where(innovation, 0.0, noise[:, :, None])], axis=1)
        joint = np.where(np.abs(joint) < NEGLIGIBLE * np.abs(noise).max(), 0.0, joint)
        factors = kernels.triangular_factors(joint.transpose(2, 0, 1).copy())
        return self.process.predict(belief.x_hat), factors.transpose(1, 2, 0).copy()


def _with_rounding(X: Floats, hidden: Flags, sizes: Floats) -> Floats:
    """A factor (n, 2n, R) that also has the rounding of the unencrypted states; X: (n, n, R), sizes: of the numbers, (n, R).

    Without it, an unencrypted state that is known already, or that follows from others, would have a pivot that is 0 or mere
    rounding, and its column would take what is not known of the encrypted states.
    """
    rounding = ROUNDING_OF_PACKETS * np.where(hidden[:, None], 0.0, sizes)
    return np.concatenate([X, rounding[:, None, :] * np.eye(len(hidden))[:, :, None]], axis=1)


def _read(x_hat: Floats, X: Floats, hidden: Flags, z: Floats) -> tuple[Floats, Floats]:
    """x̂ (n, R) and the factor (n, n, R) once the unencrypted states have been read from z (n, R); X: (n, m, R), m ≥ n."""
    order = np.argsort(hidden, kind="stable")
    clear = int((~hidden).sum())
    L = kernels.triangular_factors(X[order].transpose(2, 0, 1).copy())
    white = triangular_solutions(L[:, :clear, :clear], (z - x_hat)[order[:clear]])
    gain = (
        product(L[:, clear:, :clear].copy(), white.T[:, :, None].copy())[:, :, 0].T if 0 < clear < len(order) else 0.0
    )
    after, rest = np.empty_like(x_hat), np.zeros((len(order), *x_hat.shape))
    after[order[:clear]] = z[order[:clear]]
    after[order[clear:]] = x_hat[order[clear:]] + gain
    rest[order[clear:], : len(order) - clear] = L[:, clear:, clear:].transpose(1, 2, 0)
    return after, rest
