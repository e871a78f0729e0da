"""A receiver with its link in memory: the work of a live run's router, receiver process and absence reporter.

Source: docs/results.md, summary.json.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np

from evedrop.model.receiver import Belief, Receiver, prior
from evedrop.model.slot.receiver import Absence, FollowedSlots, ReceiverCore
from evedrop.model.slot.transit import Arrivals
from evedrop.scenario.timeline import Away


@final
class LinkedReceiver:
    """A receiver that follows the slots from 0 on, and may be away in some of them."""

    def __init__(self, receiver: Receiver, window: int, outages: Sequence[Away]) -> None:
        self._receiver, self._window = receiver, window
        self._outages = {away.start: away for away in outages}
        self._away: Away | None = None
        self._absence: Absence
        self._core = ReceiverCore(receiver, window)

    @property
    def belief(self) -> Belief:
        """Its belief after the last slot in which it was present, or that it passed."""
        return self._core.belief

    def take_slots(self, slots: range, arrivals: Arrivals) -> FollowedSlots:
        """The beliefs after consecutive slots, at least one. The receiver is present in all of them, or away in all."""
        k = slots.start
        if k in self._outages:
            self._leave(self._outages[k])
        if self._away is not None and k < self._away.stop:
            if self._away.keeps_state:
                self._core.miss(slots)
            late = np.zeros((2, len(slots), self._receiver.trials), np.uint16) if self._window else None
            return FollowedSlots(self._absence.take_slots(slots), late)
        if self._away is not None and not self._away.keeps_state:
            self._core = ReceiverCore(self._receiver, self._window, k)
        self._away = None
        return self._core.take_slots(slots, arrivals)

    def _leave(self, away: Away) -> None:
        process, trials = self._receiver.process, self._receiver.trials
        left = self._core.belief if away.keeps_state else prior(process, trials, away.start)
        self._away, self._absence = away, Absence(process, left)
