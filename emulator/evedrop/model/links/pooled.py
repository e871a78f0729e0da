"""Several links that end at one receiver: a packet is lost if it is lost on all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from math import prod
from typing import Any, ClassVar

import numpy as np

from evedrop.model.links.loss_model import Chain, Fate, LossModel
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes

_MOST_STATES = 1024  # of the joint chain of all links: the transitions of a larger one would fill the memory


class Pooled(LossModel):
    """Pools independent loss models, each with its own random numbers. Scenarios cannot name it: see `colluding`.

    Each of the models is checked by itself, so there is nothing to check here.
    """

    parameters: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, models: Sequence[LossModel]) -> None:
        self._models = models
        self.uniforms_per_slot = sum(model.uniforms_per_slot for model in models)

    @property
    def quality(self) -> float:
        """1 − Π (1 − quality)."""
        lost = 1.0
        for model in self._models:
            lost *= 1.0 - model.quality
        return 1.0 - lost

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
        result[other == Fate.DELIVERED] = Fate.DELIVERED
    return result


def _both(first: Chain, second: Chain) -> Chain:
    missed = _product(1.0 - first.quality, 1.0 - second.quality)
    return Chain(
        _product(first.transitions, second.transitions), _product(first.stationary, second.stationary), 1.0 - missed
    )


def _product(left: Floats, right: Floats) -> Floats:
    return np.asarray(np.kron(left, right), np.float64)
