"""The distribution of the number D of packets that get through, as its transform E[z^D] at several complex z, |z| = 1.

A packet that is not lost counts with a factor w, which is z, or 1 − c + cz if it then gets through with probability c only.

Source: docs/mathematics/links.md, losses in bursts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Spectrum = NDArray[np.complex128]
"""A transform, (number of z,)."""


class Counted(NamedTuple):
    """Consecutive packets that count."""

    slots: range
    w: Spectrum
    """The factor of each of them that is not lost."""


class Thinned(NamedTuple):
    """Consecutive packets that count, for the variance of their number."""

    slots: range
    passes: float = 1.0
    """Probability that one of them that is not lost gets through."""
