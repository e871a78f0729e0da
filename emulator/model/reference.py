"""Packets that contain the state minus a reference, and receivers that read them from what they know of the reference.

A packet is z = x_k − L^{k−t} x_t, with t in the header, or x_k itself with t = −1. How a receiver reads the packet depends
on its knowledge of x_t.

Source: docs/mathematics.md, acknowledged references.
"""

from __future__ import annotations

from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.kernels.elementary import inverse
from evedrop.model.process import Floats, Process, product
from evedrop.model.receiver import Action, Belief, Codes, Flags, Receiver, Reception, trace_of
from evedrop.model.theory.covariances import radius
from evedrop.model.theory.horizon import TOLERANCE, UNIT_ROUNDOFF

Slots = NDArray[np.int64]

NONE = -1
"""The reference slot of a packet that contains the state itself."""
_DOUBLINGS = 60
_MOST_SLOTS = 2**62


@final
class ReferenceCode:
    """How a reference is carried from slot to slot: by L = A, or, for stable A, by L = Σ A⁻ᵀ Σ⁻¹."""

    def __init__(self, process: Process) -> None:
        self._process = process
        self.decorrelates = radius(process) < 1.0 and np.linalg.matrix_rank(process.A) == process.n
        """Whether A is stable, so that a packet is made independent of the state it leads to."""

    @cached_property
    def L(self) -> Floats:
        """The matrix L, (n, n)."""
        A = self._process.A
        if not self.decorrelates:
            return A
        sigma = stationary_covariance(self._process)
        return product(product(sigma, inverse(A).T.copy()), inverse(sigma))

    @cached_property
    def longest(self) -> int:
        """The largest age of a reference in slots: beyond it, L^m x_t of a stable A is so large that x_k is lost in rounding."""
        if not self.decorrelates:
            return _MOST_SLOTS
        sigma = stationary_covariance(self._process)
        n = self._process.n
        least = min(float(self._process.Q[i, i]) for i in range(n))
        limit = (TOLERANCE / UNIT_ROUNDOFF) ** 2 * least

        def carried(power: Floats, spread: Floats) -> Floats:
            return product(product(power, spread), power.T.copy())

        def within(spread: Floats) -> bool:
            return sum(float(spread[i, i]) for i in range(n)) <= limit

        # L^m Σ L^mᵀ grows with m, because A Σ Aᵀ ≤ Σ. So the largest m is found bit by bit, from powers of L by doubling.
        powers = [self.L]
        slots, grown = 0, sigma
        with np.errstate(over="ignore", invalid="ignore"):
            while len(powers) < _DOUBLINGS and within(carried(powers[-1], sigma)):
                powers.append(product(powers[-1], powers[-1]))
            for j in reversed(range(len(powers))):
                further = carried(powers[j], grown)
                if within(further):
                    slots, grown = slots + 2**j, further
        return slots

    def carry(self, reference: Floats) -> Floats:
        """L times a reference, (n, R)."""
        return product(self.L, reference)


def stationary_covariance(process: Process) -> Floats:
    """Σ = A Σ Aᵀ + Q of a stable process, (n, n), by doubling, with the same bits on every machine."""
    sigma, power = process.Q, process.A
    for _ in range(_DOUBLINGS):
        sigma = sigma + product(product(power, sigma), power.T.copy())
        power = product(power, power)
    return sigma


class ReferenceReceiver(Receiver):
    """The exact MMSE reader for L = A; for a decorrelating code, a reader that decodes what it can and otherwise predicts.

    x_k = z + L^{k−t} x_t, so x̂_k = z + L^{k−t} x̂_t, whose only error is that of x̂_t. For L = A nothing that is heard after
    slot t adds knowledge of x_t, so this is optimal. Its memory, all carried to the current slot: the estimate of the last
    slot in which it read a packet, with its covariance; the same for that packet's reference; and both slots. An
    acknowledged slot in between, in which it heard nothing, is predicted from the former.

    Unless acknowledgements are forged, the legitimate estimator always has the reference, because it acknowledged it.
    """

    def __init__(self, process: Process, trials: int) -> None:
        super().__init__(process, trials)
        self._code = ReferenceCode(process)
        self._terms: list[Floats] = [process.Q[:, :, None]]

    def prior(self, first: int = 0) -> Belief:
        """x̂ = 0, P = Σ, as the estimate of the slot before, or before slot 0 of slot 0 itself; no reference."""
        belief = super().prior(first)
        none = np.full(self.trials, NONE, np.int64)
        last = np.full(self.trials, max(0, first - 1), np.int64)
        return belief._replace(memory=(belief.x_hat, belief.P, belief.x_hat, np.zeros_like(belief.P), last, none))

    def act(self, k: int, gamma: Flags) -> Codes:
        """Not available: the action depends on the packet's header."""
        raise NotImplementedError("the action in a slot depends on the packet's header; γ alone does not tell it")

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """(A x̂, A P Aᵀ + Q) if no packet is read; otherwise (z, 0), or z plus the knowledge of the reference.

        A packet without a header has no reference: it is taken for the state.
        """
        latest, spread, kept, kept_spread, last, named = self._carried(k, belief)
        t = np.full(self.trials, NONE, np.int64) if heard.header is None else heard.header[0]
        state = heard.gamma & (t == NONE)
        old = heard.gamma & (t >= 0) & (t == named)
        new = heard.gamma & ~old & (t >= last) & (t < k)
        reference = np.where(old, kept, latest)
        certainty = np.where(old, kept_spread, spread + self._diffused_since(k, last, t, new))
        exact = trace_of(certainty) == 0.0
        if self._code.decorrelates:
            young = (t >= 0) & (k - np.where(new | old, t, 0) <= self._code.longest)
            old, new = old & exact & young, new & exact & young
        decoded = old | new
        action = np.where(heard.gamma, np.uint8(Action.DISCARDED), np.uint8(Action.LOST))
        action[decoded] = Action.INNOVATION
        action[state | (decoded & exact)] = Action.STATE
        predicted = self.process.predict(belief.x_hat) if k else belief.x_hat
        x_hat = np.where(state, heard.z, np.where(decoded, np.where(decoded, heard.z, 0.0) + reference, predicted))
        unread = self.process.diffuse(self.process.carry(belief.P)) if k else belief.P
        P = np.where(state, 0.0, np.where(decoded, certainty, unread))
        read = state | decoded
        memory = (
            np.where(read, x_hat, latest),
            np.where(read, P, spread),
            np.where(new, reference, kept),
            np.where(new, certainty, kept_spread),
            np.where(read, k, last),
            np.where(state, NONE, np.where(decoded, t, named)),
        )
        return Belief(x_hat, P, action, memory)

    def _carried(self, k: int, belief: Belief) -> tuple[Floats, Floats, Floats, Floats, Slots, Slots]:
        """The memory, carried from slot k − 1 to k."""
        latest, spread, kept, kept_spread, last, named = belief.memory
        if k == 0:
            return latest, spread, kept, kept_spread, last, named
        if self._code.decorrelates:
            # A reference too old to be named again is dropped before it overflows.
            latest = np.where(k - last <= self._code.longest, latest, 0.0)
            kept = np.where(k - named <= self._code.longest, kept, 0.0)
        carry, widen = self._code.carry, self.process.carry
        return carry(latest), widen(spread), carry(kept), widen(kept_spread), last, named

    def _diffused_since(self, k: int, last: Slots, t: Slots, where: Flags) -> Floats:
        """Σ A^j Q A^jᵀ over k−t ≤ j < k−last, (n, n, R): process noise up to slot t, carried to k; 0 outside `where`."""
        n = self.process.n
        total = np.zeros((n, n, self.trials))
        if not np.any(where & (t > last)):
            return total
        nearest, farthest = k - np.where(where, t, k), np.where(where, k - last, 0)
        for j in range(int(nearest[where].min()), int(farthest.max())):
            while len(self._terms) <= j:
                self._terms.append(self.process.carry(self._terms[-1]))
            total += np.where(where & (nearest <= j) & (j < farthest), self._terms[j], 0.0)
        return total
