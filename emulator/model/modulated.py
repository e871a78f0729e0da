"""Expected covariances behind a link whose quality follows a Markov chain: losses in bursts and their like.

For each link state s, E_k(s) = E[P_k; state s in slot k], and with q(s) its quality and T the transitions

    E_k(s) = kept(q(s)) A (Σ_r T(r, s) E_{k−1}(r)) Aᵀ + π(s) (p_d(q(s)) Q + p_i(q(s)) f_k + p_l(q(s)) M_k),

because the state of slot k alone decides what becomes of its packet. The sum over s is E P_k.

Source: docs/mathematics.md, losses in bursts.
"""

from __future__ import annotations

import numpy as np

from emulator.model.leak import RemainingCovariances, remaining_limit
from emulator.model.links.link import Chain
from emulator.model.process import Floats, Process
from emulator.model.theory import NOBODY, ExpectedCovariance, Outcomes, OutcomesAt, lyapunov, radius


class ModulatedCovariance:
    """E P_k of a receiver behind such a link, the next slots at a time from k = 0. Final; as `ExpectedCovariance`."""

    def __init__(self, process: Process, chain: Chain, outcomes_at: OutcomesAt) -> None:
        outcomes = [outcomes_at(float(quality)) for quality in chain.quality]
        self._process = process
        self._chain = chain
        self._kept = np.array([one.kept for one in outcomes])[:, None, None]
        self._diffused = (
            np.array([one.predicted for one in outcomes])[:, None, None] * chain.law[:, None, None] * process.Q
        )
        self._misled = 2.0 * np.array([one.misled for one in outcomes])[:, None, None] * chain.law[:, None, None]
        self._leaked = np.array([one.leaked for one in outcomes])[:, None, None] * chain.law[:, None, None]
        self._remaining = RemainingCovariances(process) if self._leaked.any() else None
        start = np.array([one.initial for one in outcomes])[:, None, None] * chain.law[:, None, None]
        self._states: Floats = start * process.initial_covariance
        self._sigma = ExpectedCovariance(process, NOBODY)
        self._before: Floats | None = None

    def next_traces(self, slots: int) -> Floats:
        """The trace of the expectation in the next slots, (slots,); inf once it overflows."""
        A, T = self._process.A, self._chain.transitions
        traces = np.empty(slots)
        sigma = self._sigma.next(slots)
        with np.errstate(over="ignore", invalid="ignore"):
            for row in range(slots):
                if self._before is not None:
                    mixed = np.tensordot(T.T, self._states, axes=1)
                    # Without the mask 0 · inf would undo a bounded expectation once Σ_k leaves double precision.
                    grown = A @ self._before @ A.T
                    misled = np.where(self._misled > 0.0, self._misled * grown, 0.0)
                    self._states = self._kept * (A @ mixed @ A.T) + self._diffused + misled
                    if self._remaining is not None:
                        self._states = self._states + self._leaked * self._remaining.next()
                self._before = sigma[row]
                total = float(np.trace(self._states.sum(axis=0)))
                traces[row] = total if np.isfinite(total) else np.inf
        return traces


def limit_trace(process: Process, chain: Chain, outcomes_at: OutcomesAt) -> float:
    """Trace of lim E P_k; inf if it has none: the operator on (E(s)) does not contract, or misled errors grow."""
    outcomes = [outcomes_at(float(quality)) for quality in chain.quality]
    misled = any(one.misled > 0.0 for one in outcomes)
    if misled and radius(process) >= 1.0:
        return float("inf")
    if not misled and all(one.predicted + one.leaked + one.initial == 0.0 for one in outcomes):
        return 0.0
    n, states = process.n, len(chain.law)
    kept = np.repeat([one.kept for one in outcomes], n * n)
    operator = kept[:, None] * np.kron(chain.transitions.T, np.kron(process.A, process.A))
    if np.max(np.abs(np.linalg.eigvals(operator))) >= 1.0 - 1e-12:
        return float("inf")
    f = 2.0 * (process.A @ lyapunov(process, 1.0) @ process.A.T) if misled else np.zeros_like(process.Q)
    M = remaining_limit(process) if any(one.leaked for one in outcomes) else np.zeros_like(process.Q)
    source = np.concatenate(
        [
            law * (one.predicted * process.Q + one.misled * f + one.leaked * M).reshape(-1)
            for law, one in zip(chain.law, outcomes, strict=True)
        ]
    )
    solution = np.linalg.solve(np.eye(len(operator)) - operator, source).reshape(states, n, n)
    return float(np.trace(solution.sum(axis=0)))


def tail_outcomes(chain: Chain, outcomes_at: OutcomesAt) -> Outcomes:
    """A slot of an independent link whose errors last as long: `kept` is the rate at which the chain keeps an error.

    Source: docs/mathematics.md, losses in bursts.
    """
    outcomes = [outcomes_at(float(quality)) for quality in chain.quality]
    if all(one.predicted + one.leaked == 0.0 for one in outcomes):
        return outcomes[0]
    keeps = np.array([one.kept for one in outcomes])[:, None] * chain.transitions.T
    rate = min(1.0, float(np.max(np.abs(np.linalg.eigvals(keeps)))))
    misled = max(one.misled for one in outcomes)
    return Outcomes(predicted=rate, state=max(0.0, 1.0 - rate - misled), misled=misled, decoded=0.0, initial=1.0)
