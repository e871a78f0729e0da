"""The rules for loss models and delay models.

Source: docs/your-own/rules.md.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar, Generic, TypeVar, final

import numpy as np

from evedrop.model.delays import DelayModel
from evedrop.model.links.chain import Chain
from evedrop.model.links.loss_model import Fate, LossModel
from evedrop.model.process import Floats, parts_of
from evedrop.model.receiver import Codes, Flags
from evedrop.model.streams import BlockReader
from evedrop.scenario.conformance.problems import Problem, large, slots_text, small
from evedrop.scenario.conformance.receivers import SIGMAS
from evedrop.scenario.conformance.rules import (
    Array,
    Broken,
    RuleVerdict,
    calling,
    expect_array,
    expect_finite,
    expect_probability,
    expect_same,
    frozen,
    judged,
    key,
)

Model = TypeVar("Model", bound=LossModel | DelayModel)
_LAGS = 100  # slots by which a receiver may wait for late packets, at least
_COLUMN = "compute each trial from its own column of numbers alone"
_PIECES = "let a slot depend only on the model's memory and the slot's numbers, not on how many slots are asked for"


class _ModelChecks(ABC, Generic[Model]):
    """The rules that loss models and delay models share, each checked on one problem. kind, parameters: those of the model."""

    result: ClassVar[str]
    """What a model decides of a packet, for messages."""

    def __init__(self, kind: type[Model], parameters: Mapping[str, Any]) -> None:
        self._kind, self._parameters = kind, parameters

    @abstractmethod
    def _whole(self, problem: Problem, bounds: tuple[int, ...] = ()) -> Array:
        """All results of a problem, (slots, R), in one call, or in several calls that begin at 0 and at these slots."""

    def _made(self) -> Model:
        with calling(f"{self._kind.__name__}(…)", self._kind):
            return self._kind(**self._parameters)

    def alone(self, problem: Problem) -> None:
        """A trial alone gives the same results as among others."""
        among = self._whole(problem)
        words = f"{{0!r}} among {problem.batch.trials} trials and {{1!r}} alone"
        for trial in (0, problem.batch.trials - 1):
            part = problem.part(trial, 1)
            self._same(among[:, trial : trial + 1], self._whole(part), part, words, _COLUMN)

    def pieces(self, problem: Problem) -> None:
        """Slots give the same results in one call and in several."""
        once, several = self._whole(problem), self._whole(problem, (1, 4, 5))
        self._same(once, several, problem, "{0!r} in one call and {1!r} in several", _PIECES)

    def _same(self, first: Array, second: Array, problem: Problem, words: str, remedy: str) -> None:
        rows = [[{self.result: row} for row in results] for results in (first, second)]
        expect_same(rows[0], rows[1], slice(None), problem.batch.first_trial, words, remedy)


@final
class LossChecks(_ModelChecks[LossModel]):
    """The rules for loss models."""

    result = "the fate"

    def verdicts(self) -> list[RuleVerdict]:
        """Check every rule, on small problems."""
        exact = [
            ("shapes and types", self.shapes),
            ("same results when made again", self.twice),
            ("independent trials", self.alone),
            ("blocks of any length", self.pieces),
            ("independent copies", self.copied),
        ]
        return judged(
            (exact, small()), ([("quality agrees with simulation", self.rate)], [_long(loss) for loss in large()])
        )

    def _uniforms(self, model: LossModel, problem: Problem) -> Floats:
        words = model.uniforms_per_slot
        if type(words) is not int or words < 1:
            raise Broken(f"uniforms_per_slot is {words!r}; expected a whole number from 1 on")
        reader = BlockReader(key("link"), problem.batch, words)
        return frozen(reader.uniforms(range(problem.slots)))

    def _fates(self, model: LossModel, first: int, uniforms: Floats) -> Codes:
        with calling(f"fates() of slot {first} and on", self._kind):
            fates = model.fates(first, uniforms)
        slots, _, trials = uniforms.shape
        expect_array(f"fates() of slot {first} and on", fates, np.uint8, (slots, trials), "slots, R trials")
        other = ~np.isin(fates, (Fate.DELIVERED, Fate.LOST))
        if other.any():
            row, trial = np.argwhere(other)[0]
            raise Broken(
                f"slot {first + row}, trial {trial}: the fate is {fates[row, trial]}; expected Fate.DELIVERED or Fate.LOST, "
                "such as by fates_of(lost)"
            )
        return fates

    def _whole(self, problem: Problem, bounds: tuple[int, ...] = ()) -> Codes:
        model = self._made()
        uniforms = self._uniforms(model, problem)
        pieces = pairwise((0, *bounds, problem.slots))
        return np.concatenate([self._fates(model, first, uniforms[first:stop]) for first, stop in pieces])

    def shapes(self, problem: Problem) -> None:
        """Fates, and the numbers that the model states, have the right shapes and types."""
        self._whole(problem)
        self.stated(range(problem.slots))

    def stated(self, slots: range) -> None:
        """The numbers that the model states of these slots have the right shapes and types."""
        model = self._made()
        with calling("quality, quality_at(), rate_variance()", self._kind):
            quality, variance = model.quality, model.rate_variance(slots)
            settles, memoryless, chain = model.settles, model.memoryless, model.chain
        expect_probability("quality", quality)
        for part in parts_of(slots):
            with calling(f"quality_at() of {slots_text(part)}", self._kind):
                each = model.quality_at(part)
            expect_array(
                f"quality_at() of {slots_text(part)}", each, np.float64, (len(part),), "one for each of the slots"
            )
            if not ((each >= 0.0) & (each <= 1.0)).all():
                raise Broken(f"quality_at() is from {each.min()} to {each.max()}; expected probabilities")
        if not 0.0 <= variance <= 0.25 + 1e-12:
            raise Broken(f"rate_variance() is {variance}; expected a variance of a fraction, 0 to 0.25")
        if type(settles) is not bool or type(memoryless) is not bool:
            raise Broken("settles or memoryless is neither True nor False")
        if chain is not None and not isinstance(chain, Chain):
            raise Broken(f"chain is {type(chain).__name__}; expected a Chain, or None")
        if chain is not None and not np.allclose(chain.stationary @ chain.transitions, chain.stationary):
            raise Broken(
                "chain.stationary is not the stationary distribution of chain.transitions; correct them, or return None"
            )

    def twice(self, problem: Problem) -> None:
        """Two that take turns do the same as one alone."""
        once = self._whole(problem)
        pair = [self._made() for _ in range(2)]
        uniforms = self._uniforms(pair[0], problem)
        each: list[list[Codes]] = [[], []]
        for k in range(problem.slots):
            for model, fates in zip(pair, each, strict=True):
                fates.append(self._fates(model, k, uniforms[k : k + 1]))
        words = "{0!r} by itself and {1!r} with another one of its kind, slot by slot"
        for fates in each:
            self._same(once, np.concatenate(fates), problem, words, "keep no state outside of the model")

    def copied(self, problem: Problem) -> None:
        """A shallow copy continues from where it was made, whatever the original does meanwhile."""
        once, uniforms = self._whole(problem), self._uniforms(self._made(), problem)
        remedy = "replace what the model remembers, and never change an array of it in place"
        for k in range(1, min(problem.slots, 16)):  # what a model remembers shows only in some slots
            model = self._made()
            self._fates(model, 0, uniforms[:k])
            other = copy.copy(model)
            self._fates(model, k, uniforms[k:])
            fates = np.concatenate([once[:k], self._fates(other, k, uniforms[k:])])
            self._same(once, fates, problem, f"{{0!r}}, and {{1!r}} of a copy made before slot {k}", remedy)

    def rate(self, problem: Problem) -> None:
        """The fraction delivered has the mean, in every slot, and the variance over trials that the model states."""
        arrived = self._whole(problem) == Fate.DELIVERED
        delivered, each = arrived.mean(axis=0), arrived.mean(axis=1)
        model, slots = self._made(), range(problem.slots)
        stated = model.quality_at(slots)
        expected, variance = float(stated.mean()), model.rate_variance(slots)
        scatter = max(variance, float(delivered.var()))
        if abs(delivered.mean() - expected) > SIGMAS * np.sqrt(scatter / len(delivered)) + 1e-9:
            raise Broken(
                f"delivers {delivered.mean():.4f} of the packets, and quality_at() says {expected:.4f}; correct it"
            )
        far = _far(each, stated, problem.batch.trials)
        if far.any():
            k = int(np.argmax(far))
            raise Broken(
                f"slot {k}: delivers {each[k]:.4f} of the packets, and quality_at() says {stated[k]:.4f}; correct it"
            )
        squares = (delivered - delivered.mean()) ** 2
        # Rare losses make the squares so skewed that only their own scatter tells what chance does; 2σ⁴: if they were normal.
        spread = SIGMAS * np.sqrt(max(float(squares.var()), 2.0 * variance**2) / len(squares))
        if squares.mean() > variance + spread + 1e-9:
            raise Broken(
                f"the fraction delivered has the variance {squares.mean():.3g} over trials, and rate_variance() says "
                f"{variance:.3g}; give `chain`, or a rate_variance() of its own"
            )


@final
class DelayChecks(_ModelChecks[DelayModel]):
    """The rules for delay models."""

    result = "the delay"

    def verdicts(self) -> list[RuleVerdict]:
        """Check every rule, on small problems."""
        exact = [
            ("shapes and types", self.shapes),
            ("independent trials", self.alone),
            ("blocks of any length", self.pieces),
        ]
        return judged((exact, small()), ([("delays agree with simulation", self.says)], large()))

    def _whole(self, problem: Problem, bounds: tuple[int, ...] = ()) -> Floats:
        """All delays, (slots, R); every call is to a new instance."""
        reader, parts = BlockReader(key("delay"), problem.batch, 1), []
        for first, stop in pairwise((0, *bounds, problem.slots)):
            slots = range(first, stop)
            model = self._made()
            numbers = frozen((reader.normals(slots) if model.normal else reader.uniforms(slots))[:, 0])
            where = f"delays() of slot {first} and on"
            with calling(where, self._kind):
                delays = model.delays(first, numbers)
            expect_array(where, delays, np.float64, numbers.shape, "slots, R trials")
            expect_finite(where, delays)
            if (delays < 0.0).any():
                raise Broken(f"{where}: one is {delays.min()}; expected slots, 0 or more")
            parts.append(delays)
        return np.concatenate(parts)

    def shapes(self, problem: Problem) -> None:
        """Delays, and the probabilities that the model states, have the right shapes and types."""
        self._whole(problem)
        self.stated(_LAGS)

    def stated(self, lags: int) -> None:
        """The probabilities that the model states of the first lags have the right types, and do not fall."""
        with calling(f"arrived() of 0 to {lags - 1}", self._kind):
            probabilities = [self._made().arrived(lag) for lag in range(lags)]
        given = [probability for probability in probabilities if probability is not None]
        for lag, probability in enumerate(probabilities):
            if probability is not None:
                expect_probability(f"arrived({lag})", probability)
        if given and (
            len(given) < len(probabilities) or given != sorted(given) or not 0.0 <= given[0] <= given[-1] <= 1.0
        ):
            raise Broken(
                f"arrived() of 0 to {lags - 1} is {probabilities!r:.200}; expected probabilities that do not fall, or None always"
            )

    def says(self, problem: Problem) -> None:
        """The fraction of packets in time is the stated one in every slot."""
        delays = self._whole(problem)
        for lag in range(4):
            promised = self._made().arrived(lag)
            if promised is None:
                continue
            fraction, each = float((delays < lag + 1).mean()), (delays < lag + 1).mean(axis=1)
            if abs(fraction - promised) > SIGMAS * np.sqrt(max(promised * (1.0 - promised), 1e-3) / delays.size):
                raise Broken(
                    f"{fraction:.4f} of the delays are below {lag + 1} slots, and arrived({lag}) is {promised:.4f}"
                )
            far = _far(each, np.full(len(each), promised), problem.batch.trials)
            if far.any():
                k = int(np.argmax(far))
                raise Broken(
                    f"slot {k}: {each[k]:.4f} of the delays are below {lag + 1} slots, and arrived({lag}) is {promised:.4f}; "
                    "return None if slots differ"
                )


def _far(fractions: Floats, stated: Floats, trials: int) -> Flags:
    """Where the fraction of so many independent trials contradicts a stated probability not only by chance."""
    scatter = np.maximum(fractions * (1.0 - fractions), stated * (1.0 - stated)) / trials
    return np.asarray(np.abs(fractions - stated) > SIGMAS * np.sqrt(scatter) + 1e-9)


def _long(problem: Problem) -> Problem:
    """The problem with more slots, for models with a memory."""
    return replace(problem, batch=replace(problem.batch, slots=60))
