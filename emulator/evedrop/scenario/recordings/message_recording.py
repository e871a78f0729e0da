"""A recording of messages: which of them were lost, by the numbers of those that arrived, and how long the others took.

A sender numbers its messages: a missing number is a lost message.

Source: docs/links.md, recordings of messages.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.errors import TraceError, UsageError
from evedrop.model.links.trace import MOST_OUTCOMES
from evedrop.model.process import Floats
from evedrop.scenario.recordings.link_recording import Outcomes

WRAP = 2**32
"""The numbers of MCAP messages, and of some senders, begin again at 0 after this many."""
_LATE = 64  # numbers by which a message may come late where nothing tells when it was sent
_AHEAD = 8  # messages that are looked at to tell a late message from a sender that was started again
_JUMP = 64  # numbers that a counter must leap before its time is looked at
_HASTE = 0.1  # of the time that this number of messages takes: a leap in less is not a loss


@dataclass(frozen=True)
class MessageArrivals:
    """The messages of one sender that arrived, in the order of their arrival."""

    numbers: NDArray[np.int64]
    """The sender's own numbers, (m,)."""
    heard: Floats
    """When each was heard, in seconds, (m,)."""
    sent: Floats | None = None
    """When each was sent, by the sender's clock, in seconds, (m,); None: not known."""


@final
@dataclass(frozen=True)
class MessageSeries:
    """The outcomes of consecutive messages, in one part or several; losses between two parts are not known."""

    outcomes: Outcomes
    """1 delivered, 0 lost, (n,), all parts one after the other."""
    parts: int = 1
    repeated: int = 0
    """Messages that arrived again."""
    late: int = 0
    """Messages that arrived after one that was sent later."""
    restarts: int = 0
    """Times at which the numbers went back: the sender was started again, or there are several."""
    leaps: int = 0
    """Times at which the numbers leapt ahead further than any loss could explain."""
    outages: tuple[float, ...] = ()
    """Seconds of each silence that was longer than allowed, and so is not counted as lost messages."""
    seconds: float | None = None
    """Median time between two consecutive messages; None if there are none."""
    first_arrivals: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))
    """Which of the arrivals are the first of their message, in the order of arrival, (m,)."""


COUNTS = ("parts", "repeated", "late", "restarts", "leaps")
"""The fields of a series that are counts, which add up."""


def joined(series: Sequence[MessageSeries]) -> MessageSeries:
    """Several series, one after the other."""
    times = [part.seconds for part in series if part.seconds is not None]
    return MessageSeries(
        np.concatenate([part.outcomes for part in series]),
        **{name: sum(getattr(part, name) for part in series) for name in COUNTS},
        outages=tuple(outage for part in series for outage in part.outages),
        seconds=float(np.median(times)) if times else None,
        first_arrivals=np.concatenate([part.first_arrivals for part in series]),
    )


def series_of(arrivals: MessageArrivals, longest: float | None = None, wrap: int | None = None) -> MessageSeries:
    """What became of the messages that a sender numbered one by one.

    longest: seconds of silence after which missing numbers count as an outage, not as losses; None: any number is a loss.
    wrap: the number that is 0 again, such as `WRAP`; None if the numbers never end.

    Raises ValueError for more than ten million outcomes.
    """
    return _SenderNumbers(arrivals, longest, wrap).series()


def numbers_of_times(times: Floats, period: float) -> tuple[NDArray[np.int64], float]:
    """Numbers for messages that are sent with a fixed period, from the times (m,) at which they were sent.

    Returns the numbers, and the fraction of messages that are more than a quarter of a period away from where they belong.
    """
    steps = np.diff(times) / period
    whole = np.rint(steps).astype(np.int64)
    off = float((np.abs(steps - np.maximum(1, whole)) > 0.25).mean()) if len(steps) else 0.0
    numbers, order = np.concatenate([[0], np.cumsum(whole)]), np.arange(len(times))
    # A message that comes as late as the next one has the number before that one's.
    numbers = np.minimum.accumulate((numbers - order)[::-1])[::-1] + order
    return numbers - numbers[0], off


class _SenderNumbers:
    """Reads the numbers of one sender once, and cuts them into parts where they are not consecutive."""

    def __init__(self, arrivals: MessageArrivals, longest: float | None, wrap: int | None) -> None:
        self._numbers: list[int] = arrivals.numbers.tolist()
        self._wrap = wrap
        self._heard: list[float] = arrivals.heard.tolist()
        self._sent: list[float] | None = None if arrivals.sent is None else arrivals.sent.tolist()
        self._times = self._heard if self._sent is None else self._sent
        self._longest = longest
        times = np.array(self._times)
        steps = np.diff(arrivals.numbers) if wrap is None else np.diff(arrivals.numbers) % wrap
        ones = np.diff(times)[steps == 1]
        self._seconds = float(np.median(ones)) if len(ones) else None
        self.late = self.repeated = self.restarts = self.leaps = 0
        self.outages: list[float] = []

    def series(self) -> MessageSeries:
        """The outcomes of all parts."""
        parts: list[list[int]] = [[0]]  # of each part, places counted from the first message, which may be late
        ends: list[float] = []  # of each part but the last, the last place; none where the numbers began again
        top, top_at, place = self._numbers[0], 0, 0
        kept, seen = [True], {0}
        for i in range(1, len(self._numbers)):
            step = self._step(top, self._numbers[i])
            if step > 0 or self._is_restart(step, top, top_at, i):
                if step <= 0:
                    self.restarts += 1
                    place, seen = 0, set()
                    ends.append(-math.inf)
                    parts.append([])
                else:
                    if self._breaks(step, top_at, i):
                        ends.append(place)
                        parts.append([])
                    place += step
                top, top_at = self._numbers[i], i
                parts[-1].append(place)
                seen.add(place)
                kept.append(True)
                continue
            late = place + step
            first = late not in seen
            self.late, self.repeated = self.late + first, self.repeated + (not first)
            if first:
                seen.add(late)
                part = len(ends)
                while part and late <= ends[part - 1]:  # sent before the numbers broke off
                    part -= 1
                parts[part].append(late)
            kept.append(first)
        return MessageSeries(
            np.concatenate(list(_outcomes(parts))),
            len(parts),
            self.repeated,
            self.late,
            self.restarts,
            self.leaps,
            tuple(self.outages),
            self._seconds,
            np.array(kept),
        )

    def _step(self, top: int, number: int) -> int:
        """By how much a number is ahead of another, or behind it if negative."""
        if self._wrap is None:
            return number - top
        return (number - top + self._wrap // 2) % self._wrap - self._wrap // 2

    def _breaks(self, step: int, top_at: int, i: int) -> bool:
        """Whether the numbers that were left out are not losses, and counts why."""
        time = self._times[i] - self._times[top_at]
        if self._longest is not None and step > 1 and time > self._longest:
            self.outages.append(time)
            return True
        leap = step > _JUMP and self._seconds is not None and time < _HASTE * step * self._seconds
        self.leaps += leap
        return leap

    def _is_restart(self, step: int, top: int, top_at: int, i: int) -> bool:
        """Whether a number that is not ahead of all before it belongs to a sender that counts from the beginning again."""
        if self._sent is not None:
            return self._sent[i] > self._sent[top_at]
        if -step > _LATE:
            return True
        following = self._numbers[i + 1 : i + 1 + _AHEAD]
        return bool(following) and max(self._step(top, number) for number in following) <= 0


def _outcomes(parts: Iterable[list[int]]) -> Iterable[Outcomes]:
    """The outcomes of each part, from the places of the messages that arrived."""
    left = MOST_OUTCOMES
    for places in parts:
        first, last = min(places), max(places)
        left -= last - first + 1
        if left < 0:
            raise ValueError(
                f"has more than {MOST_OUTCOMES} outcomes; expected at most that many, such as a part of it"
            )
        outcomes = np.zeros(last - first + 1, np.uint8)
        outcomes[np.array(places) - first] = 1
        yield outcomes


_SHORTEST_PART = 20


@final
@dataclass(frozen=True)
class MessageRecording:
    """The messages of a topic, or of a link of a wire."""

    name: str
    """The recording and the topic or link, for messages."""
    series: MessageSeries
    delays: Floats
    """Seconds, of each message that was delivered and whose delay is known, (d,)."""
    corrupt: float | None = None
    """The fraction of messages that were damaged among those that were not lost; None: nothing would show it."""
    dropped: int = 0
    """How many messages were neither lost nor damaged, but did not arrive for other reasons."""
    notes: tuple[str, ...] = ()
    """What was left out or assumed, in sentences."""
    source: str = "robot"
    """The side from which the messages came."""
    target: str = "base"
    keys: str = "**"
    """The key expression of the messages in a wire file."""


def check_parts(name: str, series: MessageSeries, why: str) -> None:
    """Raise TraceError if the messages are cut into parts too short to learn anything about bursts; why: what cuts them."""
    count = len(series.outcomes)
    if count < _SHORTEST_PART * series.parts and series.parts > 1:
        raise TraceError(
            name,
            "file",
            f"its {count} outcomes are in {series.parts} parts, {count / series.parts:.3g} outcomes long on average: {why}; "
            f"expected parts of {_SHORTEST_PART} or more",
        )


def save_outcomes(recording: MessageRecording, path: Path) -> None:
    """Write the outcomes as a CSV file that the loss model `trace` can read. Raises UsageError if it cannot be written."""
    lines = ["received", *map(str, recording.series.outcomes.tolist())]
    try:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"--save {path} cannot be written ({error.strerror}); give another file") from error
