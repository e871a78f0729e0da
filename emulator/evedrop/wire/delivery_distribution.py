"""How many messages of a key a link's models let through: the mean and the variance over seeds.

Time-dependent effects are counted apart: a message that was cut, or for which the queue was full, is left out of `ranges`. The
means and variances of several keys, or links, add up, since their random numbers are independent.

Source: docs/wire.md, a link and its model; docs/mathematics.md, losses in bursts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.links import loss_of
from evedrop.model.links.link import Chain, LossModel, count_variance
from evedrop.model.process import Floats
from evedrop.model.slot.link import NEVER, Change

_STANDARD_DEVIATIONS = 2.5758293035489004  # of a normal variable, for 99 %
_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class _Part:
    """Consecutive messages between which the settings do not change."""

    loss: int
    """Which of the loss models decides on them: the number of the change that brought it."""
    spec: Mapping[str, Any]
    slots: range
    passes: float
    """Probability that a message that is not lost gets through."""


def expected(settings: Mapping[str, Any], changes: Iterable[Change], ranges: Iterable[range]) -> tuple[float, float]:
    """Mean and variance of the number of messages of one key that get through.

    settings: `WireLink.settings`; changes: as for `KeyFates`; ranges: the numbers of the messages, disjoint and ascending.

    The variance is exact for losses without a memory, and for those of a Markov chain, whatever is left out. For other losses
    with a memory it is that of the model for a single range, and an upper bound for several.
    """
    mean = variance = 0.0
    for _, group in groupby(_parts(settings, changes, ranges), key=lambda part: part.loss):
        parts = list(group)
        loss = loss_of(parts[0].spec)
        mean += sum_in_order(part.passes * _delivered(loss, part.slots) for part in parts)
        variance += _variance(loss, parts)
    return mean, variance


def bounds(mean: float, variance: float, count: int) -> tuple[float, float]:
    """Between which numbers the deliveries among `count` messages are in 99 % of all wires."""
    reach = _STANDARD_DEVIATIONS * math.sqrt(variance) + (0.5 if variance > 0.0 else 1e-6 * max(1.0, mean))
    return max(0.0, mean - reach), min(float(count), mean + reach)


def _parts(settings: Mapping[str, Any], changes: Iterable[Change], ranges: Iterable[range]) -> Iterator[_Part]:
    last = {
        change.at: change.settings for change in sorted(changes, key=lambda one: one.at) if change.settings is not None
    }
    stretches: list[tuple[int, int, Mapping[str, Any]]] = [(0, 0, settings)]
    for at, new in last.items():
        number, _, before = stretches[-1]
        stretches.append((number + (new["loss"] != before["loss"]), at, new))
    ends = [at for _, at, _ in stretches[1:]] + [NEVER]
    for some in ranges:
        for (number, start, new), stop in zip(stretches, ends, strict=True):
            slots = range(max(some.start, start), min(some.stop, stop))
            if slots:
                yield _Part(number, new["loss"], slots, 1.0 - new.get("corrupt", 0.0))


def _delivered(loss: LossModel, slots: range) -> float:
    """The mean number of these messages that are not lost."""
    if loss.chain is not None:
        return len(slots) * loss.quality
    pieces = (slots[i : i + _AT_ONCE] for i in range(0, len(slots), _AT_ONCE))
    return sum_in_order(float(loss.quality_at(piece).sum()) for piece in pieces)


def _variance(loss: LossModel, parts: Sequence[_Part]) -> float:
    if loss.chain is not None:
        return _variance_of_chain(loss.chain, parts)
    each = [
        part.passes**2 * loss.rate_variance(part.slots) * len(part.slots) ** 2
        + part.passes * (1.0 - part.passes) * _delivered(loss, part.slots)
        for part in parts
    ]
    return sum_in_order(each) if loss.memoryless else sum_in_order(map(math.sqrt, each)) ** 2


def _variance_of_chain(chain: Chain, parts: Sequence[_Part]) -> float:
    """The variance for parts of one chain, which continues between them.

    w is the row Σ passes_i E[(γ_i − mean); state at the present message] over the messages i so far, so that the covariance of
    all of them with the message is w · (quality − mean). Its entries sum to 0; so the chain's stationary part can be left out.
    """
    mean = float(chain.stationary @ chain.quality)
    centred = chain.quality - mean
    fading = chain.transitions - chain.stationary
    sums: dict[int, tuple[Floats, Floats]] = {}
    w, at, total = np.zeros(len(centred)), parts[0].slots.start, 0.0
    for part in parts:
        count, passes = len(part.slots), part.passes
        if count not in sums:
            sums[count] = _power_and_sum(fading, count)
        power, partial = sums[count]
        w = w @ np.linalg.matrix_power(fading, part.slots.start - at)
        own = passes**2 * count_variance(chain.transitions, chain.stationary, chain.quality, count)
        total += own + passes * (1.0 - passes) * count * mean + 2.0 * passes * float(w @ partial @ centred)
        w = w @ power + passes * ((chain.stationary * centred) @ partial @ fading)
        at = part.slots.stop
    return total


def _power_and_sum(matrix: Floats, count: int) -> tuple[Floats, Floats]:
    """The power `count` of a matrix, and the sum of its powers below that one, by doubling."""
    power, partial = np.eye(len(matrix)), np.zeros_like(matrix)
    for bit in f"{count:b}":
        partial = partial + power @ partial
        power = power @ power
        if bit == "1":
            partial = partial + power
            power = power @ matrix
    return power, partial
