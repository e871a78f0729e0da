"""Counts the fates of messages in time steps: from rows of the journal to a few numbers for each link and step.

Memory and work are bounded: rows are counted with three passes over a block, and at most `_SPAN` steps are open at a time.

Source: docs/wire.md, the view.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from evedrop.wire.record import UNLINKED, WireFate

Counts = NDArray[np.int64]

OUTCOMES: tuple[WireFate, ...] = tuple(WireFate)
"""The last axis of `WireSteps.counts`."""
DELIVERED = OUTCOMES.index(WireFate.DELIVERED)
CUT = OUTCOMES.index(WireFate.CUT)
UNDERWAY = OUTCOMES.index(WireFate.UNDERWAY)

_SPAN = 64  # steps that may be open at a time
_BY_CODE = np.zeros(256, np.int64)
_BY_CODE[[int(one) for one in OUTCOMES]] = np.arange(len(OUTCOMES))

_SHORTEST, _PER_DECADE, _DECADES = 1e-5, 40, 8
_BUCKETS = _PER_DECADE * _DECADES + 2
"""Bucket 0: delays below 10 µs; then 40 for each factor of ten, for quantiles right within 3 %; the last: 1000 s or more."""


@dataclass(frozen=True)
class WireSteps:
    """c consecutive steps of time, complete. Rows of links: the links in order, then messages that no link takes."""

    first: int
    """Number of the first step."""
    counts: Counts
    """Messages by link and outcome, (c, links + 1, outcomes). Below 0 where a fate was changed after its step was closed."""
    delays: Counts
    """Delivered messages by link and bucket of delay, (c, links + 1, buckets)."""

    @property
    def heard(self) -> Counts:
        """Messages that came, (c, links + 1)."""
        heard: Counts = self.counts.sum(2)
        return heard

    @property
    def numbers(self) -> Counts:
        """Numbers of the steps, (c,)."""
        return np.arange(self.first, self.first + len(self.counts))


@final
class StepCounter:
    """Counts blocks of rows, whose times may be slightly out of order. A row of a closed step counts in the oldest open step.

    links: number of links. step: seconds. start: the time at which step 0 begins, in seconds since 1970.
    """

    def __init__(self, links: int, step: float, start: float) -> None:
        self._links, self._step, self._start = links, step, start
        self._first = 0
        self._counts = np.zeros((_SPAN, links + 1, len(OUTCOMES)), np.int64)
        self._delays = np.zeros((_SPAN, links + 1, _BUCKETS), np.int64)

    def add(self, rows: NDArray[Any]) -> Iterator[WireSteps]:
        """Count the rows of a block, a `RECORD` array; gives the steps that are closed to make room; of a silence, only a few."""
        at = np.floor((rows["time"] - self._start) / self._step).astype(np.int64)
        links = np.where(rows["link"] == UNLINKED, self._links, np.minimum(rows["link"], self._links)).astype(np.int64)
        outcomes, delays = _BY_CODE[rows["fate"]], rows["delay"]
        while len(at):
            inside = at < self._first + _SPAN
            self._count(np.maximum(at[inside] - self._first, 0), links[inside], outcomes[inside], delays[inside])
            outside = ~inside
            at, links, outcomes, delays = at[outside], links[outside], outcomes[outside], delays[outside]
            if len(at):
                newest = int(at.min())
                yield self._closed(min(_SPAN, newest - self._first - _SPAN // 2))
                # Of a silence, only the beginning and the last step are given.
                self._first = max(self._first, newest - 1) if not self._counts.any() else self._first

    def amend(self, rows: NDArray[Any], fate: int) -> None:
        """Change the fate of rows that were counted: in their steps, or in the oldest open step."""
        steps = np.floor((rows["time"] - self._start) / self._step).astype(np.int64)
        at = np.clip(steps - self._first, 0, _SPAN - 1)
        links = np.minimum(rows["link"], self._links).astype(np.int64)
        np.subtract.at(self._counts, (at, links, _BY_CODE[rows["fate"]]), 1)
        np.add.at(self._counts, (at, links, _BY_CODE[fate]), 1)

    def close(self, until: float) -> Iterator[WireSteps]:
        """Close the steps that end at a time or before, in seconds since 1970; at most `_SPAN` after the last message."""
        end = int(np.floor((until - self._start) / self._step))
        if end > self._first:
            yield self._closed(min(_SPAN, end - self._first))
        self._first = max(self._first, end)

    def finish(self) -> Iterator[WireSteps]:
        """Close all steps up to the last with a message."""
        last = np.flatnonzero(self._counts.any((1, 2)))
        if len(last):
            yield self._closed(int(last[-1]) + 1)

    def _count(self, at: Counts, links: Counts, outcomes: Counts, delays: NDArray[np.float64]) -> None:
        where = at * (self._links + 1) + links
        self._counts += np.bincount(where * len(OUTCOMES) + outcomes, minlength=self._counts.size).reshape(
            self._counts.shape
        )
        there = outcomes == DELIVERED
        with np.errstate(divide="ignore"):
            decades = np.log10(delays[there] / _SHORTEST)
        buckets = np.clip(np.floor(decades * _PER_DECADE) + 1, 0, _BUCKETS - 1).astype(np.int64)
        cells = np.bincount(where[there] * _BUCKETS + buckets, minlength=self._delays.size)
        self._delays += cells.reshape(self._delays.shape)

    def _closed(self, steps: int) -> WireSteps:
        closed = WireSteps(self._first, self._counts[:steps].copy(), self._delays[:steps].copy())
        for counts in (self._counts, self._delays):
            counts[: _SPAN - steps] = counts[steps:]
            counts[_SPAN - steps :] = 0
        self._first += steps
        return closed


def quantile(delays: Counts, fraction: float) -> NDArray[np.float64]:
    """The delay in seconds that a fraction of the messages does not exceed, by buckets (…, buckets); NaN without a message."""
    total = delays.cumsum(-1)
    bucket = (total >= np.maximum(fraction * total[..., -1:], 1e-9)).argmax(-1)
    middle = _SHORTEST * 10.0 ** ((bucket - 0.5) / _PER_DECADE)
    return np.where(total[..., -1] == 0, np.nan, np.where(bucket == 0, 0.0, middle))
