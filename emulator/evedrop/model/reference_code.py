"""How a reference is carried from slot to slot, so that a packet is independent of the state that it is sent for.

Source: docs/mathematics.md, acknowledged references.
"""

from __future__ import annotations

from collections import deque
from typing import final

import numpy as np

from evedrop.model.kernels.current import kernels
from evedrop.model.kernels.elementary import cholesky
from evedrop.model.process import Floats, Process, StateFactors, product
from evedrop.model.staircase import is_nonsingular
from evedrop.model.theory.horizon import TOLERANCE, UNIT_ROUNDOFF

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

    Source: docs/mathematics.md, acknowledged references.
    """

    def __init__(self, process: Process, open_loop: bool = False, ages_kept: int = _OLDEST_KEPT) -> None:
        self._process, self._ages_kept = process, ages_kept
        self.decorrelates = not open_loop and is_nonsingular(process.A)
        """Whether packets are independent of the state that they are sent for: L is not A."""
        self._states = StateFactors(process)
        self._kept = max(2, _NUMBERS_KEPT // (_SLOTS_AT_ONCE * process.n * process.n))
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
            if len(self._blocks) == self._kept:
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
        self._keep(grown, [i for i, one in enumerate(total) if one <= self._limit])
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
    found = np.zeros_like(C)
    for i in range(n):
        rest = np.zeros((len(C), n))
        rest[:, i] = 1.0
        for j in range(i):
            rest -= C[:, i, j, None] * found[:, j]
        found[:, i] = rest / C[:, i, i, None]
    return found


def initial_factor(process: Process, first: int) -> Floats:
    """A factor of the state's covariance in slot `first`, (n, n), lower triangular."""
    if not first:
        return cholesky(process.initial_covariance)
    carried = np.concatenate([StateFactors(process).carried(first), process.noise_factor], axis=1)
    factor: Floats = kernels.triangular_factors(carried[None])[0]
    return factor
