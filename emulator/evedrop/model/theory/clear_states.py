"""The error of a receiver that reads some states of every state packet, and all innovations, over a perfect link.

Source: docs/mathematics.md, partial encryption.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np

from evedrop.model.kernels.current import kernels
from evedrop.model.kernels.elementary import cholesky
from evedrop.model.process import MARGINAL, Floats, Process
from evedrop.model.receiver import Flags
from evedrop.model.theory.closed_form import ClosedForm
from evedrop.model.theory.directions import Growth, unstable_part

_LARGEST = 1e150  # whose square is a double
_LONGEST = 2_000  # slots in which a bounded error settles, or its limit is unknown
_SETTLED = 1e-12  # relative change in a slot
_RANK = 1e-9  # relative: a smaller singular value is taken for 0


@final
@dataclass(frozen=True)
class ClearStatesForm(ClosedForm):
    """The expected error covariance of a receiver that reads the unencrypted states, slot by slot, without a closed formula.

    Behind a perfect link, with packets that are all states (μ_d = 1) or, after slot 0, all innovations (μ_d = 0), it is the same
    in every trial. Otherwise it is that of a receiver that hears more than any: all packets, and with 0 < μ_d < 1 both types in
    every slot.
    """

    process: Process
    hidden: Flags
    """Whether each state is encrypted, (n,)."""
    mu_d: float
    received: float | None
    """The probability that a packet is received; None if it differs from slot to slot or is unknown."""
    slots: int

    bound: bool = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "bound", self.received != 1.0 or 0.0 < self.mu_d < 1.0)

    @property
    def infinite_variance(self) -> bool:
        """False: the error that theory knows is the same in every trial."""
        return False

    @cached_property
    def traces(self) -> Floats:
        """The traces of all slots, (slots,); inf from where they overflow."""
        return self._followed(self.slots)

    @cached_property
    def limit(self) -> float:
        """Trace of the limit; inf if it is unbounded, NaN if it is not reached in many slots."""
        if self.growing.shape[1]:
            return math.inf
        last, before = self._followed(_LONGEST)[[-1, -2]]
        return float(last) if abs(last - before) <= _SETTLED * last else math.nan

    @cached_property
    def growing(self) -> Floats:
        """An orthonormal basis of the directions in which the error grows without bound, (n, m)."""
        A, n, clear = self.process.A, self.process.n, np.eye(self.process.n)[~self.hidden]
        if self.mu_d == 0.0:
            # After slot 0, e_k = A^k e_0, and e_0 is in the encrypted states.
            return unstable_part(A, _invariant_hull(A, np.eye(n)[:, self.hidden]), 1.0 + MARGINAL)
        unseen = _orthogonal_to(_invariant_hull(A.T, clear.T))
        return unstable_part(A, unseen, 1.0 - MARGINAL if self.mu_d == 1.0 else 1.0 + MARGINAL)

    @property
    def growth(self) -> Growth:
        """Where the error grows: exactly in `growing`, or perhaps also elsewhere, but only where the state itself grows."""
        if self.mu_d == 1.0 and not self.bound:
            return Growth(self.growing, self.growing)
        return Growth(self.growing, unstable_part(self.process.A, np.eye(self.process.n), 1.0 - MARGINAL))

    def _followed(self, slots: int) -> Floats:
        found = np.full(slots, np.inf)
        A, noise = self.process.A, self.process.noise_factor
        X = self._read(cholesky(self.process.initial_covariance))
        for k in range(slots):
            found[k] = float((X * X).sum())
            moved = A @ X
            if not np.abs(moved).max() < _LARGEST:
                break
            if self.mu_d == 1.0:
                moved = np.concatenate([moved, noise], axis=1)
            after = self._read(moved) if self.mu_d > 0.0 else moved
            if np.array_equal(after, X):
                found[k:] = found[k]
                break
            X = after
        return found

    def _read(self, X: Floats) -> Floats:
        """A factor of the covariance once the unencrypted states have been read, (n, n), from one of it before, (n, m)."""
        order = np.argsort(self.hidden, kind="stable")
        clear = int((~self.hidden).sum())
        L = kernels.triangular_factors(X[order][None].copy())[0]
        L[:clear] = 0.0
        L[:, :clear] = 0.0
        found: Floats = np.empty_like(L)
        found[order] = L
        return found


def _invariant_hull(A: Floats, columns: Floats) -> Floats:
    """An orthonormal basis, (n, s), of the smallest invariant subspace of A that contains these columns."""
    scale = max(1.0, float(np.abs(A).max()))
    basis = _range(columns)
    while 0 < basis.shape[1] < len(A):
        grown = _range(np.hstack([basis, (A / scale) @ basis]))
        if grown.shape[1] == basis.shape[1]:
            break
        basis = grown
    return basis


def _orthogonal_to(basis: Floats) -> Floats:
    """An orthonormal basis of the orthogonal complement, (n, n − s), of one with s columns."""
    u, _, _ = np.linalg.svd(basis, full_matrices=True) if basis.shape[1] else (np.eye(len(basis)), None, None)
    return np.asarray(u[:, basis.shape[1] :])


def _range(columns: Floats) -> Floats:
    if not columns.shape[1]:
        return columns
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(u[:, s > _RANK * s[0]])
