"""The directions in which a receiver's expected error grows without bound: those that touch an unstable part it does not see.

Source: docs/mathematics.md, verdicts by direction.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from evedrop.model.process import MARGINAL, Floats, Process
from evedrop.model.theory.covariances import Outcomes

_TOUCHES = 1e-9  # relative: less is rounding


class Growth(NamedTuple):
    """Where an expected error grows without bound."""

    basis: Floats
    """An orthonormal basis of the directions in which it certainly grows, (n, m)."""
    within: Floats
    """The same of those outside which it certainly does not, (n, s)."""

    def along(self, v: Floats) -> bool | None:
        """Whether the error of vᵀx grows without bound, v (n,); None if theory does not know."""
        if _touches(self.basis, v):
            return True
        return None if _touches(self.within, v) else False


def unstable_part(A: Floats, within: Floats, least: float) -> Floats:
    """An orthonormal basis, (n, m), of the eigenspaces with |λ| ≥ least of A in an invariant subspace with this basis, (n, s)."""
    from scipy.linalg import schur  # noqa: PLC0415 - slow to import

    if not within.shape[1]:
        return within
    _, Z, count = schur(within.T @ A @ within, sort=lambda real, imaginary: math.hypot(real, imaginary) >= least)
    found: Floats = within @ Z[:, :count]
    return found


def growth(process: Process, outcomes: Outcomes) -> Growth:
    """Where the expected error of a receiver with these outcomes in every slot grows.

    Source: docs/mathematics.md, verdicts by direction.
    """
    basis = unstable_part(process.A, np.eye(process.n), _least(outcomes))
    return Growth(basis, basis)


def _least(outcomes: Outcomes) -> float:
    """The least modulus of an eigenvalue of A in whose eigenspace the error grows."""
    if outcomes.misled:
        return 1.0 - MARGINAL
    noise = outcomes.predicted + outcomes.leaked
    if outcomes.kept == 0.0 or noise + outcomes.initial == 0.0:
        return math.inf
    return 1.0 / math.sqrt(outcomes.kept) + (-MARGINAL if noise else MARGINAL)


def _touches(basis: Floats, v: Floats) -> bool:
    return bool(np.linalg.norm(basis.T @ v) > _TOUCHES * np.linalg.norm(v))
