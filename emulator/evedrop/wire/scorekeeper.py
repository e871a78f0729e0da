"""Adds up the summary of a wire: the fates of all messages, each link against its model, and whether expectations held.

The model of a link says how many messages of a key it lets through: the mean and the variance over seeds. Time-dependent effects
are counted apart: a message that was cut, or for which the queue was full, is left out of `ranges`. The means and variances of
several keys, or links, add up, since their random numbers are independent.

Source: docs/wire/results.md, the summary; docs/mathematics/links.md, losses in bursts.
"""

from __future__ import annotations

import importlib.metadata
import math
import platform
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, groupby, pairwise
from pathlib import Path
from typing import Any, final

import numpy as np
import zenoh
from numpy.typing import NDArray

from evedrop.errors import UsageError
from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.links import loss_of
from evedrop.model.links.loss_model import Chain, LossModel, count_variance
from evedrop.model.process import Floats
from evedrop.model.slot.link import NEVER, Change, LinkSchedule
from evedrop.model.slot.link_distribution import stretches
from evedrop.results.folder import replace_private
from evedrop.results.wire_summary import (
    WIRE_SUMMARY_FILE,
    WireEventSummary,
    WireLinkSummary,
    WireSummary,
)
from evedrop.score.summary import Judged
from evedrop.system.output import warn
from evedrop.wire.journal import JournalOnDisk, WireJournal
from evedrop.wire.plan import WireLink, WirePlan
from evedrop.wire.records import REASONS, UNLINKED, Kind, Records, WireFate
from evedrop.wire.tables import WireExpectTable
from evedrop.wire.tallies import WIRE_METRICS, LinkTally, StreamTally

_FEW = 8  # messages of a key in a block; more are added as arrays
_QUANTILES = (0.5, 0.9, 0.99)
BYPASSED = "programs could speak past the wire"
"""Why an expectation of a wire with bypasses did not hold."""


@final
class WireScorekeeper:
    """Listens to a wire's journal, and adds up. Threads may call its methods at the same time."""

    def __init__(self, plan: WirePlan, journal: WireJournal | JournalOnDisk) -> None:
        self._plan, self._journal = plan, journal
        self._links = {link.number: LinkTally() for link in plan.links}
        self._unlinked = LinkTally()
        self._lossless: dict[int, bool] = {}
        self._lock = threading.Lock()
        journal.listeners.append(self.add)
        journal.amendment_listeners.append(self.amend)

    def add(self, records: Records) -> None:
        """Add a block of the journal."""
        with self._lock:
            kinds = (records["kind"] & 0x7F).astype(np.int64)
            kinds[kinds == Kind.DELETE] = Kind.PUT  # they share their numbers
            streams = np.stack([records["link"], records["key"], kinds]).astype(np.int64)
            order = np.lexsort(streams[::-1])  # stable
            streams, records = streams[:, order], records[order]
            for part in _split(records, streams[:1]):
                self._tally(int(part["link"][0])).add(part)
            times, numbers, fates = (records[name].tolist() for name in ("time", "n", "fate"))
            starts = [0, *_changes(streams).tolist(), len(records)]
            for (code, key, kind), start, stop in zip(_firsts(streams), starts, starts[1:], strict=False):
                if code == UNLINKED or not key:
                    continue  # a key that is not kept has no numbers
                streams_of = self._links[code].streams
                stream = streams_of.get((key, kind)) or streams_of.setdefault((key, kind), StreamTally())
                decided = not self._is_lossless(key)
                if stop - start > _FEW:
                    stream.add(records[start:stop], decided)
                else:
                    for at in range(start, stop):
                        stream.add_one(times[at], numbers[at], fates[at], decided)

    def amend(self, records: Records, fate: WireFate) -> None:
        """Count records of the journal that were added with another fate."""
        with self._lock:
            for code in np.unique(records["link"]).tolist():
                self._tally(code).amend(records[records["link"] == code], fate)

    def _tally(self, code: int) -> LinkTally:
        return self._unlinked if code == UNLINKED else self._links[code]

    def _is_lossless(self, key: int) -> bool:
        if not self._plan.lossless:
            return False
        if key not in self._lossless:
            self._lossless[key] = self._plan.is_lossless(zenoh.KeyExpr(self._journal.key_of(key)))
        return self._lossless[key]

    def links(self) -> dict[str, WireLinkSummary]:
        """Link → what became of its messages so far."""
        with self._lock:
            return {link.name: self._of_link(link, self._links[link.number]) for link in self._plan.links}

    def counts(self) -> dict[str, tuple[int, int]]:
        """Link → messages heard and messages delivered so far."""
        with self._lock:
            return {
                link.name: (self._links[link.number].heard, self._links[link.number].delivered)
                for link in self._plan.links
            }

    @property
    def unaccounted(self) -> int:
        """Records of the closed journal that are not in exactly one fate of one link: 0, or the wire has a fault."""
        tallies = [*self._links.values(), self._unlinked]
        return abs(self._journal.recorded - sum(int(tally.fates.sum()) for tally in tallies))

    def summary(self) -> WireSummary:
        """The summary so far."""
        journal, links = self._journal, self.links()
        return WireSummary(
            seed=self._plan.seed,
            start=journal.history.start,
            state=journal.state,
            seconds=journal.seconds,
            heard=journal.recorded,
            unlinked=self._unlinked.heard,
            unaccounted=self.unaccounted,
            journal=journal.completeness,
            links=links,
            expectations=self.judged(links),
            events=[WireEventSummary(*event) for event in journal.history.events],
            made_with={
                "python": platform.python_version(),
                **{name: importlib.metadata.version(name) for name in ("evedrop", "eclipse-zenoh")},
            },
        )

    def judged(self, links: Mapping[str, WireLinkSummary]) -> list[Judged]:
        """The expectations of the wire, and whether they held. None held if programs could have spoken past the wire."""
        bypassed = any(event.bypass for event in self._journal.history.events)
        judged = [self._judged(table, links[table.subject]) for table in self._plan.expectations]
        return [replace(result, held=None, why=BYPASSED) if bypassed and result.held else result for result in judged]

    def finish(self, out: Path) -> int:
        """Write summary.json of a wire whose journal is closed; returns the exit status.

        1 if an expectation failed, programs could have spoken past the wire, or the journal is incomplete; 3 if a message is
        unaccounted for.
        """
        summary = self.summary()
        try:
            replace_private(out / WIRE_SUMMARY_FILE, summary.text)
        except OSError as error:
            warn(f"the summary of the wire cannot be written ({error})")
            return 1
        if summary.unaccounted:
            return 3
        return (
            1 if summary.failed_expectations or summary.bypasses or summary.journal.incomplete_since is not None else 0
        )

    def _judged(self, table: WireExpectTable, link: WireLinkSummary) -> Judged:
        if table.link is not None:
            held, value, lacking = link.within_bounds, link.rate, "the link's models decided on no message"
        else:
            metric = WIRE_METRICS[str(table.metric).rpartition(".")[2]]
            value = metric.value(link, self._links[self._plan.named(table.subject).number], table.quantile)
            held, lacking = None if value is None else table.holds(value), "no message was delivered"
        if held is not None:
            return Judged(table.text, held, value, table.wanted)
        why = lacking if link.heard else "the link heard nothing"
        return Judged(table.text, None, value, table.wanted, why=why)

    def _of_link(self, link: WireLink, tally: LinkTally) -> WireLinkSummary:
        streams = list(tally.streams.values())
        tried, passed = (sum(getattr(counts, name) for counts in streams) for name in ("tried", "passed"))
        rate = model = between = within = None
        if tried:
            shared: dict[Any, tuple[float, float]] = {}
            moments = [
                self._moments(link, *stream, stream_tally, shared)
                for stream, stream_tally in tally.streams.items()
                if stream_tally.tried
            ]
            mean, variance = (sum_in_order(counts[i] for counts in moments) for i in (0, 1))
            low, high = bounds(mean, variance, tried)
            rate, model, between, within = (
                passed / tried,
                mean / tried,
                (low / tried, high / tried),
                low <= passed <= high,
            )
        reasons = [(REASONS[fate], count, fate.emulated) for fate, count in tally.lost_by()]
        quantiles = {f"{level:g}": tally.delay_quantile(level) for level in _QUANTILES}
        return WireLinkSummary(
            source=link.source,
            target=link.target,
            keys=link.keys,
            heard=tally.heard,
            bytes=tally.bytes,
            delivered=tally.delivered,
            again=tally.again,
            lost_by={reason: count for reason, count, emulated in reasons if emulated},
            dropped_by={reason: count for reason, count, emulated in reasons if not emulated},
            rate=rate,
            expected_rate=model,
            bounds=between,
            within_bounds=within,
            delays={level: seconds for level, seconds in quantiles.items() if seconds is not None},
            gap_messages=max((counts.longest for counts in streams), default=0),
            gap_seconds=max((counts.silence for counts in streams), default=0.0),
        )

    def _moments(
        self, link: WireLink, key: int, kind: int, tally: StreamTally, shared: dict[Any, tuple[float, float]]
    ) -> tuple[float, float]:
        """How many of a stream's messages its models should have let through, and the variance of this number.

        shared: those of the link so far, which streams with the same numbers and settings share: a key that never came again
        is like all others. Raises UsageError if a message has two fates, which only a journal on disk that was changed can say.
        """
        changes = self._journal.history.changes_of(link.name, self._journal.key_of(key), Kind(kind).stream)
        numbers = tuple(sorted(tally.ranges))
        name = (tuple((change.at, id(change.settings)) for change in changes), numbers, tally.tried)
        if name not in shared:
            ranges = [range(*pair) for pair in numbers]
            for before, after in pairwise(ranges):
                if after.start < before.stop:
                    raise UsageError(
                        f"the journal has two fates for message {after.start} of {self._journal.key_of(key)!r} on the link "
                        f"{link.name!r}; a file of it was changed, so give the results folder as the wire wrote it"
                    )
            mean, variance = expected(link.settings, changes, ranges)
            if tally.scattered:  # a sample of a known range: the range varies as a whole, and the sample within it
                fraction = tally.tried / sum(map(len, ranges))
                mean, variance = (
                    mean * fraction,
                    variance * fraction**2 + mean * fraction * (1.0 - mean * fraction / tally.tried),
                )
            shared[name] = (mean, variance)
        return shared[name]


def _changes(columns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Where sorted columns differ from those before them."""
    return np.flatnonzero((np.diff(columns) != 0).any(axis=0)) + 1


def _split(records: Records, columns: NDArray[np.int64]) -> list[Records]:
    """The records in groups with equal columns."""
    return np.split(records, _changes(columns))


def _firsts(columns: NDArray[np.int64]) -> list[list[int]]:
    """The columns of each group."""
    firsts: list[list[int]] = columns[:, np.r_[0, _changes(columns)]].T.tolist()
    return firsts


_STANDARD_DEVIATIONS = 2.5758293035489004  # of a normal variable, for 99 %
_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class _Part:
    """Consecutive messages between which the settings do not change."""

    loss: int
    """Which of the loss models decides on them: the number of the change that brought it."""
    spec: Mapping[str, Any]
    slots: range
    passes: float
    """Probability that a message that is not lost gets through."""


def expected(settings: Mapping[str, Any], changes: Iterable[Change], ranges: Iterable[range]) -> tuple[float, float]:
    """Mean and variance of the number of messages of one key that get through.

    settings: `WireLink.settings`; changes: as for `KeyFates`; ranges: the numbers of the messages, disjoint and ascending.

    The variance is exact for losses without a memory, and for those of a Markov chain, whatever is left out. For other losses
    with a memory it is that of the model for a single range, and an upper bound for several.
    """
    mean = variance = 0.0
    for _, group in groupby(_parts(settings, changes, ranges), key=lambda part: part.loss):
        parts = list(group)
        loss = loss_of(parts[0].spec)
        mean += sum_in_order(part.passes * _delivered(loss, part.slots) for part in parts)
        variance += _variance(loss, parts)
    return mean, variance


def bounds(mean: float, variance: float, count: int) -> tuple[float, float]:
    """Between which numbers the deliveries among `count` messages are in 99 % of all wires."""
    reach = _STANDARD_DEVIATIONS * math.sqrt(variance) + (0.5 if variance > 0.0 else 1e-6 * max(1.0, mean))
    return max(0.0, mean - reach), min(float(count), mean + reach)


def _parts(settings: Mapping[str, Any], changes: Iterable[Change], ranges: Iterable[range]) -> Iterator[_Part]:
    marks = stretches(LinkSchedule(settings, changes=tuple(changes)))
    models = accumulate((new["loss"] != old["loss"] for (_, old, _), (_, new, _) in pairwise(marks)), initial=0)
    ends = [*(start for start, _, _ in marks[1:]), NEVER]
    parts = [*zip(models, marks, ends, strict=True)]
    for some in ranges:
        for model, (start, new, _), stop in parts:
            slots = range(max(some.start, start), min(some.stop, stop))
            if slots:
                yield _Part(model, new["loss"], slots, 1.0 - new.get("corrupt", 0.0))


def _delivered(loss: LossModel, slots: range) -> float:
    """The mean number of these messages that are not lost."""
    if loss.chain is not None:
        return len(slots) * loss.quality
    pieces = (slots[i : i + _AT_ONCE] for i in range(0, len(slots), _AT_ONCE))
    return sum_in_order(float(loss.quality_at(piece).sum()) for piece in pieces)


def _variance(loss: LossModel, parts: Sequence[_Part]) -> float:
    if loss.chain is not None:
        return _variance_of_chain(loss.chain, parts)
    each = [
        part.passes**2 * loss.rate_variance(part.slots) * len(part.slots) ** 2
        + part.passes * (1.0 - part.passes) * _delivered(loss, part.slots)
        for part in parts
    ]
    return sum_in_order(each) if loss.memoryless else sum_in_order(map(math.sqrt, each)) ** 2


def _variance_of_chain(chain: Chain, parts: Sequence[_Part]) -> float:
    """The variance for parts of one chain, which continues between them.

    w is the row Σ passes_i E[(γ_i − mean); state at the present message] over the messages i so far, so that the covariance of
    all of them with the message is w · (quality − mean). Its entries sum to 0; so the chain's stationary part can be left out.
    """
    mean = float(chain.stationary @ chain.quality)
    centred = chain.quality - mean
    fading = chain.transitions - chain.stationary
    sums: dict[int, tuple[Floats, Floats]] = {}
    w, at, total = np.zeros(len(centred)), parts[0].slots.start, 0.0
    for part in parts:
        count, passes = len(part.slots), part.passes
        if count not in sums:
            sums[count] = _power_and_sum(fading, count)
        power, partial = sums[count]
        w = w @ np.linalg.matrix_power(fading, part.slots.start - at)
        own = passes**2 * count_variance(chain.transitions, chain.stationary, chain.quality, count)
        total += own + passes * (1.0 - passes) * count * mean + 2.0 * passes * float(w @ partial @ centred)
        w = w @ power + passes * ((chain.stationary * centred) @ partial @ fading)
        at = part.slots.stop
    return total


def _power_and_sum(matrix: Floats, count: int) -> tuple[Floats, Floats]:
    """The power `count` of a matrix, and the sum of its powers below that one, by doubling."""
    power, partial = np.eye(len(matrix)), np.zeros_like(matrix)
    for bit in f"{count:b}":
        partial = partial + power @ partial
        power = power @ power
        if bit == "1":
            partial = partial + power
            power = power @ matrix
    return power, partial
