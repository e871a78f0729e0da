"""The deliveries of a link, slot by slot, for simulations without packets."""

from __future__ import annotations

from collections.abc import Iterator

from evedrop.model.receiver import Flags
from evedrop.model.slot.link import Link

_AHEAD = 128  # slots drawn at once


def deliveries(link: Link, slots: int) -> Iterator[Flags]:
    """γ_k (R,) of slots 0 … slots−1, one after the other."""
    for start in range(0, slots, _AHEAD):
        yield from link.fates(range(start, min(start + _AHEAD, slots))).in_time
