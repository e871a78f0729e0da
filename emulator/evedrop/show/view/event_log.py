"""The events so far as a document with a version for each moment that has events: Rerun's log of texts shows later ones, too."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple, final

_KEPT = 1000  # lines: an event may be noticed after later ones, but not after so many
_MOST_LINES = 16  # more than fit into the panel of a window of 1080 pixels


class LogLine(NamedTuple):
    """An event at a moment: a slot, or seconds."""

    at: float
    when: str
    """The moment in words."""
    level: str
    """INFO, WARN or ERROR."""
    text: str

    def __str__(self) -> str:
        """Such as "#1848   WARN   smart lost 3 packets in a row"; information has no level."""
        level = "" if self.level == "INFO" else f"{self.level}   "
        return f"{self.when}   {level}{self.text}"


@final
class EventLog:
    """The last events up to each moment, the newest first."""

    def __init__(self) -> None:
        self._lines: list[LogLine] = []  # in order of time

    def add(self, lines: Sequence[LogLine]) -> tuple[list[float], list[str]]:
        """Add events; returns the moments at which the document changes, and its text from each of them on.

        Those are the moments of the new events, and of known ones that follow them.
        """
        if not lines:
            return [], []
        self._lines = sorted([*self._lines[-_KEPT:], *lines], key=lambda line: line.at)
        moments = [line.at for line in self._lines]
        changed = range(bisect_left(moments, min(line.at for line in lines)), len(moments))
        ends = [i + 1 for i in changed if i + 1 == len(moments) or moments[i + 1] > moments[i]]
        before = max(0, changed[0] + 1 - _MOST_LINES)
        words = [str(line) for line in self._lines[before:]]
        texts = ["\n".join(reversed(words[max(0, end - before - _MOST_LINES) : end - before])) for end in ends]
        return [moments[end - 1] for end in ends], texts
