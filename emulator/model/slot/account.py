"""The account of a link: the outcomes of its packets, slot by slot, and the distributions of its losses and delays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.links.link import Fate, losses
from evedrop.model.receiver import Flags
from evedrop.model.slot.link import Fates

COUNTED_BURSTS = 64
"""Bursts of at least this many packets are counted together."""


@dataclass(frozen=True)
class Account:
    """The outcomes of the packets of c slots on one link."""

    delivered: Flags
    """Whether the packet was delivered in its own slot, (c, R)."""
    lost: Mapping[str, NDArray[np.uint32]]
    """Reason → packets of each slot lost for it, (c,)."""
    late: NDArray[np.uint16] | None
    """Packets of earlier slots delivered in each slot, without second copies, (c, R); None where there can be none."""
    bursts: NDArray[np.uint32]
    """Runs of packets lost to the loss model that ended in these slots, by length: 1, 2, … and 64 or more. A slot without a
    packet ends a run."""
    delays: NDArray[np.uint32]
    """Packets of these slots that were not lost, by their delay in slots: 0, 1, …, the window, and more."""
    unsent: NDArray[np.uint32] | None = None
    """Trials of each slot without a packet, (c,); None if all trials had one."""


@final
class Accountant:
    """Keeps the account of one link; slots must be added in order."""

    def __init__(self, window: int, trials: int) -> None:
        self._window = window
        self._trials = trials
        self._due: dict[int, NDArray[np.uint16]] = {}
        self._run = np.zeros(trials, np.int64)  # how many of its last packets each trial has lost

    def account(self, slots: range, fates: Fates) -> Account:
        """The account of the next slots."""
        return Account(
            fates.in_time,
            losses(fates.codes),
            self._late(slots, fates),
            self._bursts(fates.codes == Fate.LOST),
            self._delays(fates),
            _unsent(fates),
        )

    def _late(self, slots: range, fates: Fates) -> NDArray[np.uint16] | None:
        if not self._window:
            return None
        counts = np.zeros((len(slots), self._trials), np.uint16)
        for k in [k for k in self._due if k < slots.stop]:
            counts[k - slots.start] += self._due.pop(k)
        if fates.delays is not None:
            waits = np.where(fates.codes == Fate.DELIVERED, fates.delays, 0)
            for row, trial in zip(*np.nonzero(waits), strict=True):
                k = slots.start + int(row) + int(waits[row, trial])
                if k < slots.stop:
                    counts[k - slots.start, trial] += 1
                else:
                    self._due.setdefault(k, np.zeros(self._trials, np.uint16))[trial] += 1
        return counts

    def _bursts(self, lost: Flags) -> NDArray[np.uint32]:
        """Lengths of the runs that were ended by a packet that was not lost."""
        rows = np.arange(1, len(lost) + 1)[:, None]
        # For each row, the last row up to it, from 1, whose packet was not lost; 0 if there is none in these slots.
        kept = np.maximum.accumulate(np.where(lost, 0, rows), axis=0)
        before = np.vstack([np.zeros((1, lost.shape[1]), kept.dtype), kept[:-1]])
        lengths = rows - 1 - before + np.where(before == 0, self._run, 0)
        ended = lengths[~lost & (lengths > 0)]
        self._run = len(lost) - kept[-1] + np.where(kept[-1] == 0, self._run, 0)
        return np.bincount(np.minimum(ended, COUNTED_BURSTS) - 1, minlength=COUNTED_BURSTS).astype(np.uint32)

    def _delays(self, fates: Fates) -> NDArray[np.uint32]:
        through = (fates.codes == Fate.DELIVERED) | (fates.codes == Fate.LATE)
        bins = self._window + 2
        if fates.delays is None:
            counts = np.zeros(bins, np.uint32)
            counts[0] = np.count_nonzero(through)
            return counts
        return np.bincount(np.minimum(fates.delays[through], bins - 1), minlength=bins).astype(np.uint32)


def _unsent(fates: Fates) -> NDArray[np.uint32] | None:
    counts = np.count_nonzero(fates.codes == Fate.UNSENT, axis=1).astype(np.uint32)
    return counts if counts.any() else None
