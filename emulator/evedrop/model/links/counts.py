"""The distribution of the number D of packets that get through, as its transform E[z^D] at several complex z, |z| = 1.

A packet that is not lost counts with a factor w, which is z, or 1 − c + cz if it then gets through with probability c only.

Source: docs/mathematics/links.md, losses in bursts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from evedrop.model.links.loss_model import Chain

Spectrum = NDArray[np.complex128]
"""A transform, (number of z,)."""
_MOST_STATES = 8  # of a chain: the work grows with the cube


class Counted(NamedTuple):
    """Consecutive packets that count."""

    slots: range
    w: Spectrum
    """The factor of each of them that is not lost."""


def chain_spectrum(chain: Chain, parts: Sequence[Counted]) -> Spectrum | None:
    """Of a chain in its stationary distribution at the first of these parts, which ascend; None if it has too many states."""
    states = len(chain.stationary)
    if states > _MOST_STATES:
        return None
    powers: dict[int, list[Spectrum]] = {}  # w → the step of each power of two of packets
    row = np.repeat(chain.stationary[None].astype(np.complex128), len(parts[0].w), axis=0)
    at = parts[0].slots.start
    for slots, w in parts:
        row = row @ np.linalg.matrix_power(chain.transitions, slots.start - at)
        steps = powers.setdefault(id(w), [])
        for bit in range(len(slots).bit_length()):
            if bit == len(steps):
                steps.append(
                    np.matmul(steps[-1], steps[-1])
                    if steps
                    else (1.0 + chain.quality * (w[:, None] - 1.0))[:, :, None] * chain.transitions
                )
            if len(slots) >> bit & 1:
                row = np.einsum("zs,zst->zt", row, steps[bit])
        at = slots.stop
    spectrum: Spectrum = row.sum(axis=1)
    return spectrum
