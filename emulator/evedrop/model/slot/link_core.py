"""One receiver's link from slot to slot: the fates of the packets, and what arrives in each slot.

Source: docs/mathematics.md, links.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.model.receiver import Flags
from evedrop.model.slot.link import Change, Fates, Link, LinkSchedule
from evedrop.model.slot.transit import Arrivals, Transit
from evedrop.model.streams import Batch


@final
class LinkCore:
    """Decides the fates of a batch of slots ahead, and passes on the packets of many of these slots at once, or of one.

    keys: those of `streams_of`.
    """

    def __init__(self, schedule: LinkSchedule, receiver: str, keys: Mapping[str, bytes], batch: Batch) -> None:
        self._outages = schedule.outages
        self._link = Link(schedule, receiver, keys, batch)
        self._transit = Transit()
        self._own = False  # whether the arrays of `fates` are a copy, which may be changed
        self.slots = range(0)
        """The slots whose fates are decided."""
        self.fates: Fates
        """The fates of their packets. If the scheme may be silent, those of a slot are final once the slot has been silenced."""
        self.in_time: Flags
        """γ of these slots, (c, R)."""

    def plan(self, slots: range) -> None:
        """Decide the fates of the next batch of slots."""
        self._take(slots, self._link.planned(slots))

    def amend(self, at: int, changes: Iterable[Change]) -> None:
        """Decide the slots of the batch from `at` on again, with these changes; the batch begins there from now on."""
        self._take(range(at, self.slots.stop), self._link.amended(at, changes))

    def _take(self, slots: range, fates: Fates) -> None:
        self.slots, self.fates, self.in_time, self._own = slots, fates, fates.in_time, False

    def rows(self, slots: range) -> slice:
        """The rows of some slots of the batch in its arrays."""
        return slice(slots.start - self.slots.start, slots.stop - self.slots.start)

    def part(self, slots: range) -> Fates:
        """The fates of some slots of the batch."""
        return self.fates.part(self.rows(slots))

    def silence(self, slots: range, sent: Flags) -> None:
        """Take the packets that are not sent, (c, R), out of some slots of the batch."""
        if not self._own:
            self.fates, self._own = self.fates.copied(), True
        rows = self.rows(slots)
        for row, some in enumerate(sent, rows.start):
            self.fates.silence(row, some)
        self.in_time[rows] &= sent

    def arrivals(self, slots: range, z: Floats, header: NDArray[np.int64] | None = None) -> Arrivals:
        """What arrives in some slots of the batch, in order: z (c, n, R), header (c, h, R)."""
        if self.fates.delays is None and self.fates.again is None and not self._transit.busy:
            return Arrivals(self.in_time[self.rows(slots)], z, header)
        return self._transit.arrivals(slots, self.part(slots), z, header)

    def gamma(self, k: int) -> Flags:
        """γ of a slot of the batch, (R,)."""
        flags: Flags = self.in_time[k - self.slots.start]
        return flags

    def rest(self, k: int) -> float | None:
        """The fraction of a slot in the delay of the first trial's packet of a slot of the batch; None without delays."""
        return None if self.fates.rests is None else float(self.fates.rests[k - self.slots.start])

    def present(self, k: int) -> bool:
        """Whether the receiver is present in slot k."""
        return not any(away.start <= k < away.stop for away in self._outages)
