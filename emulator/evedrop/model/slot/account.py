"""The account of a link: the outcomes of its packets, slot by slot, and the distributions of its losses and delays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels.current import kernels
from evedrop.model.links.link import REASONS, Fate
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
        counts = kernels.count_codes(fates.codes, len(Fate))
        unsent = counts[:, Fate.UNSENT].copy()
        return Account(
            fates.in_time,
            {reason: counts[:, code].copy() for code, reason in enumerate(REASONS, 1)},
            self._late(slots, fates),
            kernels.count_bursts(fates.codes, Fate.LOST, self._run, COUNTED_BURSTS),
            self._delays(fates, counts),
            unsent if unsent.any() else None,
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

    def _delays(self, fates: Fates, counts: NDArray[np.uint32]) -> NDArray[np.uint32]:
        bins = self._window + 2
        if fates.delays is None:
            delays = np.zeros(bins, np.uint32)
            delays[0] = counts[:, [Fate.DELIVERED, Fate.LATE]].sum()
            return delays
        through = (fates.codes == Fate.DELIVERED) | (fates.codes == Fate.LATE)
        return np.bincount(np.minimum(fates.delays[through], bins - 1), minlength=bins).astype(np.uint32)
