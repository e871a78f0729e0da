"""Sums over the slots of blocks, whose bits do not depend on how many slots are added at a time.

Source: docs/results.md, standard errors.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import final

import numpy as np

from evedrop.model.digest import Blocks
from evedrop.model.process import Floats

_FEW_TRIALS = 64  # up to this number, numpy adds a slot at a time more slowly than it accumulates all slots


def added_in_order(total: Floats, numbers: Floats) -> Floats:
    """A total of every trial, (R,), and the numbers of some slots, (c, R): their sum, (R,), one slot added after the other."""
    if numbers.shape[1] < _FEW_TRIALS:
        return np.asarray(np.add.accumulate(np.concatenate([total[None], numbers]), axis=0)[-1])
    total = total.copy()
    for row in numbers:
        total += row
    return total


@final
class BlockSums:
    """The sum of a number of every trial over each block of slots, the blocks of a receiver's digests.

    A process that begins with a block, after an outage, continues where another one ended. cuts: as in `block_starts`.
    """

    def __init__(self, trials: int, slots: int, cuts: Iterable[int] = ()) -> None:
        self._blocks = Blocks(slots, cuts)
        self.unfinished: Floats = np.zeros(trials)
        """The sum over the slots so far of the block that has not ended, (R,)."""

    def add(self, slots: range, numbers: Floats) -> dict[int, Floats]:
        """Add consecutive slots, (c, R); returns the sums (R,) of the blocks that end with one of them, by first slot."""
        found: dict[int, Floats] = {}
        k = slots.start
        while k < slots.stop:
            stop = min(slots.stop, self._blocks.end(k))
            rows = numbers[k - slots.start : stop - slots.start]
            self.unfinished = added_in_order(self.unfinished, rows)
            if stop == self._blocks.end(k):
                found[self._blocks.start(k)] = self.unfinished
                self.unfinished = np.zeros_like(self.unfinished)
            k = stop
        return found
