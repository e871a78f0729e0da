"""Converts flags of trials to bit masks and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evedrop.model.receiver import Flags


def packed_flags(flags: Flags) -> NDArray[np.uint8]:
    """Flags (…, R) as bit masks (…, ⌈R/8⌉), trial 0 in the lowest bit of the first byte."""
    return np.packbits(flags, axis=-1, bitorder="little")


def flags_of(masks: NDArray[np.uint8], trials: int) -> Flags:
    """The flags (…, R) of bit masks (…, ⌈R/8⌉)."""
    return np.unpackbits(masks, axis=-1, count=trials, bitorder="little").view(np.bool_)
