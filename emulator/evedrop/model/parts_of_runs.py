"""The slots of a long run in parts, so that computations need no more memory for a longer run."""

from __future__ import annotations

from collections.abc import Iterator

SLOTS_AT_ONCE = 2**14
"""The most slots in a part."""


def parts_of(slots: range) -> Iterator[range]:
    """Consecutive slots in parts, in order; none if there are no slots."""
    for first in range(slots.start, slots.stop, SLOTS_AT_ONCE):
        yield range(first, min(slots.stop, first + SLOTS_AT_ONCE))
