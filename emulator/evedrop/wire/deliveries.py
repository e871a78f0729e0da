"""How many messages a link lets through: mean and variance over seeds, and the bounds of 99 % of all wires.

The distribution is computed from its Fourier transform E[z^D], which for a Markov chain is a product of small matrices, and for
several keys, whose random numbers are independent, the product of theirs. Without a transform the bounds are those of a normal
variable.

Source: docs/mathematics/links.md, losses in bursts.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import Any, final

import numpy as np

from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.links import loss_of
from evedrop.model.links.counts import Counted, Spectrum, Thinned
from evedrop.model.links.loss_model import LossModel
from evedrop.model.slot.link import NEVER, Change, LinkSchedule
from evedrop.model.slot.link_distribution import stretches

_OUTSIDE = 0.005  # of all wires, on each side of the bounds
_STANDARD_DEVIATIONS = 2.5758293035489004  # of a normal variable, for 99 %
_POINTS = 4096
_FARTHEST = (
    32.0  # standard deviations from the mean: farther are less than a thousandth of all wires, for any distribution
)
_SMOOTHED = 1.5  # points of the grid, where it is coarser than the counts
_MARGIN = 16  # points
_ROUNDED = 1e-12  # of the mean: what rounding leaves of a variance that is 0
_MOST_PARTS, _POWERS = 2048, 16  # ranges of different streams, and how many of them the powers of a chain cost


@final
class KeyDeliveries:
    """The number of messages of one key that get through.

    settings: `WireLink.settings`; changes: as for `PerKeyLinks`; ranges: the numbers of the messages, disjoint and ascending;
    counts: how many of each range count, as if picked at random; None: all.

    The variance is exact for losses without a memory, and for those of a Markov chain, whatever is left out. For other losses
    with a memory it is as exact as the model's `rate_variance` for a single range, and an upper bound for several.
    """

    __slots__ = ("_pieces", "mean", "sampled", "variance")

    def __init__(
        self,
        settings: Mapping[str, Any],
        changes: Iterable[Change],
        ranges: Sequence[range],
        counts: Sequence[int] | None = None,
    ) -> None:
        counts = [len(some) for some in ranges] if counts is None else counts
        shares = [min(1.0, count / len(some)) for some, count in zip(ranges, counts, strict=True)]
        self._pieces = _pieces(settings, changes, ranges, shares)
        self.sampled = any(share < 1.0 for share in shares)
        self.variance = 0.0
        starts, means = [some.start for some in ranges], [0.0] * len(ranges)
        for loss, parts in self._pieces:
            for part in parts:
                means[bisect_right(starts, part.slots.start) - 1] += part.passes * loss.count_mean(part.slots)
            self.variance += loss.count_variance(parts)
        means = [min(mean, count) for mean, count in zip(means, counts, strict=True)]  # the products are rounded
        self.mean = sum_in_order(means)
        if self.sampled:  # each message counted by chance so far; but how many of a range count is known
            parts_of_means = zip(means, counts, shares, strict=True)
            self.variance -= sum_in_order((1.0 - share) * mean * mean / count for mean, count, share in parts_of_means)
            self.variance = self.variance if self.variance > _ROUNDED * self.mean else 0.0

    @property
    def parts(self) -> int:
        """The number of stretches of messages within which no setting changes."""
        return sum(len(parts) for _, parts in self._pieces)

    def spectrum(self, z: Spectrum) -> Spectrum | None:
        """E[z^D] of the number D; None if it is not known, or too much work."""
        if self.sampled:
            return None
        spectrum = np.ones_like(z)
        for loss, parts in self._pieces:
            factors = {passes: 1.0 + passes * (z - 1.0) for passes in {part.passes for part in parts}}
            factor = loss.count_spectrum([Counted(part.slots, factors[part.passes]) for part in parts])
            if factor is None:
                return None
            spectrum *= factor
        return spectrum


def bounds(streams: Sequence[KeyDeliveries], count: int) -> tuple[float, float]:
    """The least and the most deliveries among `count` messages of independent streams, in 99 % of all wires."""
    mean, variance = (sum_in_order(getattr(stream, name) for stream in streams) for name in ("mean", "variance"))
    return _bounds_by_transform(streams, count, mean, variance) or normal_bounds(mean, variance, count)


def _bounds_by_transform(
    streams: Sequence[KeyDeliveries], count: int, mean: float, variance: float
) -> tuple[int, int] | None:
    """As `bounds`; None if the distribution is not known or too much work.

    mean, variance: of all streams together.
    """
    different = Counter(streams)
    if variance <= 0.0 or sum(_POWERS + stream.parts for stream in different) > _MOST_PARTS:
        return None
    period = min(count + 1, math.ceil(2.0 * _FARTHEST * math.sqrt(variance)) + 2)
    points = min(_POINTS, 1 << (period - 1).bit_length())
    step = period / (points - 2 * _MARGIN) if period > points else 1.0  # counts from a point of the grid to the next
    around = _MARGIN * step if step > 1.0 else 0.0  # what is smoothed reaches over the least and the greatest count
    angles = 2.0 * np.pi / (points * step) * np.arange(points // 2 + 1)
    z = np.exp(1j * angles)
    spectrum = np.ones_like(z)
    for stream, times in different.items():
        factor = stream.spectrum(z)
        if factor is None:
            return None
        spectrum *= factor**times
    first = round(max(-around, min(mean - points * step / 2.0, count + 1 + around - points * step)))
    spectrum *= np.exp(-1j * angles * first)
    if step > 1.0:
        spectrum *= np.exp(-0.5 * (_SMOOTHED * step * angles) ** 2)
    odds = np.cumsum(np.fft.irfft(np.conj(spectrum), points))  # of at most first + i · step deliveries
    low = int(np.searchsorted(odds, _OUTSIDE, side="right"))
    high = int(np.searchsorted(odds, 1.0 - _OUTSIDE, side="left"))
    return max(0, first + math.floor(low * step)), min(count, first + math.ceil(high * step))


def normal_bounds(mean: float, variance: float, count: int) -> tuple[float, float]:
    """The bounds if the number of deliveries were normal, with a correction for whole numbers."""
    reach = _STANDARD_DEVIATIONS * math.sqrt(variance) + (0.5 if variance > 0.0 else 1e-6 * max(1.0, mean))
    return max(0.0, mean - reach), min(float(count), mean + reach)


def _pieces(
    settings: Mapping[str, Any], changes: Iterable[Change], ranges: Sequence[range], shares: Sequence[float]
) -> list[tuple[LossModel, list[Thinned]]]:
    """The loss models in turn, each with the messages on which it decides, in parts within which no setting changes.

    shares: the fraction of each range that counts.
    """
    marks = stretches(LinkSchedule(settings, changes=tuple(changes)))
    models = accumulate((new["loss"] != old["loss"] for (_, old, _), (_, new, _) in pairwise(marks)), initial=0)
    ends = [*(start for start, _, _ in marks[1:]), NEVER]
    spans = [*zip(models, marks, ends, strict=True)]
    pieces: dict[int, tuple[LossModel, list[Thinned]]] = {}
    for some, share in zip(ranges, shares, strict=True):
        for model, (start, new, _), stop in spans:
            slots = range(max(some.start, start), min(some.stop, stop))
            if slots:
                if model not in pieces:
                    pieces[model] = (loss_of(new["loss"]), [])
                pieces[model][1].append(Thinned(slots, share * (1.0 - new.get("corrupt", 0.0))))
    return [*pieces.values()]
