"""A receiver with its link in memory: the work of a live run's router, receiver process and stand-in.

Source: docs/results.md, summary.json.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Receiver, prior
from evedrop.model.slot.intermittent_receiver import Absence, Follower
from evedrop.model.slot.link import Fates
from evedrop.model.slot.transit import Transit
from evedrop.scenario.timeline import Away


@final
class IntermittentReceiver:
    """A receiver that follows the slots from 0 on, and may be away in some of them."""

    def __init__(self, receiver: Receiver, window: int, outages: Sequence[Away]) -> None:
        self._receiver, self._window = receiver, window
        self._outages = {away.start: away for away in outages}
        self._away: Away | None = None
        self._absence: Absence
        self._transit = Transit()
        self._follower = Follower(receiver, window)

    @property
    def late(self) -> NDArray[np.uint16]:
        """How many packets of earlier slots arrived in the last slot, (R,)."""
        # An absent receiver takes none; the follower still has the counts of the last slot in which it was present.
        return self._follower.late if self._away is None else np.zeros_like(self._follower.late)

    @property
    def late_used(self) -> NDArray[np.uint16]:
        """How many of the late packets were used, (R,)."""
        return self._follower.late_used if self._away is None else np.zeros_like(self._follower.late_used)

    def take(
        self,
        k: int,
        fates: Fates,
        row: int,
        z: Floats,
        header: NDArray[np.int64] | None = None,
        truth: Floats | None = None,
    ) -> Belief:
        """The belief after slot k, whose packets have the fates of one row; truth as in `Heard`."""
        arrival = self._transit.arrival(k, fates, row, z, header)
        if k in self._outages:
            self._leave(self._outages[k])
        if self._away is not None and k < self._away.stop:
            if self._away.keeps_state:
                self._follower.miss(range(k, k + 1))
            return self._absence.next(k)
        if self._away is not None and not self._away.keeps_state:
            self._follower = Follower(self._receiver, self._window, k)
        self._away = None
        if truth is not None:
            arrival = arrival._replace(heard=arrival.heard._replace(truth=truth))
        return self._follower.take(k, arrival)

    def _leave(self, away: Away) -> None:
        process, trials = self._receiver.process, self._receiver.trials
        left = self._follower.belief if away.keeps_state else prior(process, trials, away.start)
        self._away, self._absence = away, Absence(process, left)
