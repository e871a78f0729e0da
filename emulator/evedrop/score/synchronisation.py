"""Whether a receiver follows the process in each slot, and the spans in which it does not.

A receiver with Gaussian errors whose covariance P is right has a squared error above 20 tr P in fewer than one of 100 000 slots,
whatever the number of states: of all Gaussian errors with this trace, one along a single direction is above most often (Székely
and Bakirov 2003), and there 20 is exceeded with probability 7.7e-6. Errors up to 20 times those of one step's noise, tr Q, are
those of a receiver that follows the process step by step.

Source: docs/view.md, who knows what; docs/metrics.md, lost synchronisation.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from heapq import nlargest
from typing import final

import numpy as np

from evedrop.model.process import Floats
from evedrop.model.receiver import Codes, Flags

FACTOR = 20.0
"""How far above its expectation a squared error may be by chance."""
JOINED = 3
"""Spans that are at most this many slots apart are one."""


class Synchronisation(IntEnum):
    """What a receiver knows of the process in a slot."""

    SYNCHRONISED = 0
    UNCERTAIN = 1
    """Its error is large, or it reports so, and its own covariance allows such an error."""
    OVERCONFIDENT = 2
    """Its error is far larger than its own covariance allows."""

    @property
    def word(self) -> str:
        """The code as a word."""
        return self.name.lower()


def synchronisation_of(squared_error: Floats, trace: Floats, noise: float) -> Codes:
    """The code of every slot (c,), from the squared error and the reported tr P, (c,) each, and the process noise tr Q.

    Overconfident: the squared error is above 20 times the larger of tr P and tr Q. Uncertain: otherwise, the squared error or
    tr P is above 20 tr Q. Synchronised: otherwise.
    """
    overconfident = is_overconfident(squared_error, trace, noise)
    with np.errstate(invalid="ignore"):
        uncertain = np.maximum(squared_error, trace) > FACTOR * noise
    return np.where(
        overconfident,
        np.uint8(Synchronisation.OVERCONFIDENT),
        np.where(uncertain, np.uint8(Synchronisation.UNCERTAIN), np.uint8(Synchronisation.SYNCHRONISED)),
    )


def is_overconfident(squared_error: Floats, trace: Floats, noise: float) -> Flags:
    """Whether squared errors are far above the traces that a receiver reports; also if one is not a number. noise: tr Q."""
    with np.errstate(invalid="ignore"):
        overconfident: Flags = ~(squared_error <= FACTOR * np.maximum(trace, noise))
    return overconfident


@dataclass(frozen=True)
class LostSpan:
    """Slots in which a receiver was not synchronised, the last one included."""

    first: int
    last: int
    overconfident: int
    """In how many of them it was overconfident."""

    @property
    def slots(self) -> int:
        """Its length."""
        return self.last - self.first + 1


def lost_spans(codes: Codes, first: int = 0) -> list[LostSpan]:
    """The spans without synchronisation, in order; codes: of the slots from `first` on."""
    off = np.flatnonzero(codes != Synchronisation.SYNCHRONISED)
    if not off.size:
        return []
    breaks = np.flatnonzero(np.diff(off) > JOINED)
    begins, ends = off[np.append(0, breaks + 1)], off[np.append(breaks, len(off) - 1)]
    so_far = np.append(0, np.cumsum(codes == int(Synchronisation.OVERCONFIDENT)))
    overconfident = so_far[ends + 1] - so_far[begins]
    spans = zip((begins + first).tolist(), (ends + first).tolist(), overconfident.tolist(), strict=True)
    return [LostSpan(*span) for span in spans]


@final
class LongestSpans:
    """The longest spans without synchronisation, found in consecutive pieces of slots, and how many there are in all."""

    def __init__(self, most: int, first: int = 0) -> None:
        """most: how many are kept, of equally long ones the earlier; first: the first slot of the first piece."""
        self._most, self._next = most, first
        self._ended = 0
        self._longest_spans: list[LostSpan] = []
        self._open: LostSpan | None = None
        """The last span so far: further slots may prolong it."""

    def add(self, codes: Codes) -> None:
        """The codes of the next slots, (c,)."""
        spans = lost_spans(codes, self._next)
        self._next += len(codes)
        if self._open is not None:
            if spans and spans[0].first - self._open.last <= JOINED:
                spans[0] = LostSpan(self._open.first, spans[0].last, self._open.overconfident + spans[0].overconfident)
            else:
                spans.insert(0, self._open)
        self._open = spans.pop() if spans else None
        self._ended += len(spans)
        self._longest_spans = self._longest(spans)

    @property
    def count(self) -> int:
        """The number of spans."""
        return self._ended + (self._open is not None)

    @property
    def spans(self) -> list[LostSpan]:
        """The longest spans, longest first."""
        return self._longest([] if self._open is None else [self._open])

    def _longest(self, further: list[LostSpan]) -> list[LostSpan]:
        return nlargest(self._most, [*self._longest_spans, *further], key=lambda span: (span.slots, -span.first))
