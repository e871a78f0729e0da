"""Chooses the moments of a run that deserve a line. Does not use Rerun.

Frequent events are visible in the lanes; a line reports a stretch without usable packets that is long for this receiver.
The threshold adapts, so that a run of any length gets at most a few hundred lines per receiver.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import NamedTuple, final

import numpy as np

from evedrop.counting import counted
from evedrop.model.acknowledgements import AckFate
from evedrop.model.receiver import INNOVATION, Action, Codes, Flags
from evedrop.show.view.attacks import Attacks
from evedrop.show.view.lanes import MISLED_CODE, SILENT_CODE, scheme_of
from evedrop.show.view.scene import Scene, Shown

_SHORTEST = 3  # packets in a row; missing fewer is normal
_LINES = 200  # the approximate number of stretches that a receiver may report in a whole run
_SLOTS_PER_LINE = 100  # at least, so that the lines of a run in real time can be read


class Event(NamedTuple):
    """A line of the events panel."""

    k: int
    level: str
    """INFO, WARN or ERROR."""
    text: str


def introduction(scene: Scene) -> list[Event]:
    """The first lines: the title of the run, and its receivers."""
    trials = "" if scene.trials == 1 else f"; curves of errors and tr P: means of {scene.trials:,} trials"
    about = [Event(0, "INFO", f"{scene.title}{trials}")]
    for shown in scene.receivers:
        kind = "scheme" if shown.role == "legitimate" else "strategy"
        quality = "with a loss model that is not built in" if shown.quality is None else f"quality {shown.quality:.4g}"
        about.append(Event(0, "INFO", f"{shown.name}: {kind} {shown.strategy}, link {quality}"))
    return about


class _StretchWatcher(ABC):
    """Finds stretches without a good slot, chunk by chunk: one is reported when it has become long, and when it ends."""

    def __init__(self, scene: Scene, counted: int) -> None:
        """counted: the number of flags of slots that are counted in a stretch."""
        self._spacing = max(_SLOTS_PER_LINE, scene.slots // _LINES)
        self._long, self._reported = _SHORTEST, 0
        # The length so far of the stretch that the next chunk may continue, and how many of its slots have each flag.
        self._bad, self._counts = 0, np.zeros(counted, np.int64)

    @abstractmethod
    def _lost(self, *counts: int) -> str:
        """The line about a stretch that has become long; counts: how many of its slots have each flag."""

    @abstractmethod
    def _regained(self) -> str:
        """The line about the end of a stretch that was long."""

    def _stretches(self, first: int, good: Flags, *flags: Flags) -> Iterator[Event]:
        """The lines about the stretches of the chunk that starts at slot `first`; good, flags: (c,) each."""
        places = np.flatnonzero(good)
        starts, ends = np.concatenate([[0], places + 1]), np.append(places, len(good))
        # A shorter stretch that also begins and ends in the chunk changes nothing.
        looked_at = ends - starts >= self._long
        looked_at[[0, -1]] = True
        before = np.stack([np.concatenate([[0], np.cumsum(each)]) for each in flags])
        for start, end in zip(starts[looked_at].tolist(), ends[looked_at].tolist(), strict=True):
            length = self._bad + end - start
            if self._bad < self._long <= length:
                turn = start + self._long - self._bad  # the slot after the one that made it long
                counts = self._counts + before[:, turn] - before[:, start]
                yield Event(first + turn - 1, "WARN", self._lost(*counts.tolist()))
            self._bad, self._counts = length, self._counts + before[:, end] - before[:, start]
            if end < len(good):
                yield from self._end(first + end)

    def _end(self, k: int) -> Iterator[Event]:
        if self._bad >= self._long:
            yield Event(k, "INFO", self._regained())
            self._reported += 1
            if self._reported > 3 + k // self._spacing:
                self._long += 1
        self._bad, self._counts = 0, np.zeros_like(self._counts)


@final
class Watcher(_StretchWatcher):
    """Finds the events of one receiver in its lane's codes.

    A good slot tells the receiver as much as the state: for the legitimate estimator any packet, for an eavesdropper a state
    that it used as such.
    """

    def __init__(self, shown: Shown, scene: Scene) -> None:
        super().__init__(scene, 2)
        self._name = shown.name
        other = scheme_of(scene).sent_words[-1]
        self._other = f"an {other}" if other == INNOVATION else other
        self._legitimate = shown.role == "legitimate"
        self._ever_misled = False

    def watch(self, first: int, codes: Codes) -> list[Event]:
        """Events of the chunk that starts at slot `first`, in order of slot."""
        misled = codes == MISLED_CODE
        events: list[Event] = []
        if not self._ever_misled and misled.any():
            self._ever_misled = True
            k = first + int(misled.argmax())
            events.append(Event(k, "WARN", f"{self._name} took {self._other} for the state, for the first time"))
        good = (codes == Action.STATE) | (codes == Action.INNOVATION)
        events += self._stretches(first, good, misled, codes == SILENT_CODE)
        return sorted(events, key=lambda event: event.k)

    def _lost(self, *counts: int) -> str:
        deceived, unsent = counts
        if self._legitimate and not unsent:
            return f"{self._name} lost {counted(self._long, 'packet')} in a row"
        line = f"{self._name} lost synchronisation: {counted(self._long, 'slot')} without a state"
        if self._legitimate:
            line = f"{self._name} had no packet for {counted(self._long, 'slot')}"
        line = f"{line}, {unsent} of them silent" if unsent else line
        return f"{line}, {deceived} misled" if deceived else line

    def _regained(self) -> str:
        return f"{self._name} regained synchronisation after {counted(self._bad, 'slot')}"


@final
class AckWatcher(_StretchWatcher):
    """Finds the first act of each kind on acknowledgements, and long stretches in which none reached the sensor."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, 1)
        self._new = dict(Attacks(scene).possible)

    def watch(self, first: int, fates: Codes) -> list[Event]:
        """Events of the chunk that starts at slot `first`, in order of slot; fates: `AckFate`, (c,)."""
        events: list[Event] = []
        for act, words in [*self._new.items()]:
            if len(at := np.flatnonzero(fates == act)):
                del self._new[act]
                events.append(Event(first + int(at[0]), "WARN", f"an acknowledgement was {words}, for the first time"))
        reached, attacked = np.isin(fates, (AckFate.ARRIVED, AckFate.FORGED)), (AckFate.BLOCKED, AckFate.IGNORED)
        events += self._stretches(first, reached, np.isin(fates, attacked))
        return sorted(events, key=lambda event: event.k)

    def _lost(self, *counts: int) -> str:
        attacked = f", {counts[0]} by the attack" if counts[0] else ""
        return f"the sensor got no acknowledgement for {counted(self._long, 'slot')}{attacked}"

    def _regained(self) -> str:
        return f"the sensor got an acknowledgement again after {counted(self._bad, 'slot')}"
