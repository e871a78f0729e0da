"""Losses by distance: a radio link whose power decreases with distance, with shadowing and fading.

Expectations for such a link are theory, which enters no digest and may therefore use numpy's functions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evedrop.model.checks import number_mistakes, whole_number_mistakes
from evedrop.model.kernels.elementary import exp, log, normal_quantile, sum_in_order
from evedrop.model.links.counts import Counted, Spectrum
from evedrop.model.links.loss_model import LossModel, fates_of
from evedrop.model.links.way import FARTHEST, Way, way_mistakes
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes

_NEPER = 0.23025850929940458  # ln 10 / 10: decibels as a natural logarithm
_LONGEST_BLOCK = 1_000_000
_AT_ONCE = 8192  # packets whose fates are decided together
_MOST_WORK = 1 << 27  # factors whose products give the distribution of counts
_SAMPLE = 4096  # slots over which the mean quality of a moving link is computed


class Distance(LossModel):
    """Received where the signal-to-noise ratio of the slot is at least `threshold` dB.

    In dB the ratio at a distance of d metres is

        reference_snr − 10 · exponent · log₁₀(d / reference_distance) + X + 10 · log₁₀ g

    with X ~ N(0, shadowing²), drawn every `shadowing_block` slots, and g ~ Exp(1), the power of Rayleigh fading, drawn every
    `fading_block` slots. Below the reference distance the power is that at the reference distance. Sender and receiver may move.

    Uniforms: column 0 is the fading, column 1 the shadowing, each from the first slot of its block (or the slot in which the
    link begins, if that is within the block), so that two links with the same uniforms fade and are shadowed together, wherever
    their receivers are.

    Source: docs/mathematics/links.md, path loss.
    """

    parameters = MappingProxyType(
        {
            "sender": [0.0, 0.0],
            "receiver": [120.0, 0.0],
            "reference_snr": 80.0,
            "exponent": 3.0,
            "threshold": 10.0,
            "reference_distance": 1.0,
            "shadowing": 6.0,
            "shadowing_block": 50,
            "fading_block": 1,
        }
    )
    optional = frozenset({"reference_distance", "shadowing", "shadowing_block", "fading_block"})
    uniforms_per_slot = 2

    def __init__(
        self,
        sender: list[Any],
        receiver: list[Any],
        reference_snr: float,
        exponent: float,
        threshold: float,
        reference_distance: float = 1.0,
        shadowing: float = 0.0,
        shadowing_block: int = 1,
        fading_block: int = 1,
    ) -> None:
        self.ways = self._ways = (Way(sender), Way(receiver))
        self._settled = max(slot for way in self._ways for slot in way.slots)
        self._margin = (threshold - reference_snr) * _NEPER
        self._exponent = float(exponent)
        self._nearest = reference_distance * reference_distance
        self._standard_deviation = shadowing * _NEPER
        self._shadowing_block, self._fading_block = shadowing_block, fading_block
        self._fade: Floats | None = None  # of the current block, (R,)
        self._shadow: Floats | None = None

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Mistakes in positions, numbers outside their bounds, and a sender and receiver in the same place."""
        ways = {name: way_mistakes(given[name]) for name in ("sender", "receiver") if name in given}
        wrong = [(name, sentence) for name, mistakes in ways.items() for sentence in mistakes]
        for name, least, most in (
            ("reference_snr", -300.0, 300.0),
            ("exponent", 0.0, 10.0),
            ("threshold", -300.0, 300.0),
            ("reference_distance", 1e-3, FARTHEST),
            ("shadowing", 0.0, 30.0),
        ):
            wrong += number_mistakes(given, name, least, most)
        for name in ("shadowing_block", "fading_block"):
            wrong += whole_number_mistakes(given, name, 1, _LONGEST_BLOCK, "slots")
        if len(ways) == 2 and not any(ways.values()):
            shared_slot = _shared_slot(Way(given["sender"]), Way(given["receiver"]))
            if shared_slot is not None:
                wrong.append(("receiver", f"is where the sender is, in slot {shared_slot}; expected another place"))
        return wrong

    @property
    def quality(self) -> float:
        """The mean of `quality_at` over the slots up to the last waypoint, or over 4096 of them if there are more."""
        slots = np.unique(np.linspace(0, self._settled, min(_SAMPLE, self._settled + 1)).astype(np.int64))
        return float(delivery_probability(self._needed(slots.astype(np.float64)), self._standard_deviation).mean())

    @property
    def memoryless(self) -> bool:
        """Whether nothing is drawn for longer than a slot."""
        return self._fading_block == 1 and (self._shadowing_block == 1 or self._standard_deviation == 0.0)

    @property
    def settles(self) -> bool:
        """True: the quality is constant after the last waypoint."""
        return True

    def quality_at(self, slots: range) -> Floats:
        """The probability that the fading compensates distance and shadowing, averaged over the shadowing; to 1e-11."""
        needed, places = np.unique(
            self._needed(np.arange(slots.start, slots.stop, dtype=np.float64)), return_inverse=True
        )
        return delivery_probability(needed, self._standard_deviation)[places]

    def rate_variance(self, slots: range) -> float:
        """Exact where `fading_block` divides `shadowing_block` or there is no shadowing; otherwise an upper bound.

        The bound holds the shadowing for the least common multiple of both: sharing more only makes slots more alike.
        """
        outer = math.lcm(self._fading_block, self._shadowing_block) if self._standard_deviation else self._fading_block
        moving = range(slots.start, min(slots.stop, max(slots.start, -(-self._settled // outer) * outer)))
        resting = range(moving.stop, slots.stop)
        total = self._count_variance(moving, outer)
        head = range(resting.start, min(resting.stop, -(-resting.start // outer) * outer))
        whole = range(head.stop, head.stop + outer)
        blocks = (resting.stop - head.stop) // outer
        tail = range(head.stop + blocks * outer, resting.stop)
        total += self._count_variance(head, outer) + self._count_variance(tail, outer)
        if blocks:
            total += blocks * self._count_variance(whole, outer)
        return total / len(slots) ** 2

    def count_spectrum(self, parts: Sequence[Counted]) -> Spectrum | None:
        """Block by block of shadowing; None if a block of fading does not divide it, or for too much work."""
        shadowed = self._standard_deviation > 0.0
        outer = self._shadowing_block if shadowed else self._fading_block
        nodes, weights = shadowing_rule(self._standard_deviation)
        count, points = sum(len(slots) for slots, _ in parts), len(parts[0].w)
        if outer % self._fading_block or count * points > min(_NUMBERS_AT_ONCE << 2, _MOST_WORK // len(nodes)):
            return None
        slots = np.concatenate([np.arange(some.start, some.stop) for some, _ in parts])
        which = np.repeat(np.arange(len(parts)), [len(some) for some, _ in parts])
        needed = self._needed(slots.astype(np.float64))
        spectrum = np.ones(points, np.complex128)
        of_blocks: dict[Any, Spectrum] = {}
        for block in _groups(slots // outer):
            fading = [
                block.start + np.r_[part] for part in _groups(slots[block.start : block.stop] // self._fading_block)
            ]
            name = tuple((needed[some].tobytes(), which[some].tobytes()) for some in fading)
            if name not in of_blocks:
                given = np.ones((len(nodes), points), np.complex128)
                for some in fading:
                    order = some[np.argsort(needed[some], kind="stable")]
                    factors = np.stack([np.ones(points), *(parts[i].w for i in which[order])]).cumprod(axis=0)
                    above = np.exp(
                        -np.append(0.0, needed[order]) * nodes[:, None]
                    )  # that at least so many are delivered
                    given *= (above - np.append(above[:, 1:], np.zeros((len(nodes), 1)), axis=1)) @ factors
                of_blocks[name] = weights @ given
            spectrum *= of_blocks[name]
        return spectrum

    def _count_variance(self, slots: range, outer: int) -> float:
        if not slots:
            return 0.0
        needed = self._needed(np.arange(slots.start, slots.stop, dtype=np.float64))
        return count_variance(needed, slots.start, outer, self._fading_block, self._standard_deviation)

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """Lost where fading and shadowing together give less power than the slot needs."""
        step = max(1, _AT_ONCE // uniforms.shape[2])
        return np.concatenate([self._fates(first + i, uniforms[i : i + step]) for i in range(0, len(uniforms), step)])

    def _fates(self, first: int, uniforms: Floats) -> Codes:
        """The same for so few slots that intermediate results fit into the cache."""
        slots = range(first, first + len(uniforms))
        needed = self._needed(np.arange(slots.start, slots.stop, dtype=np.float64))
        power, self._fade = _held(slots, self._fading_block, uniforms[:, 0], self._fade, lambda u: -log(1.0 - u))
        if self._standard_deviation:
            gain, self._shadow = _held(slots, self._shadowing_block, uniforms[:, 1], self._shadow, self._gain)
            power = power * gain
        return fates_of(power < needed[:, None])

    def _gain(self, u: Floats) -> Floats:
        """The shadowing's factor of the power: from the normal quantile of the upper 52 bits of a uniform number."""
        return exp(self._standard_deviation * normal_quantile((np.floor(u * 2.0**52) + 0.5) * 2.0**-52))

    def _needed(self, slots: Floats) -> Floats:
        """Power that fading and shadowing must give in each slot, (slots,), relative to its mean without shadowing."""
        (x, y), (to_x, to_y) = (way.at(slots) for way in self._ways)
        along, across = to_x - x, to_y - y
        square = along * along + across * across
        far = log(np.where(square > self._nearest, square, self._nearest) / self._nearest)
        return exp(self._margin + self._exponent * (0.5 * far))


def _held(
    slots: range, block: int, u: Floats, before: Floats | None, draw: Callable[[Floats], Floats]
) -> tuple[Floats, Floats]:
    """The number drawn for the block of each slot, (slots, R) or (1, R), and that for the last slot, (R,).

    before: that of the slot before the first, if there is one; it is never changed in place.
    """
    begins = np.arange(slots.start, slots.stop) % block == 0
    if before is None:
        begins[0] = True
        drawn = draw(u[begins])
    else:
        drawn = np.concatenate((before[None], draw(u[begins]))) if begins.any() else before[None]
    if begins.all():
        drawn = drawn[-len(slots) :]
    elif len(drawn) > 1:
        drawn = drawn[np.cumsum(begins) - (before is None)]
    return drawn, drawn[-1].copy()


def _shared_slot(sender: Way, receiver: Way) -> int | None:
    """A slot of a waypoint in which both are in one place, if there is one."""
    slots = np.array(sorted({*sender.slots, *receiver.slots}), np.float64)
    (x, y), (to_x, to_y) = sender.at(slots), receiver.at(slots)
    same = np.flatnonzero((x == to_x) & (y == to_y))
    return int(slots[same[0]]) if same.size else None


_NUMBERS_AT_ONCE = 1 << 20  # numbers


def _groups(numbers: NDArray[np.int64]) -> Iterator[range]:
    """The places of equal numbers next to each other."""
    marks = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
    return map(range, marks, marks[1:])


def shadowing_rule(standard_deviation: float) -> tuple[Floats, Floats]:
    """Nodes e^{−sz} and weights of the mean over the shadowing; s is the standard deviation in nepers of power, both (nodes,).

    The trapezoidal rule: its error is about exp(−π²/(sh)) for a step h, because exp(−c e^{−sz}) is bounded for |Im z| <
    π/(2s). With the step used here it is below 1e-11, while a Gauss–Hermite rule of 128 nodes is off by 1e-3 at 30 dB.
    """
    if standard_deviation == 0.0:
        return np.ones(1), np.ones(1)
    step = min(0.5, 0.357 / standard_deviation)
    ahead = math.ceil(9.0 / step)
    z = np.arange(-ahead, ahead + 1) * step
    weights = np.exp(-0.5 * z * z)
    return np.exp(-standard_deviation * z), weights / weights.sum()


def delivery_probability(needed: Floats, standard_deviation: float) -> Floats:
    """E exp(−c e^{−sZ}) for each needed power c, (slots,)."""
    nodes, weights = shadowing_rule(standard_deviation)
    step = max(1, _NUMBERS_AT_ONCE // len(nodes))
    parts = [np.exp(-needed[i : i + step, None] * nodes) @ weights for i in range(0, len(needed), step)]
    return np.concatenate(parts)


def count_variance(needed: Floats, first: int, outer: int, inner: int, standard_deviation: float) -> float:
    """Variance of the number of delivered slots among consecutive slots from `first` on that need these powers, (slots,).

    outer: slots for which the shadowing is held; inner: slots for which the fading is held, a divisor of outer.

    Given the shadowing of a block, the fading of its parts is independent, and two slots j, i of one part are both delivered
    with the smaller of their probabilities, exp(−max(c_j, c_i) e^{−sZ}).
    """
    if first % outer + len(needed) <= outer:
        outer = inner if first % inner + len(needed) <= inner else -(-(first % inner + len(needed)) // inner) * inner
        first %= inner
        if outer == inner:
            outer = inner = len(needed)
            first = 0
    lead = first % outer
    blocks = -(-(lead + len(needed)) // outer)
    padded = np.full(blocks * outer, np.inf)  # never delivered
    padded[lead : lead + len(needed)] = needed
    parts = np.sort(padded.reshape(blocks, outer // inner, inner), axis=2)
    step = max(1, _NUMBERS_AT_ONCE // outer)
    return sum_in_order(_variance_of(parts[i : i + step], standard_deviation) for i in range(0, blocks, step))


def _variance_of(parts: Floats, standard_deviation: float) -> float:
    """The same for whole blocks, (blocks, parts, slots), the powers of each part in ascending order."""
    pairs = 2.0 * np.arange(parts.shape[2]) + 1.0  # the number of pairs in a part in which a slot needs the most
    second, mean = 0.0, np.zeros(len(parts))
    for node, weight in zip(*shadowing_rule(standard_deviation), strict=True):
        delivered = np.exp(-parts * node)
        part = delivered.sum(axis=2)
        block = part.sum(axis=1)
        second += weight * float((delivered @ pairs - part * part).sum() + (block * block).sum())
        mean += weight * block
    return second - float((mean * mean).sum())
