"""A block of equal slots behind a chain, computed at once: the recursion of `modulated` as one linear operator.

With v = (E(1), …, E(S), Σ, 1) the recursion is v ← M v, so the trace of slot j of a block is t M^j v: only the rows t M^j
and the last power of the block's operator are kept.

Source: docs/mathematics.md, losses in bursts.
"""

from __future__ import annotations

from collections.abc import Mapping
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
    def of(cls, process: Process, chain: Chain, odds: Mapping[str, Floats]) -> LinearBlock:
        """The block of a chain with the probabilities of the outcomes in its states, (S,) each; leaks are not supported."""
        n, states = process.n, len(chain.law)
        size = n * n
        misleads = bool(np.any(odds["misled"] > 0.0))
        carried = np.kron(process.A, process.A)
        count = states * size + (size if misleads else 0) + 1
        M = np.zeros((count, count))
        M[: states * size, : states * size] = np.kron(odds["kept"][:, None] * chain.transitions.T, carried)
        M[: states * size, -1] = np.kron(chain.law * odds["predicted"], process.Q.reshape(-1))
        if misleads:
            sigma = slice(states * size, -1)
            M[: states * size, sigma] = np.kron((chain.law * odds["misled"])[:, None], 2.0 * carried)
            M[sigma, sigma] = carried
            M[sigma, -1] = process.Q.reshape(-1)
        M[-1, -1] = 1.0
        rows = np.empty((BLOCK, count))
        row = np.zeros(count)
        row[: states * size] = np.tile(np.eye(n).reshape(-1), states)
        for j in range(BLOCK):
            rows[j] = row = row @ M
        return cls(rows, np.linalg.matrix_power(M, BLOCK), misleads)

    def ahead(self, states: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Traces of the slots of a block, (BLOCK,), and E after it, (S, n, n), from E and Σ of the slot before it."""
        parts = [states.reshape(-1), *([sigma.reshape(-1)] if self.misleads else []), np.ones(1)]
        v = np.concatenate(parts)
        after = self.last[: states.size] @ v
        return self.traces @ v, after.reshape(states.shape)
