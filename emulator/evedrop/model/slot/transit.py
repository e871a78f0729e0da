"""Packets under way on a link: those that arrive in each slot, in time, late, or twice."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.links.link import Fate
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags, Reception
from evedrop.model.slot.link import Fates

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
        delivered: Flags = codes == Fate.DELIVERED
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
            found = self.arrival(k, fates, row, z[row], None if header is None else header[row]).late
            if found:
                late[row] = found
        return Arrivals(fates.in_time, z, header, late)

    def _keep(self, k: int, wait: int, heard: Reception, copy: bool) -> None:
        header = None if heard.header is None else heard.header.copy()
        self._due.setdefault(k + wait, []).append(Late(k, Reception(heard.gamma, heard.z.copy(), header), copy))
