"""One receiver's link from slot to slot: the fates of the packets, and what arrives in each slot, in time, late, or twice."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.links.loss_model import Fate
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags, Reception
from evedrop.model.slot.link import Change, Fates, Link, LinkSchedule
from evedrop.model.streams import Batch

NOTHING: Mapping[int, Any] = MappingProxyType({})


class Late(NamedTuple):
    """Packets of an earlier slot, or second copies from this slot, that arrive now."""

    k: int
    """The slot they were sent in."""
    heard: Reception
    """The packets; γ marks the trials in which one arrives."""
    copy: bool = False
    """Whether these are second copies of packets that have arrived already."""


class Arrival(NamedTuple):
    """Everything that arrives at a receiver in a slot."""

    heard: Reception
    """The slot's own packets."""
    late: tuple[Late, ...] = ()


class Arrivals(NamedTuple):
    """Everything that arrives at a receiver in c consecutive slots."""

    gamma: Flags
    """γ: whether the slot's own packet arrives, (c, R)."""
    z: Floats
    """Packets, (c, n, R); undefined where nothing was received."""
    header: NDArray[np.int64] | None = None
    """(c, h, R); None for a scheme without a header."""
    late: Mapping[int, tuple[Late, ...]] = NOTHING
    """Row → late packets, for rows in which any arrive."""
    truth: Mapping[int, Floats] = NOTHING
    """Row → x_k (n, R), for the row whose state is betrayed to this receiver."""

    @property
    def plain(self) -> bool:
        """Whether the slots' own packets are all there is."""
        return self.header is None and not self.late and not self.truth

    def at(self, row: int) -> Arrival:
        """What arrives in one of the slots."""
        header = None if self.header is None else self.header[row]
        heard = Reception(self.gamma[row], self.z[row], header, self.truth.get(row))
        return Arrival(heard, self.late.get(row, ()))


@final
class Transit:
    """Holds packets until they arrive. Slots must be passed on in order."""

    def __init__(self) -> None:
        self._due: dict[int, list[Late]] = {}

    @property
    def busy(self) -> bool:
        """Whether any packets are under way."""
        return bool(self._due)

    def arrival(self, k: int, fates: Fates, row: int, z: Floats, header: NDArray[np.int64] | None = None) -> Arrival:
        """The packets that arrive in slot k, whose own packets z (n, R) and header (h, R) have the fates of one row."""
        codes, delays, again = fates.codes[row], fates.delays, fates.again
        delivered: Flags = codes == int(Fate.DELIVERED)
        due = self._due.pop(k, [])
        if delays is not None:
            waits = delays[row]
            for wait in np.unique(waits[delivered]):
                if wait:
                    self._keep(k, int(wait), Reception(delivered & (waits == wait), z, header), copy=False)
            delivered = delivered & (waits == 0)
        if again is not None and again[row].any():
            waits = np.zeros(len(codes), np.uint32) if delays is None else delays[row]
            for wait in np.unique(waits[again[row]]):
                self._keep(k, int(wait), Reception(again[row] & (waits == wait), z, header), copy=True)
            due += self._due.pop(k, [])
        return Arrival(Reception(delivered, z, header), tuple(due))

    def arrivals(self, slots: range, fates: Fates, z: Floats, header: NDArray[np.int64] | None = None) -> Arrivals:
        """The same for consecutive slots: z (c, n, R), header (c, h, R)."""
        late = {}
        for row, k in enumerate(slots):
            late_ones = self.arrival(k, fates, row, z[row], None if header is None else header[row]).late
            if late_ones:
                late[row] = late_ones
        return Arrivals(fates.in_time, z, header, late)

    def _keep(self, k: int, wait: int, heard: Reception, copy: bool) -> None:
        header = None if heard.header is None else heard.header.copy()
        self._due.setdefault(k + wait, []).append(Late(k, Reception(heard.gamma, heard.z.copy(), header), copy))


@final
class LinkCore:
    """Has a `Link` decide the fates of a batch of slots ahead, and passes on the packets of many of these slots, or of one.

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
