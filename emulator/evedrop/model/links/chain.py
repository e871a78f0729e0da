"""A Markov chain of link states, and what losses in bursts follow from it.

Source: docs/mathematics/links.md, losses in bursts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evedrop.model.links.counts import Counted, Spectrum, Thinned
from evedrop.model.process import Floats

_MOST_STATES = 8  # of a chain whose packets are counted: the work grows with the cube


@dataclass(frozen=True)
class Chain:
    """A Markov chain of link states, which at slot 0 is in its stationary distribution."""

    transitions: Floats
    """Row: from, column: to, (states, states)."""
    stationary: Floats
    """The stationary distribution, (states,)."""
    quality: Floats
    """Probability that a packet is delivered in each state, (states,)."""

    @classmethod
    def recurrent(cls, transitions: Floats, stationary: Floats, quality: Floats) -> Chain:
        """The chain without its transient states, in which it never is."""
        met = stationary > 0.0
        return cls(transitions[met][:, met], stationary[met], quality[met])

    @property
    def independent(self) -> bool:
        """Whether the fates of all packets are independent and identically distributed: a single state, as in the paper."""
        return len(self.stationary) == 1

    def mean_burst(self, slots: int, unfinished: bool) -> float | None:
        """Mean length of the bursts of losses that end in so many slots: the packets lost in them over their number, as expected.

        unfinished: whether a burst in the last slot does not end there, so that it is left out. None if no burst ends.
        """
        lost = 1.0 - self.quality
        number = (slots - 1) * float((self.stationary * self.quality) @ self.transitions @ lost)
        packets, last = slots * float(self.stationary @ lost), float(self.stationary @ lost)
        if unfinished:
            # In the last burst are those packets after which all are lost.
            _, partial, _ = _power_and_sums(self.transitions * lost, slots, np.eye(len(lost)))
            packets, last = packets - float((self.stationary * lost) @ partial.sum(axis=1)), 0.0
        return packets / (number + last) if number + last > 0.0 else None

    def count_spectrum(self, parts: Sequence[Counted]) -> Spectrum | None:
        """The transform over this chain, stationary at the first of these ascending parts; None with too many states."""
        states = len(self.stationary)
        if states > _MOST_STATES:
            return None
        powers: dict[int, list[Spectrum]] = {}  # w → the step of each power of two of packets
        row = np.repeat(self.stationary[None].astype(np.complex128), len(parts[0].w), axis=0)
        at = parts[0].slots.start
        for slots, w in parts:
            row = row @ np.linalg.matrix_power(self.transitions, slots.start - at)
            if id(w) not in powers:
                powers[id(w)] = [(1.0 + self.quality * (w[:, None] - 1.0))[:, :, None] * self.transitions]
            steps = powers[id(w)]
            for bit in range(len(slots).bit_length()):
                if bit == len(steps):
                    steps.append(np.matmul(steps[-1], steps[-1]))
                if len(slots) >> bit & 1:
                    row = np.einsum("zs,zst->zt", row, steps[bit])
            at = slots.stop
        return np.asarray(row.sum(axis=1))

    def count_variance(self, parts: Sequence[Thinned]) -> float:
        """Variance of the number of packets of these ascending parts that get through; the chain continues between them.

        w is the row Σ passes_i E[(γ_i − mean); state at the present packet] over the packets i so far, so that the covariance of
        all of them with the packet is w · (quality − mean). Its entries sum to 0; so the chain's stationary part can be left out.
        """
        mean = float(self.stationary @ self.quality)
        centred = self.quality - mean
        fading = self.transitions - self.stationary
        sums: dict[int, tuple[Floats, Floats, Floats]] = {}
        w, at, total = np.zeros(len(centred)), parts[0].slots.start, 0.0
        for slots, passes in parts:
            count = len(slots)
            if count not in sums:
                sums[count] = _power_and_sums(fading, count, np.eye(len(fading)))
            power, partial, _ = sums[count]
            w = w @ np.linalg.matrix_power(fading, slots.start - at)
            own = passes**2 * count_variance(self.transitions, self.stationary, self.quality, count)
            total += own + passes * (1.0 - passes) * count * mean + 2.0 * passes * float(w @ partial @ centred)
            w = w @ power + passes * ((self.stationary * centred) @ partial @ fading)
            at = slots.stop
        return total


def count_variance(transitions: Floats, stationary: Floats, quality: Floats, slots: int) -> float:
    """Variance of the number of packets that a chain in its stationary distribution delivers in `slots` slots.

    transitions (states, states), stationary (states,), quality (states,): as in `Chain`; slots ≥ 1. Exact, by doubling: the
    number of matrix products grows with the logarithm of the slots.
    """
    mean = float(stationary @ quality)
    centred = quality - mean
    # Without the stationary part the chain's powers decay, and no large numbers are subtracted from each other.
    fading = transitions - stationary
    zeroth = np.eye(len(stationary)) - np.outer(np.ones(len(stationary)), stationary)
    _, _, total = _power_and_sums(fading, slots, zeroth)
    together = float((stationary * centred) @ (2.0 * total @ centred)) - slots * float(stationary @ (centred * centred))
    return max(0.0, together) + slots * float(stationary @ (quality * (1.0 - quality)))


def _power_and_sums(matrix: Floats, count: int, zeroth: Floats) -> tuple[Floats, Floats, Floats]:
    """Tⁿ, Σ_{j<n} T^j and Σ_{j<n} (n−j) T^j of a matrix T with n = `count`, by doubling; zeroth: T⁰."""
    power, partial, total = zeroth, np.zeros_like(matrix), np.zeros_like(matrix)
    done = 0
    for bit in f"{count:b}":
        total = total + done * partial + power @ total
        partial = partial + power @ partial
        power = power @ power
        done *= 2
        if bit == "1":
            partial = partial + power
            total = total + partial
            power = power @ matrix
            done += 1
    return power, partial, total
