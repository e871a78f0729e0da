"""Losses by a Markov chain: any finite one, such as netem's four states, a link with rush hours, a jammer with habits.

The link of Gilbert and Elliott loses in bursts: it alternates between a good and a bad state, and stays in each for a while.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from evedrop.model.checks import as_toml, is_probability, probability_mistakes
from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.links.chain import Chain
from evedrop.model.links.loss_model import LossModel, fates_of
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes, Flags


class GilbertElliott(LossModel):
    """Turns bad with probability p and good with r in each slot; loses with probability `good` or `bad` in each state.

    At slot 0 the state has its stationary distribution: bad with probability p/(p+r). With good = 0 and bad = 1 a burst's length
    is geometric with mean 1/r.

    Source: Gilbert (1960), Elliott (1963); docs/mathematics/links.md, losses in bursts.
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
        mistakes = probability_mistakes(given, "p", "r", "good", "bad")
        if not mistakes and given.get("p") == 0.0 and given.get("r") == 0.0:
            mistakes.append(("p", "and r are both 0, so the link stays in an unknown state; expected p or r above 0"))
        return mistakes

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
        """Good and bad; a single state if it never leaves that."""
        bad = self._stationary_bad
        transitions = np.array([[1.0 - self._p, self._p], [self._r, 1.0 - self._r]])
        return Chain.recurrent(transitions, np.array([1.0 - bad, bad]), np.array([1.0 - self._good, 1.0 - self._bad]))

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
            states[:, 0] = _two_in_turn(states[:, 0].tolist(), differs[:, 0].tolist())
        else:
            before = states[0]
            for after, differ in zip(states[1:], differs[1:], strict=True):
                np.bitwise_and(differ, before, out=differ)
                np.bitwise_xor(after, differ, out=after)
                before = after
        self._state = states[-1].copy()
        return states


def _two_in_turn(states: list[bool], differs: list[bool]) -> list[bool]:
    """The same loop for a single trial, for which numpy's calls would take ten times as long."""
    merged = states[:1]
    before = states[0]
    for after, differ in zip(states[1:], differs[1:], strict=True):
        before = after != (differ and before)
        merged.append(before)
    return merged


_SUM = 1e-9  # how far the sum of a row may be from 1
_MOST_STATES = 64
_FEW = 24  # up to this number of marks, comparing with each is quicker than searching


class Markov(LossModel):
    """A state for every slot, by `transitions` (row: from, column: to), and in each state a probability of `loss`.

    At slot 0 the state has the chain's stationary distribution.

    Source: docs/mathematics/links.md, losses in bursts.
    """

    parameters = MappingProxyType({"transitions": [[0.95, 0.05], [0.5, 0.5]], "loss": [0.0, 1.0]})
    uniforms_per_slot = 2

    def __init__(self, transitions: list[list[float]], loss: list[float]) -> None:
        matrix = self._transitions = np.array(transitions, np.float64)
        self._loss = np.array(loss, np.float64)
        self._stationary = stationary(matrix)
        self._opening = _bounds(self._stationary[None])[0]
        bounds = _bounds(matrix)
        self._marks = np.unique(bounds)
        # Row j: the next state of each state, for a u that is at least j of the marks.
        self._next = np.array([(u >= bounds).sum(axis=1) for u in (-1.0, *self._marks)], np.intp)
        self._state: NDArray[np.intp] | None = None  # in the slot before, (R,)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A square matrix of probabilities whose rows sum to 1, one recurrent class, and a loss for each state."""
        mistakes = []
        if "transitions" in given:
            mistakes = [("transitions", sentence) for sentence in _matrix_mistakes(given["transitions"])]
        if "loss" in given:
            loss, rows = given["loss"], given.get("transitions")
            right = isinstance(loss, list) and all(is_probability(value) for value in loss)
            if not right or (_square(rows) and len(loss) != len(rows)):
                count = f"{len(rows)} numbers" if _square(rows) else "numbers"
                mistakes.append(("loss", f"is {as_toml(loss)}; expected {count} from 0 to 1, one for each state"))
        return mistakes

    @property
    def quality(self) -> float:
        """One minus the mean loss under the stationary distribution."""
        return float(1.0 - self._stationary @ self._loss)

    @property
    def chain(self) -> Chain:
        """The given chain without its transient states."""
        return Chain.recurrent(self._transitions, self._stationary, 1.0 - self._loss)

    def fates(self, first: int, uniforms: Floats) -> Codes:  # noqa: ARG002 - the state says where we are
        """From the state of every slot and a second uniform number."""
        return fates_of(uniforms[:, 1, :] < self._loss[self._states(uniforms[:, 0, :])])

    def _states(self, u: Floats) -> NDArray[np.intp]:
        """The state of every slot, (slots, R): the place of u among the bounds of all states, then the next state for that place.

        The first step is done for all slots at once; the second is a table look-up for each slot.
        """
        places = _rank(self._marks, u)
        places *= len(self._loss)
        table = self._next.reshape(-1)
        if self._state is None:
            places[0] = (u[0] >= self._opening[:, None]).sum(axis=0)
        else:
            places[0] = table[places[0] + self._state]
        if places.shape[1] == 1:
            places[:, 0] = _in_turn(places[:, 0].tolist(), table.tolist())
        else:
            before = places[0]
            for place in places[1:]:
                np.add(place, before, out=place)
                place[:] = np.take(table, place, mode="clip")
                before = place
        self._state = places[-1].copy()
        return places


def _in_turn(places: list[int], table: list[int]) -> list[int]:
    """The same loop for a single trial, for which numpy's calls would take ten times as long."""
    sequence = places[:1]
    before = places[0]
    for place in places[1:]:
        before = table[place + before]
        sequence.append(before)
    return sequence


def _bounds(rows: Floats) -> Floats:
    """The upper ends of the ranges of uniform numbers for each next state but the last, (rows, states − 1).

    Sums of rows are rounded: the last state that can follow gets the remainder.
    """
    bounds: Floats = np.cumsum(rows, axis=1)
    last = rows.shape[1] - 1 - np.argmax(rows[:, ::-1] > 0.0, axis=1)
    bounds[np.arange(rows.shape[1]) >= last[:, None]] = 1.0
    return bounds[:, :-1]


def _rank(marks: Floats, u: Floats) -> NDArray[np.intp]:
    """The number of marks, in ascending order, that each u reaches; has the shape of u."""
    if len(marks) > _FEW:
        return np.searchsorted(marks, u.reshape(-1), side="right").reshape(u.shape)
    rank = np.zeros(u.shape, np.intp)
    for mark in marks:
        rank += u >= mark
    return rank


def _square(rows: Any) -> TypeGuard[list[list[Any]]]:
    return (
        isinstance(rows, list)
        and len(rows) > 0
        and all(isinstance(row, list) and len(row) == len(rows) for row in rows)
    )


def _matrix_mistakes(rows: Any) -> list[str]:
    if not isinstance(rows, list) or not rows or any(not isinstance(row, list) for row in rows):
        return ["is not a matrix; expected a list of rows"]
    if len(rows) > _MOST_STATES or not _square(rows):
        return [f"is not square, or has more than {_MOST_STATES} rows; expected one row a state"]
    mistakes = []
    for i, row in enumerate(rows):
        if not all(is_probability(value) for value in row):
            mistakes.append(f"row {i} is {as_toml(row)}; expected numbers from 0 to 1")
        elif abs(sum_in_order(row) - 1.0) > _SUM:
            mistakes.append(f"row {i} sums to {sum_in_order(row):.6g}; expected 1")
    if not mistakes and not _common(rows):
        mistakes.append("has several recurrent classes; expected a state that can be reached from all others")
    return mistakes


def _common(rows: list[list[float]]) -> bool:
    """Whether some state can be reached from all others, so that there is one recurrent class and one stationary distribution."""
    reaches = (np.array(rows) > 0.0) | np.eye(len(rows), dtype=np.bool_)
    for _ in range(len(rows).bit_length()):
        reaches = reaches @ reaches
    return bool(reaches.all(axis=0).any())


def stationary(transitions: Floats) -> Floats:
    """The distribution π with π T = π, (states,), of a chain with one recurrent class.

    States are eliminated one after the other without subtraction, so that nothing cancels and every machine computes the
    same bits. A state from which no earlier state can be reached is recurrent on its own.

    Source: Grassmann, Taksar, Heyman (1985).
    """
    rows = transitions.tolist()
    count = len(rows)
    kept = count
    while kept > 1:
        last = kept - 1
        leaves = sum_in_order(rows[last][:last])
        if leaves == 0.0:
            break
        for i in range(last):
            rows[i][last] /= leaves
            for j in range(last):
                rows[i][j] += rows[i][last] * rows[last][j]
        kept = last
    weights = [0.0] * count
    weights[kept - 1] = 1.0
    for state in range(kept, count):
        weights[state] = sum_in_order(weights[i] * rows[i][state] for i in range(state))
    total = sum_in_order(weights)
    return np.array([weight / total for weight in weights])
