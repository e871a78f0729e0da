"""The distributions of a closed loop whose sensor filters: as it is meant to run, and while its measurements are replaced.

Here every packet arrives, and the controller decides u = −L x̂ in every slot. The watermark e adds to u.

Source: docs/mathematics/attacks.md, integrity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from evedrop.model.kernels.elementary import has_settled
from evedrop.model.process import Floats, product

_DOUBLINGS = 60
_SETTLED = 1e-13


@dataclass(frozen=True)
class Source:
    """What a sensor is made to report: z = H ζ, with ζ⁺ = F ζ + n."""

    F: Floats
    """(s, s)."""
    noise: Floats
    """Covariance of n, (s, s)."""
    H: Floats
    """(p, s)."""


@final
@dataclass(frozen=True)
class WatermarkedLoop:
    """A closed loop in its steady state; n states, m inputs, p measurements."""

    A: Floats
    """(n, n)."""
    B: Floats
    """(n, m)."""
    C: Floats
    """(p, n)."""
    K: Floats
    """The filter's gain, (n, p)."""
    innovation: Floats
    """Σ_g, the covariance of the innovation g = y − C x̂⁻, (p, p)."""
    L: Floats
    """The controller's gain, (m, n)."""
    weight: Floats
    """BᵀΠB + U, (m, m): what one more input of covariance Σ_e costs in each slot is tr[(BᵀΠB + U) Σ_e]."""

    @property
    def closed(self) -> Floats:
        """A − B L, (n, n)."""
        return self.A - product(self.B, self.L)

    def nominal(self, watermark: Floats) -> Source:
        """The measurements y of the loop with a watermark of covariance Σ_e, (m, m), when nobody attacks: ζ = (x̂, y)."""
        n, p = self.K.shape
        F = np.zeros((n + p, n + p))
        F[:n, :n], F[n:, :n] = self.closed, product(self.C, self.closed)
        by_input = np.vstack([self.B, product(self.C, self.B)])
        by_innovation = np.vstack([self.K, np.eye(p)])
        noise = spread(by_input, watermark) + spread(by_innovation, self.innovation)
        return Source(F, noise, np.hstack([np.zeros((p, n)), np.eye(p)]))

    def measurement(self, watermark: Floats) -> Floats:
        """The stationary covariance of y when nobody attacks, (p, p). Raises ValueError if there is none."""
        source = self.nominal(watermark)
        return spread(source.H, stationary(source.F, source.noise))

    def deceived(self, source: Source, watermark: Floats) -> Floats:
        """S = Σ̃ − CB Σ_e BᵀCᵀ, (p, p): the covariance of g + C B e₋ while z replaces y, with Σ̃ the covariance of g.

        Raises ValueError if the filter has no stationary distribution while it is fed with z: g then grows without bound.
        """
        s, n = len(source.F), len(self.A)
        kept = np.eye(n) - product(self.K, self.C)
        fed = product(self.K, source.H)
        joint = np.zeros((s + n, s + n))
        joint[:s, :s], joint[s:, :s] = source.F, product(fed, source.F)
        joint[s:, s:] = product(kept, self.closed)
        by_source = np.vstack([np.eye(s), fed])
        by_input = np.vstack([np.zeros((s, self.B.shape[1])), product(kept, self.B)])
        X = stationary(joint, spread(by_source, source.noise) + spread(by_input, watermark))
        seen = np.hstack([product(source.H, source.F), -product(self.C, self.closed)])
        return spread(seen, X) + spread(source.H, source.noise)


def spread(M: Floats, covariance: Floats) -> Floats:
    """M Σ Mᵀ, symmetric."""
    result = product(product(M, covariance), M.T)
    return 0.5 * (result + result.T)


@np.errstate(over="ignore", invalid="ignore")
def stationary(F: Floats, noise: Floats) -> Floats:
    """The solution X of X = F X Fᵀ + N, by doubling. Raises ValueError if F lets X grow without bound."""
    X = noise
    for _ in range(_DOUBLINGS):
        more = spread(F, X)
        X, F = X + more, product(F, F)
        if not np.isfinite(X).all():
            break
        if has_settled(more, np.diag(X), _SETTLED):
            return X
    raise ValueError("there is no stationary distribution")
