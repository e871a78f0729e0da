"""A receiver from slot to slot. After late packets it repeats its recursion from their slots on.

A packet of slot j that arrives in slot k > j still fixes x_j, or gives w_{j−1}: because the window's packets and the belief
before them are kept, the belief after slot k is the same as if the packet had been in time.

Source: docs/mathematics.md, late packets.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model import update
from evedrop.model.process import Process
from evedrop.model.receiver import Action, Belief, Beliefs, Flags, Receiver, Reception
from evedrop.model.slot.link_core import Arrival, Arrivals, Late


@dataclass
class _Slot:
    """One of the window's slots, with everything that has arrived of it."""

    k: int
    heard: Reception
    before: Belief
    fresh: Flags
    """Trials whose packet has just arrived."""


class FollowedSlots(NamedTuple):
    """A receiver after c consecutive slots."""

    beliefs: Beliefs
    late: NDArray[np.uint16] | None
    """How many packets of earlier slots arrived that were not known before, and how many of them were used and not discarded,
    (2, c, R); None for a receiver without a window."""

    @classmethod
    def joined(cls, parts: Sequence[FollowedSlots]) -> FollowedSlots:
        """Consecutive slots, at least one, as one."""
        beliefs = Beliefs.joined([part.beliefs for part in parts])
        late = [part.late for part in parts if part.late is not None]
        return cls(beliefs, np.concatenate(late, axis=1) if late else None)


@final
class ReceiverCore:
    """A receiver with its belief, which takes the arrivals of many slots at once, or of one.

    first: the first slot; window: slots by which a packet may be late and still be used.
    """

    def __init__(self, receiver: Receiver, window: int = 0, first: int = 0) -> None:
        self._receiver = receiver
        self._history: deque[_Slot] = deque(maxlen=window)
        self.belief = receiver.prior(first)
        self._late = np.zeros((2, receiver.trials), np.uint16)

    def take_slots(self, slots: range, arrivals: Arrivals) -> FollowedSlots:
        """The beliefs after consecutive slots, at least one."""
        if arrivals.plain and not self._history.maxlen:
            beliefs, self.belief = self._receiver.follow(slots, self.belief, arrivals.gamma, arrivals.z)
            return FollowedSlots(beliefs, None)
        beliefs = Beliefs.empty(arrivals.z.shape)
        late = np.zeros((2, len(slots), self._receiver.trials), np.uint16) if self._history.maxlen else None
        for row, k in enumerate(slots):
            self._step(k, arrivals.at(row))
            beliefs.put(row, self.belief)
            if late is not None:
                late[:, row] = self._late
        return FollowedSlots(beliefs, late)

    def _step(self, k: int, arrival: Arrival) -> None:
        changed = k
        self._late[:] = 0
        for late in arrival.late:
            if late.k < k and self._merge(late):
                changed = min(changed, late.k)
        if changed < k:
            self._again(changed)
        if self._history.maxlen:
            self._history.append(_Slot(k, arrival.heard, self.belief, np.zeros_like(arrival.heard.gamma)))
        self.belief = self._receiver.step(k, self.belief, arrival.heard)

    def miss(self, slots: range) -> None:
        """Pass slots in which nothing was received because the receiver was away; the window is cleared."""
        trials = self.belief.x_hat.shape[1]
        nothing = Reception(np.zeros(trials, np.bool_), np.zeros_like(self.belief.x_hat))
        for k in slots:
            self.belief = self._receiver.step(k, self.belief, nothing)
        self._history.clear()

    def _merge(self, late: Late) -> bool:
        """Store late packets in their slots; returns whether any of them is new. A second copy is not."""
        slot = next((slot for slot in self._history if slot.k == late.k), None)
        if slot is None:
            return False
        new = late.heard.gamma & ~slot.heard.gamma
        if not new.any():
            return False
        self._late[0] += new
        z = np.where(new, late.heard.z, slot.heard.z)
        header = slot.heard.header
        if late.heard.header is not None:
            header = late.heard.header if header is None else np.where(new, late.heard.header, header)
        slot.heard = Reception(slot.heard.gamma | new, z, header, slot.heard.truth)
        slot.fresh = slot.fresh | new
        return True

    def _again(self, first: int) -> None:
        """Compute the beliefs from slot `first` of the window again."""
        slots = [slot for slot in self._history if slot.k >= first]
        belief = slots[0].before
        for slot in slots:
            slot.before = belief
            belief = self._receiver.step(slot.k, belief, slot.heard)
            self._late[1] += slot.fresh & (belief.action != Action.DISCARDED)
            slot.fresh = np.zeros_like(slot.fresh)
        self.belief = belief


@final
class Absence:
    """The estimate of a receiver that is away: it is predicted from slot to slot.

    A receiver that is away believes nothing; these are its beliefs for these slots once it is back.
    """

    def __init__(self, process: Process, belief: Belief) -> None:
        self._process, self._belief = process, belief

    def take_slots(self, slots: range) -> Beliefs:
        """The beliefs after consecutive slots, at least one, in which nothing was received."""
        n, trials = self._belief.x_hat.shape
        nothing = np.zeros((len(slots), trials), np.uint8)
        beliefs = update.beliefs(self._process, slots.start, self._belief, nothing, np.zeros((len(slots), n, trials)))
        self._belief = beliefs.last
        return beliefs
