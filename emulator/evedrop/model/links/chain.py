"""A Markov chain of link states, and what losses in bursts follow from it.

Source: docs/mathematics/links.md, losses in bursts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evedrop.model.links.counts import Counted, Spectrum
from evedrop.model.process import Floats

_MOST_STATES = 8  # of a chain whose packets are counted: the work grows with the cube


@dataclass(frozen=True)
class Chain:
    """A Markov chain of link states, which at slot 0 is in its stationary distribution."""

    transitions: Floats
    """Row: from, column: to, (states, states)."""
    stationary: Floats
    """The stationary distribution, (states,)."""
    quality: Floats
    """Probability that a packet is delivered in each state, (states,)."""

    @property
    def independent(self) -> bool:
        """Whether the fates of all packets are independent and identically distributed: a single state, as in the paper."""
        return len(self.stationary) == 1

    def count_spectrum(self, parts: Sequence[Counted]) -> Spectrum | None:
        """The transform over this chain, stationary at the first of these ascending parts; None with too many states."""
        states = len(self.stationary)
        if states > _MOST_STATES:
            return None
        powers: dict[int, list[Spectrum]] = {}  # w → the step of each power of two of packets
        row = np.repeat(self.stationary[None].astype(np.complex128), len(parts[0].w), axis=0)
        at = parts[0].slots.start
        for slots, w in parts:
            row = row @ np.linalg.matrix_power(self.transitions, slots.start - at)
            steps = powers.setdefault(id(w), [])
            for bit in range(len(slots).bit_length()):
                if bit == len(steps):
                    steps.append(
                        np.matmul(steps[-1], steps[-1])
                        if steps
                        else (1.0 + self.quality * (w[:, None] - 1.0))[:, :, None] * self.transitions
                    )
                if len(slots) >> bit & 1:
                    row = np.einsum("zs,zst->zt", row, steps[bit])
            at = slots.stop
        spectrum: Spectrum = row.sum(axis=1)
        return spectrum
