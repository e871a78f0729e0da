"""Losses in a given order: a pattern of outcomes that repeats, or a recorded trace.

A trace is read once or repeatedly, from its beginning or from a random place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from evedrop.model.checks import flag_mistakes, word_mistakes
from evedrop.model.links.counts import Counted, Spectrum
from evedrop.model.links.loss_model import LossModel, fates_of
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes


class Pattern(LossModel):
    """Delivered in slot k where `outcomes`, repeated without end, has a 1 at place k; the same in every trial."""

    parameters = MappingProxyType({"outcomes": "1101"})
    uniforms_per_slot = 1

    def __init__(self, outcomes: str) -> None:
        self._lost = np.frombuffer(outcomes.encode(), np.uint8) == ord("0")

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A word of zeros and ones."""
        return word_mistakes(given, "outcomes")

    @property
    def quality(self) -> float:
        """The fraction of ones."""
        return float(1.0 - self._lost.mean())

    @property
    def memoryless(self) -> bool:
        """True: nothing is random."""
        return True

    def quality_at(self, slots: range) -> Floats:
        """0 or 1."""
        return np.asarray(~self._lost[np.arange(slots.start, slots.stop) % len(self._lost)], np.float64)

    def rate_variance(self, slots: range) -> float:  # noqa: ARG002 - no trial differs from another
        """0, because all trials are equal."""
        return 0.0

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """The outcomes of these slots, the same in every trial."""
        slots, _, trials = uniforms.shape
        places = np.arange(first, first + slots) % len(self._lost)
        return fates_of(np.repeat(self._lost[places][:, None], trials, axis=1))


MOST_OUTCOMES = 10_000_000
MOST_BEGINNINGS = 4096
"""Of a recording whose distribution of counts is computed; times the ranges of packets that count."""


class RecordedLoss(LossModel):
    """Delivered in slot k where `outcomes` has a 1 at place k from the beginning; unless `once`, the trace repeats.

    The beginning is place 0, the same in all trials; with `random_start` it is ⌊u · length⌋, where u is the trial's uniform
    number of the first slot asked for, so that trials see different parts of the recording. A scenario names a file,
    which is replaced by `outcomes` when the scenario is loaded.

    Uniforms: column 0 is the place where the trial begins (used in the first slot only).

    Source: docs/links.md, traces.
    """

    parameters = MappingProxyType({"outcomes": "1101", "once": True, "random_start": True})
    optional = frozenset({"once", "random_start"})
    recorded: ClassVar[str | None] = "outcomes"
    uniforms_per_slot = 1

    def __init__(self, outcomes: str, once: bool = False, random_start: bool = False) -> None:
        self._lost = np.frombuffer(outcomes.encode(), np.uint8) == ord("0")
        self._once, self._random = once, random_start
        self._ring = np.concatenate((self._lost, self._lost)) if random_start else self._lost
        self._begin: NDArray[np.intp] | None = None

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A word of zeros and ones of limited length, and flags that do not contradict each other."""
        mistakes = word_mistakes(given, "outcomes") + flag_mistakes(given, "once", "random_start")
        if not mistakes and len(given.get("outcomes", "")) > MOST_OUTCOMES:
            mistakes.append(("outcomes", f"are {len(given['outcomes'])}; expected at most {MOST_OUTCOMES}"))
        if given.get("once") is True and given.get("random_start") is True:
            sentence = (
                "is given together with once, so that trials would run out of the recording; expected one of the two"
            )
            mistakes.append(("random_start", sentence))
        return mistakes

    @property
    def quality(self) -> float:
        """The fraction of ones."""
        return float(1.0 - self._lost.mean())

    @property
    def memoryless(self) -> bool:
        """True: nothing is random, unless trials begin at random places."""
        return not self._random

    def quality_at(self, slots: range) -> Floats:
        """0 or 1, or, for a random start, the fraction of ones: every place is equally likely."""
        if self._random:
            return np.full(len(slots), self.quality)
        return np.asarray(~self._lost[self._places(slots.start, slots.stop)], np.float64)

    def rate_variance(self, slots: range) -> float:
        """For a random start, the variance of the count in a window at a random place on the ring; otherwise 0."""
        if not self._random:
            return 0.0
        length = len(self._lost)
        delivered = np.concatenate(([0], np.cumsum(~self._ring)))
        rest = len(slots) % length  # whole rounds give every trial the same count
        return float(np.var(delivered[rest : rest + length] - delivered[:length])) / len(slots) ** 2

    def count_spectrum(self, parts: Sequence[Counted]) -> Spectrum | None:
        """For a random start, over all places where it may begin."""
        length = len(self._lost)
        if not self._random or length > MOST_BEGINNINGS or len(parts) > MOST_BEGINNINGS // length:
            return super().count_spectrum(parts) if not self._random else None
        delivered = np.concatenate(([0], np.cumsum(~self._ring)))
        begins, total = np.arange(length), int(delivered[length])
        counts = np.stack(
            [
                len(slots) // length * total
                + delivered[(begins + slots.start) % length + len(slots) % length]
                - delivered[(begins + slots.start) % length]
                for slots, _ in parts
            ]
        )
        each, times = np.unique(counts, axis=1, return_counts=True)
        spectrum = np.zeros(len(parts[0].w), np.complex128)
        for column, count in zip(each.T.tolist(), times.tolist(), strict=True):
            term = np.full(len(spectrum), count / length, np.complex128)
            for number, part in zip(column, parts, strict=True):
                term *= part.w**number
            spectrum += term
        return spectrum

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """The outcomes by slot and by the place where the trial began."""
        slots, _, trials = uniforms.shape
        places = self._places(first, first + slots)
        if not self._random:
            return fates_of(np.repeat(self._lost[places][:, None], trials, axis=1))
        if self._begin is None:
            # u is at most 1 − 2⁻⁵³, and the product then rounds to less than the length.
            self._begin = (uniforms[0, 0] * float(len(self._lost))).astype(np.intp)
        return fates_of(self._ring[places[:, None] + self._begin])

    def _places(self, first: int, stop: int) -> NDArray[np.intp]:
        """The places of these slots in the recording. Raises ValueError if it is read only once and too short."""
        if self._once and stop > len(self._lost):
            raise ValueError(f"the recording has {len(self._lost)} outcomes and slot {stop - 1} was asked for")
        return np.arange(first, stop) % len(self._lost)
