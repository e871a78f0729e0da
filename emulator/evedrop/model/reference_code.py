"""Codes with references: a packet has the state minus a reference, so that it is independent of the state.

A code carries a reference from slot to slot. Its receivers read packets that contain the state minus a reference, or the state
itself with the reference of later packets. The error covariance X Xᵀ of each trial is kept as its factor X.
"""

from __future__ import annotations

from collections import deque
from enum import IntEnum
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels.current import kernels
from evedrop.model.kernels.elementary import cholesky
from evedrop.model.process import Floats, Process, StateFactors, product
from evedrop.model.receiver import Action, Belief, Codes, Flags, Receiver, Reception
from evedrop.model.schedule import state_factors
from evedrop.model.staircase import ROUNDING_OF_PACKETS, is_nonsingular, is_singular
from evedrop.model.theory.horizon import TOLERANCE, UNIT_ROUNDOFF


def triangular_solutions(L: Floats, z: Floats) -> Floats:
    """L⁻¹ z of many triangular matrices (R, n, n) and vectors (n, R); 0 where a row has no variance."""
    y = np.zeros_like(z)
    for i in range(len(z)):
        rest = z[i]
        for j in range(i):
            rest = rest - L[:, i, j] * y[j]
        pivot = L[:, i, i]
        y[i] = np.where(pivot > 0.0, rest / np.where(pivot > 0.0, pivot, 1.0), 0.0)
    return y


def squares(X: Floats) -> Floats:
    """X Xᵀ of every trial, (n, n, R)."""
    factors = X.transpose(2, 0, 1).copy()
    return product(factors, factors.swapaxes(1, 2).copy()).transpose(1, 2, 0)


NONE = -1
"""The reference slot of a packet that contains the state itself, because there is no reference."""
_SLOTS_AT_ONCE = 64
_NUMBERS_KEPT = 1 << 22  # of matrices L in memory, unless two blocks have more
_LARGEST = 1e150  # a standard deviation of the state whose square is a double
_OLDEST_KEPT = 1 << 12  # slots
_WATCHED = 16  # references whose size is followed


@final
class ReferenceCode:
    """The matrices L_k that carry a reference from slot k − 1 to slot k, and the age at which a reference is dropped.

    L_{t,k} = L_k ⋯ L_{t+1} = Σ_k A^{−mᵀ} Σ_t⁻¹ with m = k − t, so that Cov(x_k − L_{t,k} x_t, x_k) = 0. If A is singular, L = A.
    open_loop: L = A for any A. ages_kept: slots whose ages are kept; that of an older slot is computed again.

    Source: docs/mathematics/schemes.md, acknowledged references.
    """

    def __init__(self, process: Process, open_loop: bool = False, ages_kept: int = _OLDEST_KEPT) -> None:
        self._process, self._ages_kept = process, ages_kept
        self.decorrelates = not open_loop and is_nonsingular(process.A)
        """Whether packets are independent of the state that they are sent for: L is not A."""
        self._states = StateFactors(process)
        self._most_blocks = max(2, _NUMBERS_KEPT // (_SLOTS_AT_ONCE * process.n * process.n))
        self._blocks: dict[int, tuple[Floats, Floats]] = {}
        self._watch: _Watch
        self._watched: int
        self._oldest: deque[int]
        self._begin_to_watch()

    def at(self, k: int) -> Floats:
        """L_k, (n, n), for k ≥ 1."""
        return self._block_of(k)[0][k % _SLOTS_AT_ONCE] if self.decorrelates else self._process.A

    def standard_deviation(self, k: int) -> Floats:
        """The standard deviation of each entry of L_k x_{k−1}, (n,); 0 where L = A, whose rounding the horizon covers."""
        if not k or not self.decorrelates:
            return np.zeros(self._process.n)
        start = self._block_of(k)[1][k % _SLOTS_AT_ONCE]
        total = np.zeros(len(start))
        for column in start.T:
            total += column * column
        return np.sqrt(total)

    def oldest(self, k: int) -> int:
        """The oldest slot t whose reference may be used in slot k; k itself if there is none.

        2⁻⁵³ √tr(L_{t,j} Σ_t L_{t,j}ᵀ) ≤ 0.01 √Q[i, i] for all Q[i, i] > 0 and j up to k: beyond it x_j is lost in rounding.
        """
        if not self.decorrelates:
            return 0
        if k <= self._watched - len(self._oldest):
            self._begin_to_watch()
        for j in range(self._watched + 1, k + 1):
            steps, starts = self._block_of(j)
            row = j % _SLOTS_AT_ONCE
            self._oldest.append(self._watch.advanced(j, steps[row], starts[row]))
            self._watched = j
        return self._oldest[k - self._watched - 1]

    def _begin_to_watch(self) -> None:
        """Follow the sizes of references from slot 0 on; only the results of the last slots are kept."""
        self._watch = _Watch(self._process)
        self._watched = 0
        self._oldest = deque([0], self._ages_kept)

    def _block_of(self, k: int) -> tuple[Floats, Floats]:
        number = k // _SLOTS_AT_ONCE
        if number not in self._blocks:
            if len(self._blocks) == self._most_blocks:
                del self._blocks[min(self._blocks)]
            self._blocks[number] = self._computed(range(number * _SLOTS_AT_ONCE, (number + 1) * _SLOTS_AT_ONCE))
        return self._blocks[number]

    def _computed(self, slots: range) -> tuple[Floats, Floats]:
        """L_k, and a factor of L_k Σ_{k−1} L_kᵀ, of consecutive slots, (c, n, n); those of slot 0 have no meaning.

        With C Cᵀ = A Σ_{k−1} Aᵀ, C lower triangular, they are A + Q C⁻ᵀ C⁻¹ A and C + Q C⁻ᵀ: Σ_{k−1} is not formed.
        """
        carried = self._states.block(slots)
        unknown = ~(np.abs(carried).max(axis=(1, 2)) < _LARGEST)
        unknown[0] |= slots.start == 0
        carried[unknown] = np.eye(self._process.n)
        C = kernels.triangular_factors(carried)
        informed = product(np.broadcast_to(self._process.Q, C.shape), _inverses(C).swapaxes(1, 2).copy())
        back = product(_inverses(C), np.broadcast_to(self._process.A, C.shape).copy())
        steps, starts = self._process.A + product(informed, back), C + informed
        # Far beyond the horizon only A is left of L, and no reference can be used.
        steps[unknown], starts[unknown] = self._process.A, np.inf
        return steps, starts


@final
class _Watch:
    """Follows the size of some references from slot to slot: the older of two references is the larger one in every slot."""

    def __init__(self, process: Process) -> None:
        n = process.n
        # A state without noise of its own loses nothing in a slot.
        least = min((float(process.Q[i, i]) for i in range(n) if process.Q[i, i] > 0.0), default=0.0)
        self._limit = (TOLERANCE / UNIT_ROUNDOFF) ** 2 * least
        self._slots: list[int] = []
        self._factors: Floats = np.empty((0, n, n))
        self._spacing = 1

    def advanced(self, k: int, step: Floats, start: Floats) -> int:
        """The oldest slot whose reference may be used in slot k, which must follow the slot before.

        step: L_k; start: a factor of L_k Σ_{k−1} L_kᵀ, the size of the newest reference; both (n, n).
        """
        with np.errstate(over="ignore"):
            grown = product(np.broadcast_to(step, self._factors.shape), self._factors)
        if (k - 1) % self._spacing == 0:
            self._slots.append(k - 1)
            grown = np.concatenate([grown, start[None]])
        total = np.zeros(len(grown))
        for entry in grown.reshape(len(grown), step.size).T:
            total += np.minimum(np.abs(entry), _LARGEST) ** 2
        self._keep(grown, [i for i, traces in enumerate(total) if traces <= self._limit])
        if len(self._slots) > _WATCHED:
            self._spacing *= 2
            self._keep(self._factors, [i for i, slot in enumerate(self._slots) if slot % self._spacing == 0])
        return self._slots[0] if self._slots else k

    def _keep(self, factors: Floats, places: list[int]) -> None:
        self._slots = [self._slots[i] for i in places]
        self._factors = factors[places]


def singular_warnings(process: Process) -> list[str]:
    """The consequences of a singular A, for which there is no L with independent packets."""
    if is_nonsingular(process.A):
        return []
    return [
        "process.A is singular to double precision (max |A| · max |A⁻¹| exceeds 9e13), so no code makes packets independent of "
        "the state: references are carried by L = A, as in the scheme open-loop, and an eavesdropper that lost the reference "
        "learns the decaying modes from every packet; a nonsingular A prevents that"
    ]


def _inverses(C: Floats) -> Floats:
    """C⁻¹ of lower triangular matrices, (c, n, n)."""
    n = C.shape[1]
    inverses = np.zeros_like(C)
    for i in range(n):
        rest = np.zeros((len(C), n))
        rest[:, i] = 1.0
        for j in range(i):
            rest -= C[:, i, j, None] * inverses[:, j]
        inverses[:, i] = rest / C[:, i, i, None]
    return inverses


def initial_factor(process: Process, first: int) -> Floats:
    """A factor of the state's covariance in slot `first`, (n, n), lower triangular."""
    if not first:
        return cholesky(process.initial_covariance)
    factor: Floats = state_factors(process)(range(first, first + 1))[0]
    return factor


Slots = NDArray[np.int64]

NEGLIGIBLE = 1e-75
"""Of the noise: the square of such a standard deviation is lost in rounding, and its own square in underflow."""


class Content(IntEnum):
    """What a packet contains: the second number of a header that has two."""

    STATE = 0
    """x_k. The header's slot t is the reference of the sensor's next packets, carried by L."""
    CODED = 1
    """x_k − L_{t,k} x_t."""
    OPEN_LOOP = 2
    """x_k − A^{k−t} x_t."""


class _Known(NamedTuple):
    """A receiver's knowledge of (x, r) after slot s, in which it last read a packet; r is the reference carried to s.

    Their errors are the columns of [X; D] times independent standard normal variables.
    """

    x: Floats
    """(n, R)."""
    r: Floats
    """(n, R)."""
    X: Floats
    """(n, n, R)."""
    D: Floats
    """(n, n, R)."""
    s: Slots
    """(R,)."""
    t: Slots
    """The reference's slot, (R,); NONE: none is known."""
    by: Slots
    """`Content` of the packets with this reference, (R,)."""

    def taken(self, some: NDArray[np.intp]) -> _Known:
        """The same in some of the trials."""
        return _Known(*(part[..., some] for part in self))  # type: ignore[arg-type]

    def replaced(self, some: NDArray[np.intp], other: _Known) -> _Known:
        """The same with other knowledge in some of the trials."""
        parts = [part.copy() for part in self]
        for part, values in zip(parts, other, strict=True):
            part[..., some] = values
        return _Known(*parts)  # type: ignore[arg-type]


class ReferenceReceiver(Receiver):
    """The exact MMSE reader of packets with references, unless `informed`: a Kalman filter of the state x and the reference r.

    From slot to slot x ← A x + w, and r ← L x if the last packet was acknowledged, else L r. It learns which of the two
    happened from the header of the next packet that it hears, and only then repeats the slots since the last one. A packet shows
    x or x − r, without noise. The errors' covariance is carried as a factor, so nothing cancels.

    An estimator whose acknowledgements are not forged always has the reference, because it acknowledged it: r has no error.

    Source: docs/mathematics/schemes.md, acknowledged references.
    """

    def __init__(self, process: Process, trials: int, open_loop: bool = False) -> None:
        """open_loop: L = A in coded packets, too."""
        super().__init__(process, trials)
        self._code = ReferenceCode(process, open_loop)
        self._noise: list[Floats] = [np.zeros_like(process.Q), process.noise_factor]
        self._singular = is_singular(process)
        self._negligible = NEGLIGIBLE * float(np.abs(process.noise_factor).max())

    def prior(self, first: int = 0) -> Belief:
        """x̂ = 0, P = Σ, as the estimate of the slot before, or before slot 0 of slot 0 itself; no reference."""
        belief = super().prior(first)
        before = max(0, first - 1)
        X = np.repeat(initial_factor(self.process, before)[:, :, None], self.trials, axis=2)
        slots = (np.full(self.trials, value, np.int64) for value in (before, NONE, Content.STATE))
        return belief._replace(memory=_Known(belief.x_hat, belief.x_hat, X, np.zeros_like(X), *slots))

    def act(self, k: int, gamma: Flags) -> Codes:
        """Not available: the action depends on the packet's header."""
        raise NotImplementedError("the action in a slot depends on the packet's header; γ alone does not tell it")

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """(A x̂, A P Aᵀ + Q) if no packet is read; otherwise (z, 0), or z plus what is known of the reference.

        A packet without a header has no reference: it is taken for the state.
        """
        memory = _Known(*belief.memory)
        t, content = self._header(heard)
        by = np.where(content == Content.OPEN_LOOP, content, Content.CODED)
        named = heard.gamma & (t >= self._code.oldest(k)) & (t < k)
        old = named & (t == memory.t) & (by == memory.by)
        new = named & ~old & (t >= memory.s)
        state = heard.gamma & (content == Content.STATE)
        followed = old | new
        read = state | followed
        x_hat = self.process.predict(belief.x_hat) if k else belief.x_hat.copy()
        P = self.process.diffuse(self.process.carry(belief.P)) if k else belief.P.copy()
        action = np.where(heard.gamma, np.uint8(Action.DISCARDED), np.uint8(Action.LOST))
        alone = np.flatnonzero(state & ~followed)
        if len(alone):
            memory = memory.replaced(alone, self._only_state(k, heard.z[:, alone]))
        some = np.flatnonzero(followed)
        if len(some):
            before = memory.taken(some)._replace(t=t[some], by=by[some])
            after = self._filtered(k, before, new[some], state[some], heard.z[:, some])
            memory = memory.replaced(some, after)
        places = np.flatnonzero(read)
        if len(places):
            x_hat[:, places] = memory.x[:, places]
            P[:, :, places] = squares(memory.X[:, :, places])
            exact = ~memory.X[:, :, places].any(axis=(0, 1))
            action[places] = np.where(exact, np.uint8(Action.STATE), np.uint8(Action.INNOVATION))
        return Belief(x_hat, P, action, memory)

    def informed(self, k: int, x: Floats, belief: Belief) -> Belief:
        """The belief after slot k once that slot's true state x (n, R) is known as well; the reference stays as it was.

        Not optimal: later packets with a reference before slot k that it lacks are discarded. They would tell of the noise since,
        so an eavesdropper that is told a state may have a smaller error than this one, until a slot from k on is the reference.

        As a reference, x_k has the rounding of the sensor's arithmetic, which grows with every later reference made from it.
        """
        memory = _Known(*belief.memory)
        alone, some = np.flatnonzero(memory.t == NONE), np.flatnonzero(memory.t != NONE)
        after = memory.replaced(alone, self._only_state(k, x[:, alone]))
        if len(some):
            states = np.ones(len(some), np.bool_)
            after = after.replaced(some, self._filtered(k, memory.taken(some), ~states, states, x[:, some]))
        X = np.zeros_like(after.X)
        for i in range(len(x)):
            X[i, i] = UNIT_ROUNDOFF * (np.abs(x[i]) + self._code.standard_deviation(k)[i])
        return Belief(x, np.zeros_like(belief.P), belief.action, after._replace(X=X))

    def _header(self, heard: Reception) -> tuple[Slots, Slots]:
        """The slot and the content that the header names; without a second number, a packet with a reference is coded."""
        if heard.header is None:
            return np.full(self.trials, NONE, np.int64), np.full(self.trials, Content.STATE, np.int64)
        t, *more = heard.header
        return t, more[0] if more else np.where(t == NONE, Content.STATE, Content.CODED)

    def _only_state(self, k: int, z: Floats) -> _Known:
        """The knowledge after a packet that contains the state and names no reference that can be followed."""
        n, count = z.shape
        nothing = np.zeros((n, n, count))
        slots = (np.full(count, value, np.int64) for value in (k, NONE, Content.STATE))
        return _Known(z, np.zeros_like(z), nothing, nothing, *slots)

    def _filtered(self, k: int, memory: _Known, new: Flags, state: Flags, z: Floats) -> _Known:
        """The knowledge after a packet of slot k with the reference of slot `known.t`.

        new: whether this reference is new, so that t ≥ s; state: whether the packet contains the state.
        """
        n = self.process.n
        x, r, X, R, noise = self._repeated(k, memory, new)
        shown = np.where(state, x, x - r)
        top = np.where(state, X, X - R)
        if self._singular:
            # A direction without noise is known up to the rounding of x, r and z.
            size = np.abs(x) + np.abs(r) + np.abs(z) + self._code.standard_deviation(k)[:, None]
            top = np.concatenate([top, ROUNDING_OF_PACKETS * size[:, None, :] * np.eye(n)[:, :, None]], axis=1)
            R = np.concatenate([R, 0.0 * noise], axis=1)
        joint = np.concatenate([np.concatenate([noise, top], axis=1), np.concatenate([0.0 * noise, R], axis=1)])
        joint = np.where(np.abs(joint) < self._negligible, 0.0, joint)
        factors = kernels.triangular_factors(joint.transpose(2, 0, 1).copy())
        white = triangular_solutions(factors[:, :n, :n], z - shown)
        r = r + product(factors[:, n:, :n].copy(), white.T[:, :, None].copy())[:, :, 0].T
        D = factors[:, n:, n:].transpose(1, 2, 0)
        # A coded packet shows x − r exactly, so that the errors of x and r are the same from here on.
        return memory._replace(
            x=np.where(state, z, z + r), r=r, X=np.where(state, 0.0, D), D=D, s=np.full_like(memory.s, k)
        )

    def _repeated(self, k: int, memory: _Known, new: Flags) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """The slots after s up to k: x, r (n, R), the columns of their errors (n, m, R), and noise in x alone (n, n, R)."""
        s, t = memory.s, memory.t
        begun = new & (t == s)
        x, r = memory.x, np.where(begun, memory.x, memory.r)
        X, R = memory.X, np.where(begun, memory.X, memory.D)
        later = new & (t > s)
        if later.any():
            # The noise between s and t is in both x and r.
            X, R = (np.concatenate([part, np.zeros_like(memory.X)], axis=1) for part in (X, R))
        open_loop = memory.by == Content.OPEN_LOOP
        for j in range(int(s.min()) + 1, k + 1):
            moved, carried = s < j, np.where(new, t < j, s < j)
            x, X = (np.where(moved, self._times(self.process.A, part), part) for part in (x, X))
            r, R = (np.where(carried, self._carried(j, part, open_loop), part) for part in (r, R))
            begins = later & (t == j)
            if begins.any():
                X[:, self.process.n :, begins] = self._noise_over((t - s)[begins])
                r, R = np.where(begins, x, r), np.where(begins, X, R)
        return x, r, X, R, self._noise_over(k - np.where(new, t, s))

    def _carried(self, j: int, part: Floats, open_loop: Flags) -> Floats:
        """References, or columns of their errors, carried from slot j − 1 to j."""
        if not open_loop.any():
            return self._times(self._code.at(j), part)
        by_A = self._times(self.process.A, part)
        return by_A if open_loop.all() else np.where(open_loop, by_A, self._times(self._code.at(j), part))

    def _times(self, M: Floats, part: Floats) -> Floats:
        """M times every column, (n, …, R)."""
        return product(M, part.reshape(len(part), -1)).reshape(part.shape)

    def _noise_over(self, slots: Slots) -> Floats:
        """Factors of Σ_{l<m} A^l Q A^lᵀ, the noise of m slots, for each of the slots' numbers (R,): (n, n, R)."""
        while len(self._noise) <= int(slots.max()):
            grown = np.concatenate([product(self.process.A, self._noise[-1]), self.process.noise_factor], axis=1)
            self._noise.append(kernels.triangular_factors(grown[None])[0])
        return np.array([self._noise[m] for m in slots.tolist()]).transpose(1, 2, 0)
