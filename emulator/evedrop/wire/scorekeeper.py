"""Adds up the summary of a wire: the fates of all messages, each link against its model, and whether expectations held.

The model of a link says how many messages of a key it lets through. Time-dependent effects are counted apart: a message that was
cut, or for which the queue was full, is left out of `ranges`.

Source: docs/wire/results.md, the summary.
"""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, final

import numpy as np
import zenoh
from numpy.typing import NDArray

from evedrop.errors import UsageError
from evedrop.model.kernels.elementary import sum_in_order
from evedrop.results.folder import replace_private
from evedrop.results.wire_summary import (
    WIRE_SUMMARY_FILE,
    WireEventSummary,
    WireLinkSummary,
    WireSummary,
)
from evedrop.score.summary import Judged
from evedrop.system.output import warn
from evedrop.system.world import world
from evedrop.wire.deliveries import KeyDeliveries, bounds
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_reading import JournalOnDisk
from evedrop.wire.plan import WireLink, WirePlan, numbered_as
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
        # Key that numbers a history → the first key of it, which counts its numbers.
        self._histories: dict[str, int] = {}
        self._history_of: dict[int, int | None] = {}
        self._lock = world().lock()
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
            for (code,), start, stop in _groups(streams[:1]):
                self._tally(code).add(records[start:stop])
            times, numbers, fates = (records[name].tolist() for name in ("time", "n", "fate"))
            numbered_together: dict[tuple[int, int, int], list[Records]] = {}
            for (code, key, kind), start, stop in _groups(streams):
                if code == UNLINKED or not key:
                    continue  # a key that is not kept has no numbers
                streams_of = self._links[code].streams
                stream = streams_of.get((key, kind)) or streams_of.setdefault((key, kind), StreamTally())
                decided, history = not self._is_lossless(key), self._history(key)
                if decided and history is not None:
                    numbered_together.setdefault((code, history, kind), []).append(records[start:stop])
                    decided = False
                if stop - start > _FEW:
                    stream.add(records[start:stop], decided)
                else:
                    for at in range(start, stop):
                        stream.add_one(times[at], numbers[at], fates[at], decided)
            for (code, key, kind), parts in numbered_together.items():
                self._links[code].streams.setdefault((key, kind), StreamTally()).add_decided(np.concatenate(parts))

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

    def _history(self, key: int) -> int | None:
        """The key that counts the numbers of a key that shares them with others; None if it has numbers of its own."""
        if key not in self._history_of:
            text = self._journal.key_of(key)
            numbered = numbered_as(text)
            self._history_of[key] = None if numbered == text else self._histories.setdefault(numbered, key)
        return self._history_of[key]

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
            shared: dict[Any, KeyDeliveries] = {}
            counted = [
                self._stream(link, *stream, stream_tally, shared)
                for stream, stream_tally in tally.streams.items()
                if stream_tally.tried
            ]
            mean = sum_in_order(stream.mean for stream in counted)
            low, high = bounds(counted, tried)
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

    def _stream(
        self, link: WireLink, key: int, kind: int, tally: StreamTally, shared: dict[Any, KeyDeliveries]
    ) -> KeyDeliveries:
        """How many of a stream's messages its models should have let through.

        shared: those of the link so far, which streams with the same numbers and settings share: a key that never came again
        is like all others. Raises UsageError if a message has two fates, which only a journal on disk that was changed can say.
        """
        changes = self._journal.history.changes_of(link.name, self._journal.key_of(key), Kind(kind).stream)
        numbers = tuple(tally.ranges)
        name = (tuple((change.at, id(change.settings)) for change in changes), numbers)
        if name not in shared:
            ranges = [range(start, stop) for start, stop, _ in numbers]
            for before, after in pairwise(ranges):
                if after.start < before.stop:
                    raise UsageError(
                        f"the journal has two fates for message {after.start} of {self._journal.key_of(key)!r} on the link "
                        f"{link.name!r}; a file of it was changed, so give the results folder as the wire wrote it"
                    )
            shared[name] = KeyDeliveries(link.settings, changes, ranges, [some.counted for some in numbers])
        return shared[name]


def _groups(columns: NDArray[np.int64]) -> Iterator[tuple[list[int], int, int]]:
    """The groups of equal ones among sorted columns: the column, the place of its first, and that after its last."""
    starts = [0, *(np.flatnonzero((columns[:, 1:] != columns[:, :-1]).any(axis=0)) + 1).tolist()]
    yield from zip(columns[:, starts].T.tolist(), starts, [*starts[1:], columns.shape[1]], strict=True)
