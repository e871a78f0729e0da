"""Losses in bursts: a link that alternates between a good and a bad state, and stays in each for a while."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model.checks import probability_mistakes
from evedrop.model.links.link import Chain, LossModel, fates_of
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes, Flags


class GilbertElliott(LossModel):
    """Turns bad with probability p and good with r in each slot; loses with probability `good` or `bad` in each state.

    At slot 0 the state has its stationary distribution: bad with probability p/(p+r). With good = 0 and bad = 1 a burst's length
    is geometric with mean 1/r.

    Source: Gilbert (1960), Elliott (1963); docs/mathematics.md, losses in bursts.
    """

    parameters = MappingProxyType({"p": 0.05, "r": 0.5, "good": 0.0, "bad": 1.0})
    optional = frozenset({"good", "bad"})
    uniforms_per_slot = 2

    def __init__(self, p: float, r: float, good: float = 0.0, bad: float = 1.0) -> None:
        self._p, self._r, self._good, self._bad = p, r, good, bad
        self._state: Flags | None = None  # bad or not, (R,), in the slot before

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """All are probabilities, and p and r are not both 0."""
        found = probability_mistakes(given, "p", "r", "good", "bad")
        if not found and given.get("p") == 0.0 and given.get("r") == 0.0:
            found.append(("p", "and r are both 0, so the link stays in an unknown state; expected p or r above 0"))
        return found

    @property
    def _stationary_bad(self) -> float:
        return self._p / (self._p + self._r)

    @property
    def quality(self) -> float:
        """(1 − good) r/(p+r) + (1 − bad) p/(p+r)."""
        bad = self._stationary_bad
        return (1.0 - self._good) * (1.0 - bad) + (1.0 - self._bad) * bad

    @property
    def chain(self) -> Chain:
        """Good and bad."""
        bad = self._stationary_bad
        transitions = np.array([[1.0 - self._p, self._p], [self._r, 1.0 - self._r]])
        return Chain(transitions, np.array([1.0 - bad, bad]), np.array([1.0 - self._good, 1.0 - self._bad]))

    def fates(self, first: int, uniforms: Floats) -> Codes:  # noqa: ARG002 - the state says where we are
        """From the state of every slot and a second uniform number."""
        bad, v = self._states(uniforms[:, 0, :]), uniforms[:, 1, :]
        in_good, in_bad = v < self._good, v < self._bad
        return fates_of(in_good ^ (bad & (in_good ^ in_bad)))

    def _states(self, u: Floats) -> Flags:
        """Bad or not, (slots, R): a u below p turns good into bad, a u below r turns bad into good.

        Slot by slot with two boolean operations: the state after good, and whether the state after bad differs from it.
        """
        states = u < self._p
        differs = states ^ (u >= self._r)
        if self._state is None:
            states[0] = u[0] < self._stationary_bad
        else:
            states[0] ^= self._state & differs[0]
        if states.shape[1] == 1:
            states[:, 0] = _in_turn(states[:, 0].tolist(), differs[:, 0].tolist())
        else:
            before = states[0]
            for after, differ in zip(states[1:], differs[1:], strict=True):
                np.bitwise_and(differ, before, out=differ)
                np.bitwise_xor(after, differ, out=after)
                before = after
        self._state = states[-1].copy()
        return states


def _in_turn(states: list[bool], differs: list[bool]) -> list[bool]:
    """The same loop for a single trial, for which numpy's calls would take ten times as long."""
    found = states[:1]
    before = states[0]
    for after, differ in zip(states[1:], differs[1:], strict=True):
        before = after != (differ and before)
        found.append(before)
    return found
