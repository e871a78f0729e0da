"""A hidden chain with two states and two outcomes, fitted by Baum and Welch's expectation-maximisation.

The recording is cut into chunks, and each step of the recursion is computed for all of them at once: first the effect of each
chunk on any state before it, then from chunk to chunk, then inside the chunks.

Source: Baum, Petrie, Soules, Weiss (1970); Rabiner (1989) for the scaling; docs/mathematics/links.md, estimating a link.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.model.receiver import Flags
from evedrop.scenario.recordings.link_recording import Outcomes

_SCOUTED = 50_000  # outcomes on which starting points are compared
_SCOUTING, _MOST = 40, 400  # steps
_ENOUGH = 0.002  # remaining gain in log-likelihood at which to stop
_NOTHING = 2e-5  # gain in log-likelihood of a step that counts as none
_IN_A_ROW = 4  # such steps before stopping: while a fast gain gives way to a slow one, the estimate is too small
_LEAST = 1e-9
_RESCALED = 8  # steps between rescalings of a product of probabilities


@dataclass(frozen=True)
class TwoStates:
    """The parameters of a Gilbert–Elliott link."""

    p: float
    r: float
    good: float
    bad: float

    @property
    def in_bad(self) -> float:
        """Stationary probability of the bad state."""
        return self.p / (self.p + self.r)

    @property
    def transitions(self) -> Floats:
        """From good and bad to good and bad, (2, 2)."""
        return np.array([[1.0 - self.p, self.p], [self.r, 1.0 - self.r]])

    @property
    def loss(self) -> Floats:
        """Probability of a loss in good and bad, (2,)."""
        return np.array([self.good, self.bad])

    def ordered(self) -> TwoStates:
        """The same model with the states named such that bad loses more."""
        return self if self.good <= self.bad else TwoStates(self.r, self.p, self.bad, self.good)

    def log_likelihood_of_states(self, bad: Flags) -> float:
        """The log-likelihood of a recording that shows the states themselves, (packets,)."""
        start = np.array([1.0 - self.in_bad, self.in_bad])
        at = bad.astype(np.intp)
        counts = np.bincount(2 * at[:-1] + at[1:], minlength=4).reshape(2, 2)
        seen = counts > 0
        return float((counts[seen] * np.log(self.transitions[seen])).sum() + np.log(start[at[0]]))


def most_likely(outcomes: Outcomes, starts: Iterable[TwoStates]) -> tuple[TwoStates, float]:
    """The best of the local maxima that expectation-maximisation reaches, and its log-likelihood.

    All starting points take some steps on the first part of the recording; the best two continue to the end on all of it.
    """
    some = ChunkedOutcomes(outcomes[:_SCOUTED])
    scouted = sorted((_climb(some, start, _SCOUTING) for start in starts), key=lambda climbed: -climbed[1])
    whole = ChunkedOutcomes(outcomes)
    model, likelihood = max((_climb(whole, start, _MOST) for start, _ in scouted[:2]), key=lambda climbed: climbed[1])
    return model.ordered(), likelihood


def log_likelihood(outcomes: Outcomes, model: TwoStates) -> float:
    """The log-likelihood of a recording under a model that starts in its stationary distribution."""
    return ChunkedOutcomes(outcomes).step(model)[1]


def _climb(chunks: ChunkedOutcomes, model: TwoStates, steps: int) -> tuple[TwoStates, float]:
    """Alternate expectation and maximisation until little can be gained; returns the best model and its log-likelihood.

    The gains of the steps decrease like a geometric series, whose remainder is estimated from two gains (Aitken).
    """
    best, reached, before, done = model, -np.inf, np.inf, 0
    for _ in range(steps):
        following, likelihood = chunks.step(model)
        gained = likelihood - reached
        if gained > 0.0:
            best, reached = model, likelihood
        done = done + 1 if before > gained and gained * gained / (before - gained) < _ENOUGH else 0
        if gained < _NOTHING or done == _IN_A_ROW:
            break
        model, before = following, gained
    return best, float(reached)


@final
class ChunkedOutcomes:
    """A recording divided into chunks: step t of all chunks is row t."""

    def __init__(self, outcomes: Outcomes) -> None:
        self._count = len(outcomes)
        self._length = max(8, int(0.16 * self._count**0.5))  # balances the time between chunks and inside them
        chunks = -(-self._count // self._length)
        padded = np.full(chunks * self._length, 2, np.uint8)  # 2: unknown
        padded[: self._count] = outcomes
        self._symbols = np.ascontiguousarray(padded.reshape(chunks, self._length).T)
        self._rest = self._count - (chunks - 1) * self._length  # known steps of the last chunk

    def step(self, model: TwoStates) -> tuple[TwoStates, float]:
        """The model after one step of expectation-maximisation, and the log-likelihood of the given model."""
        emission = np.array([model.loss, 1.0 - model.loss, np.ones(2)])[self._symbols]  # (steps, chunks, 2)
        in_good, in_bad = np.ascontiguousarray(emission[..., 0]), np.ascontiguousarray(emission[..., 1])
        starts, ends = self._between(model, in_good, in_bad)
        bad, scale = self._forward(model, in_good, in_bad, starts)
        counts = self._backward(model, in_good, in_bad, bad, scale, ends)
        return _maximised(counts), float(np.log(scale).sum())

    def _between(self, model: TwoStates, in_good: Floats, in_bad: Floats) -> tuple[Floats, Floats]:
        """P(bad) before each chunk, (chunks,), and the likelihood of the rest from good and bad, (2, chunks), up to scale."""
        T, steps, chunks = model.transitions, len(in_good), in_good.shape[1]
        product = np.tile(np.eye(2)[:, :, None], (1, 1, chunks))
        for t in range(steps):
            product = np.stack(
                (
                    (product[:, 0] * T[0, 0] + product[:, 1] * T[1, 0]) * in_good[t],
                    (product[:, 0] * T[0, 1] + product[:, 1] * T[1, 1]) * in_bad[t],
                ),
                axis=1,
            )
            if t % _RESCALED == _RESCALED - 1:
                product /= product.sum(axis=(0, 1))
        maps = product.transpose(2, 0, 1).tolist()
        starts, good, bad = [], 1.0 - model.in_bad, model.in_bad
        for (gg, gb), (bg, bb) in maps:
            starts.append(bad)
            good, bad = good * gg + bad * bg, good * gb + bad * bb
            good, bad = good / (good + bad), bad / (good + bad)
        ends, good, bad = [], 1.0, 1.0
        for (gg, gb), (bg, bb) in reversed(maps):
            ends.append((good, bad))
            good, bad = gg * good + gb * bad, bg * good + bb * bad
            good, bad = good / (good + bad), bad / (good + bad)
        return np.array(starts), np.array(ends[::-1]).T

    def _forward(
        self, model: TwoStates, in_good: Floats, in_bad: Floats, starts: Floats
    ) -> tuple[NDArray[np.float64], Floats]:
        """P(bad) given all up to each step, (steps + 1, chunks), and the probability of its outcome given those before."""
        bad, scale = np.empty((len(in_good) + 1, in_good.shape[1])), np.empty(in_good.shape)
        bad[0] = starts
        for t in range(len(in_good)):
            coming = bad[t] * (1.0 - model.r - model.p) + model.p
            is_bad = coming * in_bad[t]
            scale[t] = is_bad + (1.0 - coming) * in_good[t]
            bad[t + 1] = is_bad / scale[t]
        return bad, scale

    def _backward(
        self, model: TwoStates, in_good: Floats, in_bad: Floats, bad: Floats, scale: Floats, ends: Floats
    ) -> Floats:
        """Expected counts given all outcomes: transitions gg, gb, bg, bb, losses in good, losses in bad."""
        (p, r), steps, chunks = (model.p, model.r), len(in_good), in_good.shape[1]
        after_good, after_bad = ends / (ends[0] * (1.0 - bad[steps]) + ends[1] * bad[steps])
        counts = np.zeros((6, chunks))
        for t in reversed(range(steps)):
            to_good, to_bad = in_good[t] * after_good / scale[t], in_bad[t] * after_bad / scale[t]
            complete = chunks if t < self._rest else chunks - 1
            was_bad = bad[t]
            was_good = 1.0 - was_bad
            moves = (
                was_good * to_good * (1.0 - p),
                was_good * to_bad * p,
                was_bad * to_good * r,
                was_bad * to_bad * (1.0 - r),
            )
            for count, move in zip(counts, moves, strict=False):
                count[:complete] += move[:complete]
            lost = self._symbols[t] == 0
            counts[4] += (moves[0] + moves[2]) * lost
            counts[5] += (moves[1] + moves[3]) * lost
            after_good, after_bad = (1.0 - p) * to_good + p * to_bad, r * to_good + (1.0 - r) * to_bad
        total: Floats = counts.sum(axis=1)
        return total


def _maximised(counts: Floats) -> TwoStates:
    """The parameters that make the expected counts most likely."""
    gg, gb, bg, bb, good_lost, bad_lost = counts.tolist()
    fractions = (
        gb / max(_LEAST, gg + gb),
        bg / max(_LEAST, bg + bb),
        good_lost / max(_LEAST, gg + bg),
        bad_lost / max(_LEAST, gb + bb),
    )
    return TwoStates(*(min(1.0 - _LEAST, max(_LEAST, value)) for value in fractions))
