"""Chooses the moments of a run that deserve a line. Does not use Rerun.

Frequent events are visible in the lanes; a line reports a stretch without usable packets that is long for this receiver.
The threshold adapts, so that a run of any length gets at most a few hundred lines per receiver.
"""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

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
    trials = "" if scene.trials == 1 else f"; curves: mean of {scene.trials} trials"
    about = [Event(0, "INFO", f"{scene.title}{trials}")]
    for shown in scene.receivers:
        kind = "scheme" if shown.role == "legitimate" else "strategy"
        quality = "with a loss model that is not built in" if shown.quality is None else f"quality {shown.quality:.4g}"
        about.append(Event(0, "INFO", f"{shown.name}: {kind} {shown.strategy}, link {quality}"))
    return about


@final
class Watcher:
    """Finds the events of one receiver in its lane's codes, chunk by chunk.

    A good slot tells the receiver as much as the state: for the legitimate estimator any packet, for an eavesdropper a state
    that it used as such. A stretch without a good slot is reported when it has become long, and when it ends.
    """

    def __init__(self, shown: Shown, scene: Scene) -> None:
        self._name = shown.name
        other = scheme_of(scene).sent_words[-1]
        self._other = f"an {other}" if other == INNOVATION else other
        self._legitimate = shown.role == "legitimate"
        self._spacing = max(_SLOTS_PER_LINE, scene.slots // _LINES)
        self._long = _SHORTEST
        self._reported = 0
        self._bad = 0  # length so far of the stretch that the next chunk may continue
        self._misled = 0  # how many of these slots misled the receiver
        self._silent = 0  # how many of them had no packet
        self._told = False  # whether this stretch was reported
        self._ever_misled = False

    def watch(self, first: int, codes: Codes) -> list[Event]:
        """Events of the chunk that starts at slot `first`, in order of slot."""
        misled, silent = codes == MISLED_CODE, codes == SILENT_CODE
        good = (codes == Action.STATE) | (codes == Action.INNOVATION)
        events: list[Event] = []
        if not self._ever_misled and misled.any():
            self._ever_misled = True
            k = first + int(misled.argmax())
            events.append(Event(k, "WARN", f"{self._name} took {self._other} for the state, for the first time"))
        places = np.flatnonzero(good)
        starts, ends = np.concatenate([[0], places + 1]), np.append(places, len(codes))
        looked_at = (
            ends - starts >= self._long
        )  # a shorter stretch that also begins and ends in the chunk changes nothing
        looked_at[[0, -1]] = True
        before = _numbers_before(misled), _numbers_before(silent)
        for start, end in zip(starts[looked_at].tolist(), ends[looked_at].tolist(), strict=True):
            if end > start:
                self._extend(first, start, end, before, events)
            if end < len(codes):
                self._recover(first + end, events)
        return sorted(events, key=lambda event: event.k)

    def _extend(
        self, first: int, start: int, end: int, before: tuple[NDArray[np.int64], NDArray[np.int64]], events: list[Event]
    ) -> None:
        """Extend the current stretch by some slots of the chunk; before: how many slots before each are misled, and silent."""
        misled, silent = before
        length = self._bad + end - start
        if not self._told and length >= self._long:
            turn = start + self._long - self._bad  # the slot after the one that made it long
            deceived = self._misled + int(misled[turn] - misled[start])
            unsent = self._silent + int(silent[turn] - silent[start])
            events.append(Event(first + turn - 1, "WARN", self._lost(deceived, unsent)))
            self._told = True
        self._bad = length
        self._misled += int(misled[end] - misled[start])
        self._silent += int(silent[end] - silent[start])

    def _recover(self, k: int, events: list[Event]) -> None:
        if self._told:
            events.append(Event(k, "INFO", f"{self._name} regained synchronisation after {self._bad} slots"))
            self._told = False
            self._reported += 1
            if self._reported > 3 + k // self._spacing:
                self._long += 1
        self._bad = self._misled = self._silent = 0

    def _lost(self, deceived: int, unsent: int) -> str:
        if self._legitimate and not unsent:
            return f"{self._name} lost {self._long} packets in a row"
        line = f"{self._name} lost synchronisation: {self._long} slots without a state"
        if self._legitimate:
            line = f"{self._name} had no packet for {self._long} slots"
        line = f"{line}, {unsent} of them silent" if unsent else line
        return f"{line}, {deceived} misled" if deceived else line


@final
class AckWatcher:
    """Finds the first act of each kind on acknowledgements, and long stretches in which none reached the sensor.

    As for `Watcher`, a stretch is reported when it has become long, and when it ends.
    """

    def __init__(self, scene: Scene) -> None:
        self._new = dict(Attacks(scene).possible)
        self._spacing = max(_SLOTS_PER_LINE, scene.slots // _LINES)
        self._long, self._reported = _SHORTEST, 0
        self._missing, self._acted = 0, 0  # slots of the stretch so far, and how many acts were among them

    def watch(self, first: int, fates: Codes) -> list[Event]:
        """Events of the chunk that starts at slot `first`, in order of slot; fates: `AckFate`, (c,)."""
        events: list[Event] = []
        for k, fate in enumerate(fates.tolist(), first):
            if fate in self._new:
                events.append(
                    Event(k, "WARN", f"an acknowledgement was {self._new.pop(AckFate(fate))}, for the first time")
                )
            if fate in _REACHED:
                self._end(k, events)
                continue
            self._missing += 1
            self._acted += fate in (AckFate.BLOCKED, AckFate.IGNORED)
            if self._missing == self._long:
                attacked = f", {self._acted} by the attack" if self._acted else ""
                events.append(
                    Event(k, "WARN", f"the sensor got no acknowledgement for {self._missing} slots{attacked}")
                )
        return events

    def _end(self, k: int, events: list[Event]) -> None:
        if self._missing >= self._long:
            events.append(Event(k, "INFO", f"the sensor got an acknowledgement again after {self._missing} slots"))
            self._reported += 1
            if self._reported > 3 + k // self._spacing:
                self._long += 1
        self._missing = self._acted = 0


_REACHED = frozenset({AckFate.ARRIVED, AckFate.FORGED})


def _numbers_before(flags: Flags) -> NDArray[np.int64]:
    """How many flags before each are set, and how many in all, (c + 1,)."""
    return np.concatenate([[0], np.cumsum(flags)])
