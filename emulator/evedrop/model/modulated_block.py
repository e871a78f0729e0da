"""A block of equal slots behind a chain, computed at once: the recursion of `modulated` as one linear operator.

With v = (E(1), …, E(S), Σ, 1) the recursion is v ← M v, so the trace of slot j of a block is t M^j v: only the rows t M^j
and the last power of the block's operator are kept. Where packets may be W slots late, v is that of slot k − W, up to which
everything is settled, and t ends with the operators of the W slots since, t = t₀ M_0 ⋯ M_{W−1}.

Source: docs/mathematics.md, losses in bursts and late packets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from evedrop.model.links.link import Chain
from evedrop.model.process import Floats, Process

BLOCK = 128
"""Slots in a block, a power of 2."""
PARTS = ("kept", "predicted", "misled", "leaked", "initial")
"""The outcomes of a slot that the recursion needs."""


@final
@dataclass(frozen=True)
class LinearBlock:
    """The operator of a block of slots."""

    traces: Floats
    """t M^j for j = 1 … BLOCK, (BLOCK, D)."""
    last: Floats
    """M^BLOCK, (D, D)."""
    misleads: bool
    """Whether v contains Σ: only where an error may grow with it, because Σ may exceed double precision."""

    @classmethod
    def of(cls, process: Process, chain: Chain, odds: Sequence[Mapping[str, Floats]]) -> LinearBlock:
        """The block of a chain; leaks are not supported.

        odds: lag → the probabilities of the outcomes in the chain's states, (S,) each, of a slot this number of slots ago;
        the last lag is that of settled slots.
        """
        misleads = any(bool(np.any(one["misled"] > 0.0)) for one in odds)
        *since, M = (_operator(process, chain, one, misleads) for one in odds)
        states = len(chain.stationary) * process.n**2
        row = np.zeros(len(M))
        row[:states] = np.tile(np.eye(process.n).reshape(-1), len(chain.stationary))
        for one in since:
            row = row @ one
        rows = np.empty((BLOCK, len(M)))
        for j in range(BLOCK):
            rows[j] = row = row @ M
        return cls(rows, np.linalg.matrix_power(M, BLOCK), misleads)

    def ahead(self, states: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Traces of the slots of a block, (BLOCK,), and E after it, (S, n, n), from E and Σ of the slot before it."""
        parts = [states.reshape(-1), *([sigma.reshape(-1)] if self.misleads else []), np.ones(1)]
        v = np.concatenate(parts)
        after = self.last[: states.size] @ v
        return self.traces @ v, after.reshape(states.shape)


def _operator(process: Process, chain: Chain, odds: Mapping[str, Floats], misleads: bool) -> Floats:
    """M of a slot, (D, D)."""
    size, states = process.n**2, len(chain.stationary)
    carried = np.kron(process.A, process.A)
    count = states * size + (size if misleads else 0) + 1
    M = np.zeros((count, count))
    M[: states * size, : states * size] = np.kron(odds["kept"][:, None] * chain.transitions.T, carried)
    M[: states * size, -1] = np.kron(chain.stationary * odds["predicted"], process.Q.reshape(-1))
    if misleads:
        sigma = slice(states * size, -1)
        M[: states * size, sigma] = np.kron((chain.stationary * odds["misled"])[:, None], 2.0 * carried)
        M[sigma, sigma] = carried
        M[sigma, -1] = process.Q.reshape(-1)
    M[-1, -1] = 1.0
    return M
