"""Chooses the moments of a wire that deserve a line: long stretches in which nothing arrives, and losses of the wire's own.

Source: docs/wire.md, the view.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, final

import numpy as np

from evedrop.wire.plan import WireLink, WirePlan
from evedrop.wire.record import WireFate
from evedrop.wire.step_counts import CUT, DELIVERED, OUTCOMES, UNDERWAY, Counts, WireSteps

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
class LinkWatcher:
    """Finds the notices of all links, block of steps by block. names: of the links; step: seconds."""

    def __init__(self, names: Iterable[str], step: float) -> None:
        self._step = step
        self._stretches = [_Stretch(name, step) for name in names]
        self._names = [*(one.name for one in self._stretches), "keys without a link"]
        self._known: set[tuple[int, int]] = set()

    def watch(self, steps: WireSteps) -> list[Notice]:
        """The notices of the next steps, in order of time."""
        found = [*self._own_losses(steps)]
        for row, stretch in enumerate(self._stretches):
            found += stretch.watch(steps.first, steps.counts[:, row])
        return sorted(found, key=lambda notice: notice.seconds)

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
        found = []
        for links in pairs.values():
            first = self._links[links[0]]
            if len(links) > 1 and all(self._cut[at] for at in links):
                found.append(f"{first.source}|{first.target}")
            else:
                found += [self._links[at].name for at in links if self._cut[at]]
        return found


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
    found = [(int(counts[at]), WORDS[fate]) for at, fate in enumerate(OUTCOMES) if fate in WORDS and counts[at]]
    return ", ".join(f"{number:,} {word}" for number, word in sorted(found, key=lambda one: -one[0]))


def level_of(line: str) -> str:
    """The level of an event's line: a warning if it makes anything worse."""
    return "INFO" if line.startswith("heal ") or line.endswith(" as before") else "WARN"


def introduction(plan: WirePlan) -> str:
    """The first line of the events."""
    return f"a wire of {len(plan.sides)} sides and {len(plan.links)} links, seed {plan.seed}"
