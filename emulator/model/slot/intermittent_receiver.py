"""A receiver that follows the slots as they come, with late packets: it repeats its recursion from where they belong.

A packet of slot j that arrives in slot k > j still fixes x_j, or gives w_{j−1}: because the window's packets and the belief
before them are kept, the belief after slot k is the same as if the packet had been in time.

Source: docs/mathematics.md, late packets.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import final

import numpy as np

from evedrop.model import update
from evedrop.model.process import Process
from evedrop.model.receiver import Action, Belief, Flags, Receiver, Reception
from evedrop.model.slot.transit import Arrival, Late


@dataclass
class _Slot:
    """One of the window's slots, with everything that has arrived of it."""

    k: int
    heard: Reception
    before: Belief
    news: Flags
    """Trials whose packet has just arrived."""


@final
class Follower:
    """A receiver with its belief.

    first: the first slot; window: slots by which a packet may be late and still be used.
    """

    def __init__(self, receiver: Receiver, window: int = 0, first: int = 0) -> None:
        self._receiver = receiver
        self._history: deque[_Slot] = deque(maxlen=window)
        self.belief = receiver.prior(first)
        self.late = np.zeros(receiver.trials, np.uint16)
        """Packets of earlier slots that arrived in the last slot and were not known before, in each trial."""
        self.late_used = np.zeros(receiver.trials, np.uint16)
        """The packets among them that were used, and not discarded."""

    def take(self, k: int, arrival: Arrival) -> Belief:
        """The belief after slot k."""
        changed = k
        self.late, self.late_used = (np.zeros(self._receiver.trials, np.uint16) for _ in range(2))
        for late in arrival.late:
            if late.k < k and self._merge(late):
                changed = min(changed, late.k)
        if changed < k:
            self._again(changed)
        if self._history.maxlen:
            self._history.append(_Slot(k, arrival.heard, self.belief, np.zeros_like(arrival.heard.gamma)))
        self.belief = self._receiver.step(k, self.belief, arrival.heard)
        return self.belief

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
        self.late += new
        z = np.where(new, late.heard.z, slot.heard.z)
        header = slot.heard.header
        if late.heard.header is not None:
            header = late.heard.header if header is None else np.where(new, late.heard.header, header)
        slot.heard = Reception(slot.heard.gamma | new, z, header, slot.heard.truth)
        slot.news = slot.news | new
        return True

    def _again(self, first: int) -> None:
        """Compute the beliefs from slot `first` of the window again."""
        belief: Belief | None = None
        for slot in self._history:
            if slot.k < first:
                continue
            if belief is not None:
                slot.before = belief
            belief = self._receiver.step(slot.k, slot.before, slot.heard)
            self.late_used += slot.news & (belief.action != Action.DISCARDED)
            slot.news = np.zeros_like(slot.news)
        if belief is not None:
            self.belief = belief


@final
class Absence:
    """The estimate of a receiver that is away: it is predicted from slot to slot.

    A receiver that is away believes nothing; these are its beliefs for these slots once it is back.
    """

    def __init__(self, process: Process, belief: Belief) -> None:
        self._process = process
        self._x_hat, self._P = belief.x_hat, belief.P
        self._lost = np.full(belief.x_hat.shape[1], Action.LOST, np.uint8)

    def next(self, k: int) -> Belief:
        """The belief after slot k, in which nothing was received."""
        self._x_hat = update.estimate(self._process, k, self._x_hat, self._lost, self._x_hat)
        self._P = update.believed_covariance(self._process, k, self._P, self._lost)
        return Belief(self._x_hat, self._P, self._lost)
