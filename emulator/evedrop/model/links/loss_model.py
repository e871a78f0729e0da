"""The base class of loss models, from random numbers to lost packets, and the two simplest.

In the paper's link every packet is received with the same probability, independently of everything else. Several links may end at
one receiver: a packet is then lost if it is lost on all of them. The rest of a link is in `evedrop.model.slot.link`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from enum import IntEnum
from functools import reduce
from math import prod, sqrt
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from evedrop.model.checks import Parametrised, probability_mistakes
from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.links.chain import Chain, count_variance
from evedrop.model.links.counts import Counted, Spectrum, Thinned
from evedrop.model.links.way import Way
from evedrop.model.process import Floats, parts_of
from evedrop.model.receiver import Codes, Flags

_MOST_COUNTED = 1 << 20  # packets whose qualities are looked at one by one


class Fate(IntEnum):
    """The outcome of a packet on a link."""

    DELIVERED = 0
    LOST = 1
    """Erased by the link's loss model."""
    CORRUPTED = 2
    """Damaged on the way, as its checksum shows."""
    OVERFLOW = 3
    """The queue before a link of limited rate was full."""
    CUT = 4
    """Sent while the link was cut."""
    LATE = 5
    """Delayed by more slots than the receiver accepts."""
    DOWN = 6
    """Its receiver was down in a slot from its sending to its arrival."""
    PAUSED = 7
    """Its receiver was paused in such a slot."""
    UNDERWAY = 8
    """Still under way when the run ended."""
    UNSENT = 9
    """No packet was sent: the scheme stayed silent."""


REASONS = tuple(fate.name.lower() for fate in Fate if fate not in (Fate.DELIVERED, Fate.UNSENT))
"""The reasons for losses, in the order of `Fate`."""


def fates_of(lost: Flags) -> Codes:
    """`Fate` codes from flags of losses."""
    return lost.view(np.uint8)


class LossModel(Parametrised, ABC):
    """Decides fates from uniform numbers, for all trials at once, slot by slot.

    A file of this folder has one model, or a few that are related; `__init__.py` gives each its name in a scenario.
    `parameters` are the entries that the scenario gives it, each with an example.
    """

    optional: ClassVar[frozenset[str]] = frozenset()
    recorded: ClassVar[str | None] = None
    """The parameter that gets the contents of the recording `file`; None if there is none. Only for built-in models."""
    ways: tuple[Way, Way] | None = None
    """Where sender and receiver are in every slot; None if losses do not depend on that."""
    uniforms_per_slot: int = 1

    @property
    @abstractmethod
    def quality(self) -> float:
        """Mean probability that a packet is delivered."""

    def quality_at(self, slots: range) -> Floats:
        """Unconditional probability that the packet of each of these slots is delivered, (slots,)."""
        return np.full(len(slots), self.quality)

    def rate_variance(self, slots: range) -> float:
        """Variance, over trials, of one trial's fraction of delivered packets over these slots.

        From the chain, or from independence; a model with neither must override it.
        """
        chain, count = self.chain, len(slots)
        if chain is not None:
            return count_variance(chain.transitions, chain.stationary, chain.quality, count) / count**2
        qualities = (self.quality_at(part) for part in parts_of(slots))
        return sum_in_order(float((quality * (1.0 - quality)).sum()) for quality in qualities) / count**2

    def count_mean(self, slots: range) -> float:
        """Mean number of packets of these slots that are delivered."""
        if self.chain is not None:
            return len(slots) * self.quality
        return sum_in_order(float(self.quality_at(part).sum()) for part in parts_of(slots))

    def count_variance(self, parts: Sequence[Thinned]) -> float:
        """Variance, over trials, of the number of packets that get through; parts: in ascending order.

        Exact for a chain and for losses without a memory; for one part as exact as `rate_variance`; else an upper bound.
        """
        if self.chain is not None:
            return self.chain.count_variance(parts)
        each = [
            passes**2 * self.rate_variance(slots) * len(slots) ** 2
            + (passes * (1.0 - passes) * self.count_mean(slots) if passes < 1.0 else 0.0)
            for slots, passes in parts
        ]
        return sum_in_order(each) if self.memoryless else sum_in_order(map(sqrt, each)) ** 2

    def count_spectrum(self, parts: Sequence[Counted]) -> Spectrum | None:
        """The distribution, over trials, of the number of packets that get through; None if it is not known, or too much work.

        parts: in ascending order. From the chain, or from independence.
        """
        if self.chain is not None:
            return self.chain.count_spectrum(parts)
        if not self.memoryless or sum(len(slots) for slots, _ in parts) > _MOST_COUNTED:
            return None
        spectrum = np.ones(len(parts[0].w), np.complex128)
        for slots, w in parts:
            for quality, count in zip(*np.unique(self.quality_at(slots), return_counts=True), strict=True):
                spectrum *= (1.0 + float(quality) * (w - 1.0)) ** int(count)
        return spectrum

    @property
    def memoryless(self) -> bool:
        """Whether the fates of different slots are independent of each other, identically distributed, different or certain."""
        return self.chain is not None and self.chain.independent

    @property
    def settles(self) -> bool:
        """Whether the probability of a delivery is constant from some slot on, so that an error can have a limit."""
        return self.chain is not None

    @property
    def chain(self) -> Chain | None:
        """The Markov chain of the losses, for the theory; None if there is none."""
        return None

    @abstractmethod
    def fates(self, first: int, uniforms: Floats) -> Codes:
        """`Fate` of each packet of the next slots, (slots, R), from uniforms (slots, uniforms_per_slot, R).

        first: the first of the slots, which follow those of the previous call. A model replaces its memory and never changes it
        in place, so that a shallow copy of the model can continue from the same point.
        """


class Bernoulli(LossModel):
    """P(γ_k = 1) = quality, which is μ for the legitimate estimator and μ_e for an eavesdropper.

    Source: docs/mathematics/model.md, model.
    """

    parameters = MappingProxyType({"quality": 0.9})

    def __init__(self, quality: float) -> None:
        self._quality = quality

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """The quality is a probability."""
        return probability_mistakes(given, "quality")

    @property
    def quality(self) -> float:
        """The parameter."""
        return self._quality

    @property
    def chain(self) -> Chain:
        """A single state."""
        return Chain(np.ones((1, 1)), np.ones(1), np.array([self._quality]))

    def fates(self, first: int, uniforms: Floats) -> Codes:  # noqa: ARG002 - every slot alike
        """Delivered where the uniform number is below the quality."""
        return fates_of(uniforms[:, 0, :] >= self._quality)


_MOST_STATES = 1024  # of the joint chain of all links: the transitions of a larger one would fill the memory


class Pooled(LossModel):
    """Pools independent loss models, each with its own random numbers. Scenarios cannot name it: see `colluding`.

    Each of the models is checked by itself, so there is nothing to check here.
    """

    def __init__(self, models: Sequence[LossModel]) -> None:
        self._models = models
        self.uniforms_per_slot = sum(model.uniforms_per_slot for model in models)

    @property
    def quality(self) -> float:
        """1 − Π (1 − quality)."""
        return 1.0 - prod(1.0 - model.quality for model in self._models)

    def quality_at(self, slots: range) -> Floats:
        """The same for each of these slots."""
        lost = np.ones(len(slots))
        for model in self._models:
            lost *= 1.0 - model.quality_at(slots)
        return 1.0 - lost

    def rate_variance(self, slots: range) -> float:
        """An upper bound where the losses have a memory and are no chain: that of fates that vary together."""
        if self.chain is not None or self.memoryless:
            return super().rate_variance(slots)
        qualities = (self.quality_at(part) for part in parts_of(slots))
        return (sum_in_order(float(np.sqrt(each * (1.0 - each)).sum()) for each in qualities) / len(slots)) ** 2

    @property
    def memoryless(self) -> bool:
        """Whether all of the links are."""
        return all(model.memoryless for model in self._models)

    @property
    def chain(self) -> Chain | None:
        """The joint states of all links; None if a link's losses do not follow a chain, or if there are too many states."""
        chains = [model.chain for model in self._models]
        usable = [chain for chain in chains if chain is not None]
        small = prod(len(chain.stationary) for chain in usable) <= _MOST_STATES
        return reduce(_both, usable) if small and len(usable) == len(chains) else None

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """The pooled fate of each packet."""
        each, start = [], 0
        for model in self._models:
            each.append(model.fates(first, uniforms[:, start : start + model.uniforms_per_slot]))
            start += model.uniforms_per_slot
        return pooled(each)


def pooled(fates: Sequence[Codes]) -> Codes:
    """`Fate` of the packets of several links, (slots, R) each: delivered if any delivers, otherwise lost as on the first."""
    result = fates[0].copy()
    for other in fates[1:]:
        result[other == int(Fate.DELIVERED)] = Fate.DELIVERED
    return result


def _both(first: Chain, second: Chain) -> Chain:
    missed = _product(1.0 - first.quality, 1.0 - second.quality)
    return Chain(
        _product(first.transitions, second.transitions), _product(first.stationary, second.stationary), 1.0 - missed
    )


def _product(left: Floats, right: Floats) -> Floats:
    return np.asarray(np.kron(left, right), np.float64)
