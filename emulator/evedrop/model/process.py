"""The process x_{k+1} = A x_k + w_k, its checks, and its simulation over a batch of trials.

Arrays of a batch have the trials as last axis: x is (n, R), P is (n, n, R). The two products below are elementwise over
that axis, in a fixed order, so a trial's bits do not depend on the batch or the machine.

Source: docs/mathematics/model.md, model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from random import Random
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels.current import kernels
from evedrop.model.kernels.elementary import cholesky, is_semidefinite, semidefinite_factor
from evedrop.model.kernels.reference import carry
from evedrop.model.streams import Ahead, Batch, BlockReader

Floats = NDArray[np.float64]
Limits = np.ndarray[tuple[int], np.dtype[np.float64]]
"""Numbers that may be infinite: no limit."""

MARGINAL = 1e-7
"""An eigenvalue of A within this distance of the unit circle counts as on it: computing a double one has errors of 1e-8."""
_LAST_BITS = 2.0**-50
MOST_STATES = 64
"""The most states of a process: some computations before a run take a time that grows with n³ or faster."""
_SLOTS_AT_ONCE = 1024  # whose factors are passed over
_ALLOWS_SINGULAR = "; or singular_noise = true, which allows a Q without variance in some directions"
_REACHED = 1e-12  # a smaller singular value of what noise reaches, relative to the largest, is rounding
_LEAST_VARIANCE, _LARGEST_VARIANCE = 1e-100, 1e100  # whose squares, summed over trials, are within double precision
_SINGULAR = 1e-13  # smallest eigenvalue of a correlation matrix that is not mere rounding


def product(M: Floats, x: Floats) -> Floats:
    """M x for every trial: M (…, m, n), x (…, n, R) → (…, m, R), with at most one axis before the last two."""
    if M.ndim == x.ndim == 2:
        products: Floats = kernels.product(M[None], x[None])[0]
        return products
    return kernels.product(np.broadcast_to(M, (len(x), *M.shape[-2:])), x)


def eigenvalues(A: Floats) -> NDArray[np.complex128]:
    """The eigenvalues of A, (n,): where rounding has split a multiple one, which it does by up to 1e-5 and more, its mean.

    Those that lie no further apart than a change of the last bits of A moves them count as one.
    """
    values = np.linalg.eigvals(A).astype(np.complex128)
    # Not by numpy.random, which takes 2 MB of every process.
    numbers = np.frombuffer(Random(0).randbytes(4 * A.size), np.uint8).reshape(4, *A.shape)  # noqa: S311 - no secret
    signs, moved = np.where(numbers < 128, -_LAST_BITS, _LAST_BITS), np.zeros(len(A))
    for changed in np.linalg.eigvals(A * (1.0 + signs)):
        moved = np.maximum(moved, np.abs(values[:, None] - changed).min(axis=1))
    alike = np.abs(values[:, None] - values) <= 4.0 * (moved[:, None] + moved)
    for _ in range(len(A).bit_length()):
        alike = alike @ alike
    return np.asarray((alike @ values) / alike.sum(axis=1))


def modulus_in(A: Floats) -> Callable[[float, float], float]:
    """A function of the real and the imaginary part of an eigenvalue of A, as computed: its modulus by `eigenvalues`."""
    values = eigenvalues(A)
    return lambda real, imaginary: float(np.abs(values[np.abs(values - complex(real, imaginary)).argmin()]))


@dataclass(frozen=True)
class Process:
    """A (n, n), Q (n, n), initial_covariance Σ0 (n, n): the process model, which is public, also to eavesdroppers."""

    A: Floats
    Q: Floats
    initial_covariance: Floats
    singular_noise: bool = False
    """Whether Q may be singular, as the covariance of a filter's innovations may be."""

    @cached_property
    def noise_factor(self) -> Floats:
        """Lower triangular G with G Gᵀ = Q, (n, n)."""
        return semidefinite_factor(self.Q) if self.singular_noise else cholesky(self.Q)

    @property
    def matrices(self) -> tuple[Floats, Floats, Floats]:
        """A, Q and Σ0."""
        return self.A, self.Q, self.initial_covariance

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @cached_property
    def spectral_radius(self) -> float:
        """ρ(A): largest modulus of an eigenvalue of A."""
        return float(np.max(np.abs(eigenvalues(self.A))))

    @cached_property
    def _Q_column(self) -> Floats:
        return self.Q[:, :, None]

    def predict(self, x_hat: Floats) -> Floats:
        """A x̂, (n, R)."""
        return product(self.A, x_hat)

    def carry(self, P: Floats) -> Floats:
        """A P Aᵀ, (n, n, R): the covariance when w is known."""
        return carry(self.A, P)

    def diffuse(self, carried: Floats) -> Floats:
        """A P Aᵀ + Q from A P Aᵀ, (n, n, R): the covariance when w is not known."""
        return carried + self._Q_column


@final
class ProcessNoise:
    """x_0 = L0 ξ_0 at k = 0, then w_{k−1} = L_Q ξ_k, for every trial, with ξ from the stream `process`.

    initial: x_0 (n, R), if a scheme's secret decides it; covariance: of w, (n, n), semidefinite, if it is not Q.
    """

    def __init__(
        self,
        process: Process,
        key: bytes,
        batch: Batch,
        initial: Floats | None = None,
        covariance: Floats | None = None,
    ) -> None:
        self._initial = initial
        self._reader = BlockReader(key, batch, process.n)
        self._initial_factor = cholesky(process.initial_covariance)
        self._factor = process.noise_factor if covariance is None else semidefinite_factor(covariance)
        self._noise = Ahead(self._reader.ahead, self._drawn)

    def block(self, slots: range) -> Floats:
        """The noise that each of consecutive slots k adds to A x_{k−1}, (c, n, R)."""
        return self._noise.of(slots)

    def _drawn(self, slots: range) -> Floats:
        factors = np.repeat(self._factor[None], len(slots), axis=0)
        if slots.start == 0:
            factors[0] = self._initial_factor
        noise = product(factors, self._reader.normals(slots))
        if slots.start == 0 and self._initial is not None:
            noise[0] = self._initial
        return noise


@final
class Trajectory:
    """The true states of a batch: x_0, then x_k = A x_{k−1} + w_{k−1}. Must be read slot by slot.

    initial, covariance: as for `ProcessNoise`.
    """

    def __init__(
        self,
        process: Process,
        key: bytes,
        batch: Batch,
        initial: Floats | None = None,
        covariance: Floats | None = None,
    ) -> None:
        self._process = process
        self._noise = ProcessNoise(process, key, batch, initial, covariance)
        self._next = 0
        self.x: Floats = np.zeros((process.n, batch.trials))
        self.predicted: Floats = self.x
        """A x_{k−1}, (n, R): the innovation of this slot is measured against it."""

    def advance(self, pushed: Floats | None = None) -> Floats:
        """The next slot's state, (n, R); pushed: the effect of inputs and disturbances on it, (n, R) or (n, 1)."""
        self.advance_block(1)
        if pushed is not None:
            self.x = self.x + pushed
        return self.x

    def advance_block(self, count: int) -> tuple[Floats, Floats]:
        """The states of the next `count` slots and the predictions A x_{k−1} of each, (c, n, R), without inputs."""
        slots = range(self._next, self._next + count)
        noise = self._noise.block(slots)
        if slots.start == 0:
            first, self.x = self.predicted, noise[0]
            later, x = kernels.advance(self._process.A, noise[1:], self.x)
            predicted, x = np.concatenate([first[None], later]), np.concatenate([noise[:1], x])
        else:
            predicted, x = kernels.advance(self._process.A, noise, self.x)
        self.predicted, self.x = predicted[-1], x[-1]
        self._next = slots.stop
        return x, predicted


@final
class StateFactors:
    """L_k with L_k L_kᵀ = Σ_k, lower triangular with positive diagonal, by QR of [A L_{k−1}, Q^½].

    Σ_k itself is never formed: in the unstable example its Cholesky factorisation fails from k = 45 on.

    Source: docs/mathematics/numerics.md, encoding noise.
    """

    def __init__(self, process: Process) -> None:
        self._A = process.A
        self._noise_factor = process.noise_factor
        self._initial = product(self._A, cholesky(process.initial_covariance))
        self._k = 1
        self._carried = self._initial

    def block(self, slots: range) -> Floats:
        """A L_{k−1} of consecutive slots, at least one, (c, n, n); 0 for slot 0. Slots in order are fastest.

        It is a factor of the encoding noise's covariance A Σ_{k−1} Aᵀ.
        """
        first = max(slots.start, 1)
        if first < self._k:
            self._k, self._carried = 1, self._initial
        while self._k < first:
            count = min(first - self._k, _SLOTS_AT_ONCE)
            self._carried = kernels.carried_factors(self._A, self._noise_factor, self._carried, count)[-1].copy()
            self._k += count
        factors = np.zeros((len(slots), *self._A.shape))
        if slots.stop > first:
            rows = factors[first - slots.start :]
            rows[0] = self._carried
            rows[1:] = kernels.carried_factors(self._A, self._noise_factor, self._carried, len(rows) - 1)
            self._k, self._carried = slots.stop - 1, rows[-1].copy()
        return factors


def mistakes_of(
    A: Floats, Q: Floats, initial_covariance: Floats, singular_noise: bool = False
) -> list[tuple[str, str]]:
    """All reasons why the three are not a process: (entry, sentence) for each mistake.

    singular_noise: Q may be singular.

    Source: docs/mathematics/model.md, model (assumptions).
    """
    mistakes: list[tuple[str, str]] = []
    if max(map(len, (A, Q, initial_covariance))) > MOST_STATES:
        large = f"has {max(map(len, (A, Q, initial_covariance)))} rows; expected at most {MOST_STATES} states"
        return [("A", f"{large}: theory and check take time that grows with the cube of their number, and more")]
    for name, M in (("A", A), ("Q", Q), ("initial_covariance", initial_covariance)):
        mistakes += [(name, sentence) for sentence in _shape_mistakes(M, A.shape[0] if name != "A" else None)]
    if mistakes:
        return mistakes
    for name, M in (("Q", Q), ("initial_covariance", initial_covariance)):
        mistakes += [(name, sentence) for sentence in _covariance_mistakes(M)]
    if singular_noise:
        mistakes = [entry for entry in mistakes if entry[0] != "Q" or "positive definite" not in entry[1]]
        return (
            mistakes if is_semidefinite(Q) else [*mistakes, ("Q", "has an eigenvalue below 0; expected a covariance")]
        )
    if any(name == "Q" and "positive definite" in sentence for name, sentence in mistakes):
        reached = invariant_hull(A, Q, _REACHED).shape[1]
        if reached < A.shape[0]:
            mistakes.append(
                ("Q", f"the pair (A, √Q) is not controllable: the noise reaches {reached} of {A.shape[0]} directions; "
                 "expected process noise that moves every state, such as Q = 1e-3 times the identity")
            )  # fmt: skip
        if is_semidefinite(Q):
            mistakes = [
                (name, f"{sentence}{_ALLOWS_SINGULAR}" if name == "Q" else sentence) for name, sentence in mistakes
            ]
    return mistakes


def _shape_mistakes(M: Floats, n: int | None) -> list[str]:
    if M.ndim != 2 or M.shape[0] != M.shape[1] or M.shape[0] == 0:
        return [f"has shape {M.shape}; expected a square matrix, such as [[1.0, 0.3], [0.5, 1.001]]"]
    if n is not None and M.shape[0] != n:
        return [f"is {M.shape[0]} × {M.shape[0]}; expected {n} × {n}, as A is"]
    for i, j in np.argwhere(~np.isfinite(M)):
        return [f"entry [{i}][{j}] is {M[i, j]}; expected finite numbers"]
    return []


def _covariance_mistakes(M: Floats) -> list[str]:
    asymmetry = np.argwhere(M != M.T)
    if asymmetry.size:
        i, j = asymmetry[0]
        return [f"entry [{i}][{j}] is {M[i, j]} but [{j}][{i}] is {M[j, i]}; expected a symmetric matrix"]
    largest = float(np.abs(np.diag(M)).max())
    if largest and not _LEAST_VARIANCE <= largest <= _LARGEST_VARIANCE:
        span = f"from {_LEAST_VARIANCE:g} to {_LARGEST_VARIANCE:g}"
        return [f"has the variance {largest:g} as its largest; expected one {span}: choose other units of the states"]
    scale = np.sqrt(np.abs(np.diag(M)))
    lowest = float(np.linalg.eigvalsh(M)[0])
    if not np.all(np.diag(M) > 0.0):
        return [f"has the eigenvalue {lowest:.3g}; expected a positive definite matrix, all eigenvalues above 0"]
    # The eigenvalues of the correlations do not depend on the states' units; the limit allows for rounding in a singular M.
    least = float(np.linalg.eigvalsh(M / np.outer(scale, scale))[0])
    if least <= _SINGULAR:
        return [
            f"has the eigenvalue {lowest:.3g}; expected a positive definite matrix: the smallest eigenvalue of its correlation "
            f"matrix is {least:.3g}, and must exceed {_SINGULAR:g} to be told from 0 in double precision"
        ]
    return []


def invariant_hull(A: Floats, columns: Floats, least: float) -> Floats:
    """An orthonormal basis, (n, s), of the smallest invariant subspace of A that contains these columns.

    It is extended one power at a time, because powers of A itself overflow. least: a singular value that is smaller, relative to
    the largest, is taken for 0.
    """
    scale = max(1.0, float(np.abs(A).max()))
    basis = _range(columns, least)
    while 0 < basis.shape[1] < len(A):
        grown = _range(np.hstack([basis, (A / scale) @ basis]), least)
        if grown.shape[1] == basis.shape[1]:
            break
        basis = grown
    return basis


def _range(columns: Floats, least: float) -> Floats:
    if not columns.shape[1]:
        return columns
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(u[:, s > least * max(s[0], 1e-300)])


SLOTS_AT_ONCE = 2**14
"""The most slots in a part."""


def parts_of(slots: range) -> Iterator[range]:
    """Consecutive slots in parts, in order; none if there are no slots."""
    for first in range(slots.start, slots.stop, SLOTS_AT_ONCE):
        yield range(first, min(slots.stop, first + SLOTS_AT_ONCE))
