"""What a wire's view shows of a time step: counts of fates, the state of each lane, and moments that deserve a line.

Steps are counted from rows of the journal; from a few numbers for each link and step follow the colour of its lane, and notices
of long stretches in which nothing arrives and of losses of the wire's own. Memory and work are bounded: rows are counted with
three passes over a block, and at most `_SPAN` steps are open at a time. Does not use Rerun.

Source: docs/wire/results.md, the view.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from evedrop.counting import counted
from evedrop.show.view import palette
from evedrop.show.view.lanes import Lane
from evedrop.show.view.palette import Colour
from evedrop.wire.plan import WireLink, WirePlan
from evedrop.wire.records import UNLINKED, WireFate

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
    middles: NDArray[np.float64]
    """Of the delays so far in each bucket, in seconds: exactly the delay where it is constant, (links + 1, buckets)."""

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
        self._least, self._most = np.full((2, (links + 1) * _BUCKETS), [[np.inf], [-np.inf]])

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
        of_links = where[there] % (self._links + 1) * _BUCKETS + buckets
        np.minimum.at(self._least, of_links, delays[there])
        np.maximum.at(self._most, of_links, delays[there])
        cells = np.bincount(where[there] * _BUCKETS + buckets, minlength=self._delays.size)
        self._delays += cells.reshape(self._delays.shape)

    def _closed(self, steps: int) -> WireSteps:
        middles: NDArray[np.float64] = np.full(len(self._least), np.nan)
        np.add(self._least / 2.0, self._most / 2.0, out=middles, where=self._least <= self._most)
        closed = WireSteps(
            self._first, self._counts[:steps].copy(), self._delays[:steps].copy(), middles.reshape(-1, _BUCKETS)
        )
        for counts in (self._counts, self._delays):
            counts[: _SPAN - steps] = counts[steps:]
            counts[_SPAN - steps :] = 0
        self._first += steps
        return closed


def quantile(delays: Counts, middles: NDArray[np.float64], fraction: float) -> NDArray[np.float64]:
    """The delay in seconds that a fraction of the messages does not exceed; NaN without a message.

    delays: by buckets, (…, links, buckets); middles: as in `WireSteps`, for these links.
    """
    total = delays.cumsum(-1)
    bucket = (total >= np.maximum(fraction * total[..., -1:], 1e-9)).argmax(-1)
    middle = middles[np.arange(len(middles)), bucket]
    return np.where(total[..., -1] == 0, np.nan, np.where(bucket == 0, 0.0, middle))


class LaneState(Enum):
    """A word for a step of a lane, its colour, and the colour's name."""

    QUIET = ("no message", palette.SILENT, "black")
    DELIVERED = ("all delivered", palette.DROPPED, "slate")
    SOME = ("some lost", palette.MISLED, "sand")
    MOST = ("most lost", palette.DECODED, "light blue")
    CUT = ("cut", palette.STATE, "ivory")
    FULL = ("queue full", palette.STEEL, "steel")
    OWN = ("not by the link", palette.DISCARDED, "brown")

    def __init__(self, word: str, colour: Colour, name_of_colour: str) -> None:
        self.word = word
        self.colour = colour
        self.name_of_colour = name_of_colour


LANE = Lane(tuple(state.word for state in LaneState), tuple(state.colour for state in LaneState))
"""The lane of a link."""


def state_of(counts: Counts) -> LaneState:
    """The state of a link; counts: messages by outcome, (outcomes,). The most frequent reason for a loss decides.

    Messages that were still underway when the wire ended do not count.
    """
    ended = counts.copy()
    ended[UNDERWAY] = 0
    reasons = ended.copy()
    reasons[DELIVERED] = 0
    if not reasons.any():
        return LaneState.DELIVERED if counts[DELIVERED] else LaneState.QUIET
    reason = OUTCOMES[int(reasons.argmax())]
    if reason is WireFate.CUT:
        return LaneState.CUT
    if reason is WireFate.OVERFLOW:
        return LaneState.FULL
    return loss_state_of(ended) if reason.emulated else LaneState.OWN


def loss_state_of(counts: Counts) -> LaneState:
    """How much of a link's messages was lost, for whatever reason; counts as for `state_of`."""
    heard, delivered = int(counts.sum()), int(counts[DELIVERED])
    if not heard:
        return LaneState.QUIET
    if delivered == heard:
        return LaneState.DELIVERED
    return LaneState.SOME if 2 * delivered > heard else LaneState.MOST


def legend(plan: WirePlan) -> str:
    """The legend of the lanes, with what this wire's file can cause."""
    states = [LaneState.DELIVERED, LaneState.SOME, LaneState.MOST, LaneState.CUT]
    settings = [*(link.settings for link in plan.links), *(event.settings or {} for event in plan.events)]
    if any(entry.get("rate") for entry in settings):
        states.append(LaneState.FULL)
    return " · ".join(f"{state.name_of_colour}: {state.word}" for state in states)


WORDS = {
    WireFate.LOST: "lost",
    WireFate.CORRUPTED: "corrupted",
    WireFate.OVERFLOW: "queue full",
    WireFate.CUT: "cut",
    WireFate.UNLINKED: "no link",
    WireFate.TOO_LARGE: "too large",
    WireFate.HELD_UP: "too many held",
    WireFate.LOOPED: "looped",
    WireFate.UNDERWAY: "underway",
    WireFate.REFUSED: "refused by Zenoh",
    WireFate.TOO_MANY_KEYS: "too many keys",
    WireFate.CONGESTED: "not taken by readers",
}
"""What became of messages that were not delivered, in a word or two."""

_SECONDS, _MESSAGES = 0.5, 3  # a shorter stretch, or one of fewer messages, deserves no line
_OFTEN = 10.0  # seconds between stretches of a link; if they come more often, only longer ones get a line
_FIRST = 3  # stretches of a link that always get a line


class Notice(NamedTuple):
    """A line of the events panel."""

    seconds: float
    """Since the start of the wire."""
    level: str
    """INFO, WARN or ERROR."""
    text: str


@final
class NoticeWatcher:
    """Finds the notices of all links, block of steps by block. names: of the links; step: seconds."""

    def __init__(self, names: Iterable[str], step: float) -> None:
        self._step = step
        self._stretches = [_Stretch(name, step) for name in names]
        self._names = [*(stretch.name for stretch in self._stretches), "keys without a link"]
        self._known: set[tuple[int, int]] = set()

    def watch(self, steps: WireSteps) -> list[Notice]:
        """The notices of the next steps, in order of time."""
        notices = [*self._own_losses(steps)]
        for row, stretch in enumerate(self._stretches):
            notices += stretch.watch(steps.first, steps.counts[:, row])
        return sorted(notices, key=lambda notice: notice.seconds)

    def _own_losses(self, steps: WireSteps) -> Iterator[Notice]:
        """A line when a link loses a message for a reason that is not emulated, for the first time."""
        for at, link, outcome in np.argwhere(steps.counts).tolist():
            fate = OUTCOMES[outcome]
            if not fate.emulated and fate is not WireFate.UNDERWAY and (link, outcome) not in self._known:
                self._known.add((link, outcome))
                level = "INFO" if fate is WireFate.UNLINKED else "ERROR"
                text = f"{self._names[link]}: the first message that does not cross: {WORDS[fate]}"
                yield Notice((steps.first + at) * self._step, level, text)


@final
class CutWatcher:
    """Tells which links are cut, by the fates of their messages. A link without messages keeps its state."""

    def __init__(self, links: Sequence[WireLink]) -> None:
        self._links = links
        self._cut: list[bool | None] = [None] * len(links)

    def watch(self, counts: Counts) -> None:
        """Take the counts of the next step, (links or more, outcomes)."""
        for at in np.flatnonzero(counts[: len(self._links)].any(1)).tolist():
            self._cut[at] = bool(counts[at, CUT])

    def cut(self) -> list[str]:
        """Pairs of sides all of whose links with messages are cut, such as "robot|base", and further links that are cut."""
        pairs: dict[frozenset[str], list[int]] = {}
        for at, link in enumerate(self._links):
            if self._cut[at] is not None:
                pairs.setdefault(frozenset((link.source, link.target)), []).append(at)
        cut = []
        for links in pairs.values():
            first = self._links[links[0]]
            if len(links) > 1 and all(self._cut[at] for at in links):
                cut.append(f"{first.source}|{first.target}")
            else:
                cut += [self._links[at].name for at in links if self._cut[at]]
        return cut


@final
class _Stretch:
    """The present stretch of steps in which messages of a link came and none was delivered."""

    def __init__(self, name: str, step: float) -> None:
        self.name = name
        self._step = step
        self._since = 0
        self._lost = np.zeros(len(OUTCOMES), np.int64)
        self._told = False
        self._reported = 0
        self._long = _SECONDS

    def watch(self, first: int, counts: Counts) -> Iterator[Notice]:
        """Notices of steps from `first` on, by counts (c, outcomes)."""
        for at in np.flatnonzero(counts.any(1)).tolist():
            k = first + at
            if counts[at, DELIVERED] or counts[at, UNDERWAY]:
                yield from self._end(k)
                continue
            if not self._lost.any():
                self._since = k
            self._lost += counts[at]
            seconds = (k + 1 - self._since) * self._step
            if not self._told and seconds >= self._long - 1e-9 and self._lost.sum() >= _MESSAGES:
                self._told = True
                yield Notice(
                    (k + 1) * self._step,
                    "WARN",
                    f"{self.name}: nothing arrives for {seconds:.1f} s ({why(self._lost)})",
                )

    def _end(self, k: int) -> Iterator[Notice]:
        if self._told:
            seconds = (k - self._since) * self._step
            text = f"{self.name}: messages arrive again after {seconds:.1f} s ({why(self._lost)})"
            yield Notice(k * self._step, "INFO", text)
            self._reported += 1
            if self._reported > _FIRST + k * self._step / _OFTEN:
                self._long *= 1.5
        self._told = False
        self._lost[:] = 0


def why(counts: Counts) -> str:
    """How many messages were not delivered for which reasons, most frequent first, such as "300 cut, 12 lost"."""
    losses = [(int(counts[at]), WORDS[fate]) for at, fate in enumerate(OUTCOMES) if fate in WORDS and counts[at]]
    return ", ".join(f"{number:,} {word}" for number, word in sorted(losses, key=lambda loss: -loss[0]))


def level_of(line: str) -> str:
    """The level of an event's line: a warning if it makes anything worse."""
    return "INFO" if line.startswith("heal ") or line.endswith(" as before") else "WARN"


def introduction(plan: WirePlan) -> str:
    """The first line of the events."""
    return f"a wire of {counted(len(plan.sides), 'side')} and {counted(len(plan.links), 'link')}, seed {plan.seed}"
