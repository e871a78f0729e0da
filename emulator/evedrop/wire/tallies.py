"""The counts for the summary of a wire, kept while the wire runs, and the metrics of a link that follow from them.

Counted are fates, delays and runs of missing messages of each link. A wire file can expect something of the metrics, which
`WIRE_METRICS` lists.

Source: docs/wire/results.md, the summary and expectations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.results.wire_summary import WireLinkSummary
from evedrop.wire.records import Records, WireFate, delivered_again

_SAMPLE = 2**17  # delays of a link that are kept; of more, every second, fourth and so on
_MOST_RANGES = 2048
_TRIED = np.zeros(256, bool)  # of fates: the link's models decided, and that decision is known
_PASSED = np.zeros(256, bool)
for _fate in WireFate:
    _TRIED[_fate], _PASSED[_fate] = _fate.decided, _fate.passed


class NumberRange(NamedTuple):
    """A range of message numbers; not every message in it has to count."""

    start: int
    stop: int
    """The first number after them."""
    counted: int
    """How many of them count."""


@final
@dataclass(slots=True)
class StreamTally:
    """The messages of one key and kind on one link."""

    tried: int = 0
    """Messages on which the link's models decided."""
    passed: int = 0
    """Those of them that the models let through."""
    longest: int = 0
    """The most messages in a row that were not delivered."""
    silence: float = 0.0
    """The longest time, in seconds, from a delivered message to the next one, if messages between them were not delivered."""
    _start: int = 0
    _stop: int = 0
    _earlier: list[NumberRange] | None = None  # most streams have one range, and no need for a list
    _cell: int = 1  # ranges that begin in the same so many numbers are kept as one
    _missing: int = 0
    _since: float | None = None  # when the latest delivered message was heard, or else the first message

    @property
    def scattered(self) -> bool:
        """Whether their numbers are too scattered to be kept: then `ranges` contain others as well, and do not overlap."""
        return self._cell > 1

    @property
    def ranges(self) -> list[NumberRange]:
        """The numbers of the messages in `tried`, in ascending order."""
        latest = [NumberRange(self._start, self._stop, self._stop - self._start)] if self._stop else []
        ranges = [*(self._earlier or ()), *latest]
        return _joined(ranges, self._cell) if self.scattered else sorted(ranges)

    def add_one(self, time: float, n: int, fate: int, decided: bool) -> None:
        """Add a message, as `add` does: for few messages, which are most of all where keys are many, arrays cost more."""
        if decided and n >= 0 and _TRIED[fate]:
            self.tried += 1
            self.passed += int(_PASSED[fate])
            self._add_range(n, n + 1)
        since = time if self._since is None else self._since
        delivered = fate == WireFate.DELIVERED
        if self._missing or not delivered:
            self.silence = max(self.silence, time - since)
        self._missing = 0 if delivered else self._missing + 1
        self.longest = max(self.longest, self._missing)
        self._since = time if delivered else since

    def add(self, records: Records, decided: bool) -> None:
        """Add messages in the order in which they were heard. decided: whether to count their numbers as well."""
        if decided:
            self.add_decided(records)
        fates, times = records["fate"], records["time"]
        places = np.flatnonzero(fates == WireFate.DELIVERED)
        since = float(times[0]) if self._since is None else self._since
        runs = np.diff(places, prepend=-1) - 1
        last = len(records) - 1 - (int(places[-1]) if len(places) else -1)  # missing at the end
        if len(places):
            runs[0] += self._missing
            lengths = np.diff(times[places], prepend=since)
            self.longest = max(self.longest, int(runs.max()))
            self.silence = max(self.silence, float(lengths[runs > 0].max(initial=0.0)))
            self._missing, self._since = last, float(times[places[-1]])
        else:
            self._missing, self._since = self._missing + last, since
        if self._missing:
            self.longest = max(self.longest, self._missing)
            self.silence = max(self.silence, float(times[-1]) - self._since)

    def add_decided(self, records: Records) -> None:
        """Count messages on which the link's models decide, in any order: those of all keys that share their numbers."""
        tried = _TRIED[records["fate"]] & (records["n"] >= 0)
        self.tried += int(tried.sum())
        self.passed += int(_PASSED[records["fate"][tried]].sum())
        self._add_numbers(np.sort(records["n"][tried]))

    def _add_numbers(self, numbers: NDArray[np.int64]) -> None:
        if not len(numbers):
            return
        breaks = np.flatnonzero(np.diff(numbers) != 1) + 1
        starts, stops = numbers[np.r_[0, breaks]].tolist(), (numbers[np.r_[breaks - 1, -1]] + 1).tolist()
        for start, stop in zip(starts, stops, strict=True):
            self._add_range(start, stop)

    def _add_range(self, start: int, stop: int) -> None:
        if self._stop and start == self._stop:
            self._stop = stop
            return
        if self._stop:
            earlier = self._earlier = self._earlier or []
            earlier.append(NumberRange(self._start, self._stop, self._stop - self._start))
            if len(earlier) == _MOST_RANGES:
                self._earlier = _joined(earlier, self._cell)
                while len(self._earlier) > _MOST_RANGES // 2:
                    self._cell *= 2
                    self._earlier = _joined(earlier, self._cell)
        self._start, self._stop = start, stop


def _joined(ranges: list[NumberRange], cell: int) -> list[NumberRange]:
    """Ranges in ascending order, as one where they begin in the same `cell` numbers, or overlap.

    Which numbers of a range count is then forgotten; at most `cell` of them do not, so it stays known what settings they met.
    """
    made: list[NumberRange] = []
    for some in sorted(ranges):
        last = made[-1] if made else None
        if last is not None and (some.start // cell == last.start // cell or some.start < last.stop):
            made[-1] = NumberRange(last.start, max(last.stop, some.stop), last.counted + some.counted)
        else:
            made.append(some)
    return made


@final
class _DelaySample:
    """Some of many delays, in seconds: all of the first, then every second, fourth and so on."""

    def __init__(self) -> None:
        self.step = 1
        """The delays for which each of the sample stands."""
        self._parts: list[Floats] = []
        self._count = self._skip = 0

    def add(self, delays: Floats) -> None:
        """Add further delays."""
        taken = delays[self._skip :: self.step].copy()
        self._skip = (self._skip - len(delays)) % self.step
        self._parts.append(taken)
        self._count += len(taken)
        if self._count > _SAMPLE:
            thinned = self.delays
            self._skip += self.step * (len(thinned) % 2)
            self._parts, self.step = [thinned[::2]], 2 * self.step
            self._count = len(self._parts[0])

    @property
    def delays(self) -> Floats:
        """The sample."""
        return np.concatenate(self._parts) if self._parts else np.zeros(0)


@final
class LinkTally:
    """All messages of one link."""

    def __init__(self) -> None:
        self.heard = self.bytes = self.again = 0
        self.fates = np.zeros(256, np.int64)
        """Messages by fate; their sum is `heard`."""
        self.streams: dict[tuple[int, int], StreamTally] = {}
        """(code of the key, kind) → its messages."""
        self._delays = _DelaySample()
        self._undelivered = _DelaySample()  # those of messages that were not delivered after all

    def add(self, records: Records) -> None:
        """Add messages to all but `streams`."""
        self.heard += len(records)
        self.bytes += int(records["size"].sum(dtype=np.int64))
        self.again += int(np.count_nonzero(delivered_again(records)))
        self.fates += np.bincount(records["fate"], minlength=256)
        self._delays.add(records["delay"][records["fate"] == WireFate.DELIVERED])

    def amend(self, records: Records, fate: WireFate) -> None:
        """Messages that were added have another fate."""
        self.fates -= np.bincount(records["fate"], minlength=256)
        self.fates[fate] += len(records)
        if fate is not WireFate.DELIVERED:
            self.again -= int(np.count_nonzero(delivered_again(records)))
            self._undelivered.add(records["delay"][records["fate"] == WireFate.DELIVERED])

    @property
    def delivered(self) -> int:
        """Messages given to Zenoh on the other side."""
        return int(self.fates[WireFate.DELIVERED])

    def lost_by(self) -> Iterator[tuple[WireFate, int]]:
        """Each reason for which messages were not delivered, and how many."""
        for fate in WireFate:
            if fate is not WireFate.DELIVERED and self.fates[fate]:
                yield fate, int(self.fates[fate])

    def delay_quantile(self, level: float) -> float | None:
        """A quantile of the time for which delivered messages were held back, in seconds; None if there are none."""
        delays = self._delivered_delays() if self.delivered else np.zeros(0)
        return float(np.quantile(delays, level, method="inverted_cdf")) if len(delays) else None

    def _delivered_delays(self) -> Floats:
        """The sample without the delays of messages that were not delivered after all."""
        delays, undelivered = self._delays.delays, self._undelivered.delays
        if not len(undelivered):
            return delays
        values, places = np.unique(np.concatenate([delays, undelivered]), return_inverse=True)
        counts = np.zeros(len(values), np.int64)
        np.add.at(counts, places[: len(delays)], self._delays.step)
        np.subtract.at(counts, places[len(delays) :], self._undelivered.step)
        remaining: Floats = np.repeat(values, np.maximum(counts, 0) // self._delays.step)
        return remaining


class WireMetric(NamedTuple):
    """A metric of a link."""

    value: Callable[[WireLinkSummary, LinkTally, float | None], float | None]
    """Of a link, with the quantile of its table, by default the median; None if no message gives one: its expectation failed."""
    has_quantile: bool = False
    """Whether its table has `quantile`."""
    is_time: bool = False
    """Whether it is in seconds."""
    most: float = math.inf
    """The largest value that it can have; the least is 0."""


WIRE_METRICS: Mapping[str, WireMetric] = {
    "heard": WireMetric(lambda link, _tally, _quantile: link.heard),
    "delivery": WireMetric(
        lambda link, _tally, _quantile: link.delivered / link.heard if link.heard else None, most=1.0
    ),
    "latency": WireMetric(
        lambda _link, tally, quantile: tally.delay_quantile(quantile or 0.5), has_quantile=True, is_time=True
    ),
    "gap_messages": WireMetric(lambda link, _tally, _quantile: link.gap_messages if link.heard else None),
    "gap_seconds": WireMetric(lambda link, _tally, _quantile: link.gap_seconds if link.heard else None, is_time=True),
}
"""Name, as in `metric = "LINK.name"` → the metric, in the order of docs/wire/results.md."""
