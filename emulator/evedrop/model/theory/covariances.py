"""A receiver's error covariance by theory: its expectation in every slot, its limit, its bounds and its tails.

Its expected error grows without bound in the directions that touch an unstable part which the receiver does not see.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, final

import numpy as np

from evedrop.model.process import MARGINAL, Floats, Process, eigenvalues, invariant_hull, modulus_in
from evedrop.model.streams import BlockByBlock
from evedrop.model.theory.leak import RemainingCovariances, remaining_limit

_BLOCK = 256  # slots computed from one starting point: long enough to hide Python's overhead, quick to set up (3 ms)
_LARGEST_POWER = 1e100  # bound on A's entries within a block, far from overflow
_CANCELS = 10.0  # the sum of a power's terms, relative to the power: up to 1.3 without multiple eigenvalues
_ROUNDING = 1e-12
_FEW_STATES = 9  # n² equations are solved at once, which takes a tenth of SciPy's time; it does the same up to here
LARGEST_OPERATOR = 512
"""The most rows of a linear operator whose limit is computed, which takes some seconds; beyond it no limit is given."""


@dataclass(frozen=True)
class Outcomes:
    """Probabilities of a receiver's actions in a slot k ≥ 1; `predicted`, `decoded`, `leaked`, `state`, `misled` sum to 1.

    Source: docs/mathematics/model.md, expectations.
    """

    predicted: float
    """p_d: dropped, or discarded. P ← A P Aᵀ + Q."""
    state: float
    """p_r: the state was used. P ← 0."""
    misled: float
    """p_i of an eavesdropper: an innovation was used as if it were the state. P ← f_k = 2 A Σ_{k−1} Aᵀ."""
    decoded: float
    """p_i of the legitimate estimator: an innovation was decoded. P ← A P Aᵀ."""
    initial: float
    """p_0: the packet of slot 0, always the state, was not used. P_0 = Σ0."""
    leaked: float = 0.0
    """p_l of the genie: an innovation was read for what it leaks. P ← A P Aᵀ + Q − QΣ_k⁻¹Q."""

    @classmethod
    def legitimate(cls, mu: float, mu_d: float) -> Outcomes:
        """The estimator with the secret, behind a link of quality μ; μ_d is P(ν = 0)."""
        return cls(predicted=1.0 - mu, state=mu * mu_d, misled=0.0, decoded=mu * (1.0 - mu_d), initial=1.0 - mu)

    @classmethod
    def plain(cls, mu: float) -> Outcomes:
        """Any receiver of a sensor that always sends the state."""
        return cls.legitimate(mu, 1.0)

    @classmethod
    def eavesdropper(cls, mu_e: float, mu_d: float, use_state: float, use_innovation: float) -> Outcomes:
        """A receiver behind a link of quality μ_e that uses packets with P(b=1 | ν=0) and P(b=1 | ν=1)."""
        state = mu_e * mu_d * use_state
        misled = mu_e * (1.0 - mu_d) * use_innovation
        discarded = mu_d * (1.0 - use_state) + (1.0 - mu_d) * (1.0 - use_innovation)
        lost = 1.0 - mu_e
        return cls(lost + mu_e * discarded, state, misled, decoded=0.0, initial=lost + mu_e * (1.0 - use_state))

    @classmethod
    def genie(cls, mu_e: float, mu_d: float) -> Outcomes:
        """A receiver that knows the type of every packet and uses all information in it, behind a link of quality μ_e.

        Source: docs/mathematics/eavesdroppers.md, genie.
        """
        return cls(1.0 - mu_e, mu_e * mu_d, misled=0.0, decoded=0.0, initial=1.0 - mu_e, leaked=mu_e * (1.0 - mu_d))

    @property
    def reported(self) -> Outcomes:
        """The same with every used packet counted as the state, as the receiver's own covariance assumes."""
        return replace(self, state=self.state + self.misled, misled=0.0)

    @property
    def propagated(self) -> float:
        """Probability that the error is predicted to the next slot, and set neither to 0 nor to f_k."""
        return self.predicted + self.decoded + self.leaked


OutcomesAt = Callable[[float], Outcomes]
"""Maps the quality of a link to the outcomes at its receiver."""
SlotOutcomes = Callable[[int], OutcomesAt]
"""Maps a slot to the outcomes in it, by the quality of the link."""

NOBODY = Outcomes(predicted=1.0, state=0.0, misled=0.0, decoded=0.0, initial=1.0)
"""The outcomes of a receiver without packets: its error covariance is that of the state itself."""


def without_cancellation(process: Process) -> tuple[Process, Floats | None]:
    """The process of Zᵀx and Z, orthogonal, (n, n), if products of powers of A cancel; otherwise the process itself and None.

    They do with a multiple eigenvalue on the unit circle, unless A is triangular: in A^j P A^jᵀ numbers of the size j² |P| then
    leave a result of the size of P. Zᵀ A Z, the real Schur form, is triangular.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        half = np.linalg.matrix_power(process.A, _BLOCK // 2)
        if not _CANCELS * np.abs(half @ half).max() < (np.abs(half) @ np.abs(half)).max():
            return process, None
    A, Z = _triangular(process.A)
    Q, initial = (Z.T @ covariance @ Z for covariance in (process.Q, process.initial_covariance))
    return Process(A, 0.5 * (Q + Q.T), 0.5 * (initial + initial.T), process.singular_noise), Z


def _triangular(A: Floats) -> tuple[Floats, Floats]:
    """Zᵀ A Z, block triangular, and Z, orthogonal, (n, n) each: the real eigenvalues first, then 2 × 2 blocks.

    Rounding does not split a multiple real eigenvalue: its mean is split off, each time with the nearest eigenvector.
    """
    from scipy.linalg import schur  # noqa: PLC0415 - slow to import

    values = eigenvalues(A)
    real = values.real[np.abs(values.imag) <= _ROUNDING * np.abs(values)]
    Z, rest = np.eye(len(A)), A
    for first, value in enumerate(real):
        turn = np.linalg.svd(rest - value * np.eye(len(rest)))[2][::-1].T
        Z[:, first:] = Z[:, first:] @ turn
        rest = (turn.T @ rest @ turn)[1:, 1:]
    count = len(real)
    if rest.size:
        rest, turn = schur(rest)
        Z[:, count:] = Z[:, count:] @ turn
    T: Floats = np.triu(Z.T @ A @ Z)
    T[count:, count:] = rest
    T[range(count), range(count)] = real
    return T, Z


def state_covariances(process: Process, slots: int) -> Floats:
    """Σ_k = E[x_k x_kᵀ] for k = 0 … slots−1, (slots, n, n): Σ_0 given, Σ_k = A Σ_{k−1} Aᵀ + Q; inf once it overflows.

    Source: docs/mathematics/model.md, model.
    """
    return theoretical_covariances(process, NOBODY, slots)


@final
class NoiseCovariances:
    """E[χ_k χ_kᵀ] = A Σ_{k−1} Aᵀ, a number of slots at a time from k = 0, where it is 0. inf from where it overflows.

    Source: docs/mathematics/numerics.md, encoding noise.
    """

    def __init__(self, process: Process) -> None:
        self._A, self._states = process.A, TheoreticalCovariance(process, NOBODY)
        self._first = True

    def next(self, slots: int) -> Floats:
        """Those of the next slots, (slots, n, n)."""
        zeros = int(self._first and slots > 0)
        self._first = self._first and slots == 0
        sigma = self._states.next(slots - zeros)
        with np.errstate(over="ignore", invalid="ignore"):
            carried = self._A @ sigma @ self._A.T
        return _unbounded_from_overflow(np.concatenate([np.zeros((zeros, *self._A.shape)), carried]))


def noise_covariances(process: Process, slots: int) -> Floats:
    """E[χ_k χ_kᵀ] for k = 0 … slots−1, (slots, n, n); inf from where it overflows.

    Source: docs/mathematics/numerics.md, encoding noise.
    """
    return NoiseCovariances(process).next(slots)


def misled_covariances(process: Process, slots: int) -> Floats:
    """f_k = 2 A Σ_{k−1} Aᵀ, (slots, n, n): the error of taking an innovation for the state; 0 at k = 0.

    Source: Lemma V.1 (third case).
    """
    with np.errstate(over="ignore"):
        return 2.0 * noise_covariances(process, slots)


@final
class TheoreticalCovariance:
    """E P_k of a receiver, a number of slots at a time from k = 0.

    E_0 = p_0 Σ0, E_k = p_k (A E_{k−1} Aᵀ) + p_d Q + p_i f_k with p_k = `propagated`, solved for a block of slots at once: for
    j slots beyond s, with F = √p_k A and W_j = Σ_{l<j} A^l Q A^lᵀ,

        E_{s+j} = F^j E_s F^jᵀ + p_d Σ_{l<j} F^l Q F^lᵀ + 2 p_i (Σ_{l<j} p_k^l) A^j Σ_s A^jᵀ
                  + 2 p_i Σ_{l<j} F^l (W_{j−l} − Q) F^lᵀ,

    all terms positive semidefinite, so nothing cancels where powers of A do not (`without_cancellation`). Values do not depend
    on how many slots are asked for at a time. From the slot where a value exceeds double precision, every entry is inf. Leaks
    differ from slot to slot, so their recursion is computed slot by slot.

    Source: Theorem IV.3 (proof, corrected), Theorem V.2 (corrected); docs/mathematics/model.md, expectations.
    """

    def __init__(self, process: Process, outcomes: Outcomes) -> None:
        n = process.n
        process, self._Z = without_cancellation(process)
        self._process = process
        self._outcomes = outcomes
        self._remaining = RemainingCovariances(process) if outcomes.leaked else None
        matrices = (np.float64(matrix).tobytes() for matrix in (process.A, process.Q))
        key = (*matrices, n, outcomes.propagated, outcomes.predicted, outcomes.misled)
        self._powers, self._kept_powers, self._diffusion, self._spread, self._weights = _block_tables(*key)
        with np.errstate(over="ignore", invalid="ignore"):
            self._block: Floats = outcomes.initial * process.initial_covariance[None]
        self._sigma: Floats = process.initial_covariance
        self._own = BlockByBlock(self._block, self._advanced)
        """The expectation in the coordinates Zᵀx."""
        self._settled = False
        """Whether all further blocks are equal to this one, because it ends with the value that it began after."""

    def next(self, slots: int) -> Floats:
        """The expectation in the next slots, (slots, n, n)."""
        covariances = self._own.next(slots)
        if self._Z is None:
            return covariances
        with np.errstate(over="ignore", invalid="ignore"):
            return _unbounded_from_overflow(self._Z @ covariances @ self._Z.T)

    def next_traces(self, slots: int) -> Floats:
        """The trace of the expectation in the next slots, (slots,)."""
        with np.errstate(over="ignore"):
            return traces_of_slots(self._own.next(slots))

    def _advanced(self) -> Floats:
        if not self._settled:
            self._block = self._following(self._block[-1])
        return self._block

    def _following(self, E: Floats) -> Floats:
        """The block after a slot with this expectation."""
        if not np.isfinite(E[0, 0]):
            return np.full(self._powers.shape, np.inf)
        with np.errstate(over="ignore", invalid="ignore"):
            if self._remaining is not None:
                return _unbounded_from_overflow(self._slot_by_slot(E, self._remaining))
            block = _congruences(self._kept_powers, E) + self._diffusion
            if self._outcomes.misled:
                grown = _congruences(self._powers, self._sigma)
                block += self._weights[:, None, None] * grown
                self._sigma = grown[-1] + self._spread[-1]
            else:
                self._settled = np.array_equal(block[-1], E)
        return _unbounded_from_overflow(block)

    def _slot_by_slot(self, E: Floats, remaining: RemainingCovariances) -> Floats:
        block, outcomes, A = np.empty(self._powers.shape), self._outcomes, self._process.A
        added = outcomes.predicted * self._process.Q + outcomes.leaked * remaining.next(len(block))
        for j in range(len(block)):
            E = block[j] = outcomes.propagated * (A @ E @ A.T) + added[j]
        return block


def theoretical_covariances(process: Process, outcomes: Outcomes, slots: int) -> Floats:
    """E P_k for k = 0 … slots−1, (slots, n, n); inf from where it overflows. `outcomes.reported` gives E of the reported P.

    Source: docs/mathematics/model.md, expectations.
    """
    return TheoreticalCovariance(process, outcomes).next(slots)


def traces_of_slots(covariances: Floats) -> Floats:
    """The trace of each slot's covariance, (slots, n, n) → (slots,)."""
    return np.asarray(np.trace(covariances, axis1=1, axis2=2))


def theoretical_traces(process: Process, outcomes: Outcomes, slots: int) -> Floats:
    """Trace of E P_k for k = 0 … slots−1, (slots,); inf from where it overflows.

    Source: docs/mathematics/model.md, expectations.
    """
    return TheoreticalCovariance(process, outcomes).next_traces(slots)


def radius(process: Process) -> float:
    """ρ(A), exactly 1 for a marginally stable process whatever the rounding of its eigenvalues.

    Source: docs/mathematics/model.md, limits.
    """
    rho = process.spectral_radius
    return 1.0 if abs(rho - 1.0) <= MARGINAL else rho


def stability_bound(process: Process, mu: float) -> float:
    """(1 − ρ⁻²)/μ: a receiver that uses only states, behind a link of quality μ, has a bounded error iff μ_d exceeds it.

    0 for ρ = 1: any μ_d > 0 exceeds it. 1 or more: no μ_d ≤ 1 does. inf for μ = 0 and ρ ≥ 1.

    Source: docs/mathematics/model.md, limits.
    """
    rho = radius(process)
    if rho < 1.0:
        return 0.0
    return (rho - 1.0) * (rho + 1.0) / rho**2 / mu if mu > 0.0 else math.inf


def legitimate_bound(process: Process, mu: float) -> float:
    """The legitimate error is bounded for every larger μ_d: `stability_bound`, or 0 for a lossless link, μ = 1.

    Every packet that a legitimate estimator receives leaves it without an error, so with μ = 1 it never has one.

    Source: docs/mathematics/model.md, limits.
    """
    return 0.0 if mu == 1.0 else stability_bound(process, mu)


def lyapunov(process: Process, kept: float) -> Floats:
    """S = kept · A S Aᵀ + Q, (n, n): S(q) of the paper with kept = 1 − q. `unbounded` where kept · ρ² ≥ 1.

    Source: Theorem IV.3.
    """
    return _stationary(process, kept, process.Q)


def unbounded(process: Process, kept: float, starts: bool = True) -> Floats:
    """What E = kept · A E Aᵀ + … tends to where kept · ρ² ≥ 1, (n, n): all inf, or all NaN where theory does not know it.

    It stays bounded where process noise that is singular reaches no mode with kept · |λ|² ≥ 1, and none grows by itself.

    starts: whether E is not 0 in slot 0, so that a mode without noise grows from there if kept · |λ|² > 1.
    """
    least = 1.0 / math.sqrt(kept)
    grows = not process.singular_noise or (starts and radius(process) > least + MARGINAL)
    return np.full_like(process.Q, np.inf if grows or driven_part(process, least - MARGINAL).shape[1] else np.nan)


def limit(process: Process, outcomes: Outcomes) -> Floats:
    """Limit of E P_k, (n, n), `unbounded` if there is none: p_d S(1 − kept) for a receiver that is never misled.

    Source: Theorem IV.3, Corollaries V.3 and V.4, Lemma V.6; docs/mathematics/model.md, limits;
    docs/mathematics/eavesdroppers.md, genie.
    """
    source = outcomes.predicted * process.Q
    if outcomes.leaked:
        source = source + outcomes.leaked * remaining_limit(process)
    if outcomes.misled:
        if radius(process) >= 1.0:
            return unbounded(process, 1.0)
        source = source + 2.0 * outcomes.misled * (process.A @ lyapunov(process, 1.0) @ process.A.T)
    elif outcomes.predicted + outcomes.leaked + outcomes.initial == 0.0:
        return np.zeros_like(process.Q)
    return _stationary(process, outcomes.propagated, source, outcomes.initial > 0.0)


def limit_trace(process: Process, outcomes: Outcomes) -> float:
    """Limit of tr E P_k: J(μ_d) of the legitimate estimator, J_e(μ_d) of an eavesdropper. inf or NaN as in `unbounded`.

    Source: docs/mathematics/model.md, limits.
    """
    return float(np.trace(limit(process, outcomes)))


def tail_index(process: Process, outcomes: Outcomes) -> float:
    """Exponent α of P(tr P_k > t) ~ t^−α for large k: −ln(1 − p_r) / (2 ln ρ). inf where there is no heavy tail.

    inf too for a receiver that is misled or never uses a state: tr P_k then stays within a factor of its own, growing
    expectation.

    Source: docs/mathematics/model.md, heavy tails.
    """
    if outcomes.state == 0.0:
        return math.inf
    rho = radius(process)
    if rho <= 1.0 or outcomes.misled or outcomes.predicted + outcomes.leaked == 0.0 or outcomes.state >= 1.0:
        return math.inf
    return -math.log1p(-outcomes.state) / (2.0 * math.log(rho))


def has_infinite_variance(process: Process, outcomes: Outcomes) -> bool:
    """Whether tr P_k has infinite variance in the limit, so that a sample mean proves nothing: α ≤ 2.

    Source: docs/mathematics/model.md, heavy tails.
    """
    return tail_index(process, outcomes) <= 2.0


def _stationary(process: Process, kept: float, source: Floats, starts: bool = True) -> Floats:
    if kept * radius(process) ** 2 >= 1.0 - _ROUNDING:
        return unbounded(process, kept, starts)
    S: Floats = np.full_like(source, np.inf)
    # Near the bound the equation may be singular to rounding, or nearly; finiteness and definiteness decide.
    with suppress(np.linalg.LinAlgError):
        S = _fixed_point(math.sqrt(kept) * process.A, source)
    sound = np.isfinite(S).all() and np.linalg.eigvalsh(0.5 * (S + S.T))[0] >= -1e-9 * np.abs(S).max()
    return S if sound else np.full_like(source, np.inf)


def _fixed_point(F: Floats, source: Floats) -> Floats:
    """S = F S Fᵀ + source, (n, n). Raises LinAlgError; near the bound of stability S may not be a covariance."""
    n = len(F)
    if n <= _FEW_STATES:
        squared = (F[:, None, :, None] * F[None, :, None, :]).reshape(n * n, n * n)
        S = np.linalg.solve(np.eye(n * n) - squared, source.reshape(-1))
        return np.asarray(S, np.float64).reshape(n, n)
    from scipy.linalg import LinAlgWarning, solve_discrete_lyapunov  # noqa: PLC0415 - slow to import

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LinAlgWarning)
        return np.asarray(solve_discrete_lyapunov(F, source))


def block_length(A: Floats, largest: float = _LARGEST_POWER) -> int:
    """The number of powers of A, (n, n), to compute at once: 256, or fewer if their entries would become too large."""
    power, length = A, 1
    while length < _BLOCK:
        power = power @ power
        if not np.abs(power).max() < largest:
            break
        length *= 2
    return length


@lru_cache(maxsize=64)
def _block_tables(
    dynamics: bytes, noise: bytes, n: int, kept: float, predicted: float, misled: float
) -> tuple[Floats, ...]:
    """What is the same in every block: A^j, F^j, the sums of Q's part and of W's part, and the weights; none may be changed.

    dynamics, noise: A and Q as bytes. A run asks for the same ones in every verdict, and they take milliseconds.
    """
    A, Q = (np.frombuffer(matrix).reshape(n, n) for matrix in (dynamics, noise))
    with np.errstate(over="ignore", invalid="ignore"):
        length = block_length(A)
        diffusion, spread = np.empty((length, n, n)), np.empty((length, n, n))
        E, W = np.zeros((n, n)), np.zeros((n, n))
        for j in range(length):
            carried = A @ W @ A.T
            E = kept * (A @ E @ A.T) + predicted * Q + 2.0 * misled * carried
            W = carried + Q
            diffusion[j], spread[j] = E, W
        weights = 2.0 * misled * np.cumsum(kept ** np.arange(length))
        tables = (powers_of(A, length), powers_of(math.sqrt(kept) * A, length), diffusion, spread, weights)
    for table in tables:
        table.flags.writeable = False
    return tables


def powers_of(A: Floats, length: int) -> Floats:
    """A, A², … A^length, (length, n, n), by doubling."""
    powers = A[None]
    while len(powers) < length:
        powers = np.concatenate([powers, powers @ powers[-1]])
    return powers


def _congruences(powers: Floats, P: Floats) -> Floats:
    return (powers @ P) @ powers.transpose(0, 2, 1)


def _unbounded_from_overflow(covariances: Floats) -> Floats:
    beyond = np.flatnonzero(~np.all(np.isfinite(covariances), axis=(1, 2)))
    if beyond.size:
        covariances[beyond[0] :] = np.inf
    return covariances


_TOUCHES = 1e-9  # relative: less is rounding
_REACHED = 1e-9  # relative: a smaller singular value is taken for 0


class Growth(NamedTuple):
    """Where an expected error grows without bound."""

    basis: Floats
    """An orthonormal basis of the directions in which it certainly grows, (n, m)."""
    within: Floats
    """The same of those outside which it certainly does not, (n, s)."""

    def along(self, v: Floats) -> bool | None:
        """Whether the error of vᵀx grows without bound, v (n,); None if theory does not know.

        A part of v in these directions counts only if it exceeds 1e-9 of v, in the units of the states.
        """
        if _touches(self.basis, v):
            return True
        return None if _touches(self.within, v) else False


def unstable_part(A: Floats, within: Floats, least: float) -> Floats:
    """An orthonormal basis, (n, m), of the eigenspaces with |λ| ≥ least of A in an invariant subspace with this basis, (n, s)."""
    from scipy.linalg import schur  # noqa: PLC0415 - slow to import

    if not within.shape[1]:
        return within
    M = within.T @ A @ within
    modulus = modulus_in(M)
    _, Z, count = schur(M, sort=lambda real, imaginary: modulus(real, imaginary) >= least)
    return within @ Z[:, :count]


def driven_part(process: Process, least: float) -> Floats:
    """As `unstable_part` of the whole space, of the modes that process noise reaches: of all unless Q is singular."""
    axes = np.eye(process.n)
    if process.singular_noise:
        # In units of the states' own deviations at the start, so that ranks do not depend on the units that the user chose.
        units = np.sqrt(np.diag(process.initial_covariance))
        reached = invariant_hull(process.A * units / units[:, None], process.Q / np.outer(units, units), _REACHED)
        axes = np.linalg.qr(units[:, None] * reached)[0]
    return unstable_part(process.A, axes, least)


def growth(process: Process, outcomes: Outcomes) -> Growth:
    """Where the expected error of a receiver with these outcomes in every slot grows.

    Where noise does not reach all modes that do not decay, only those grow for certain that grow by themselves.

    Source: docs/mathematics/verdicts.md, verdicts by direction.
    """
    noise = bool(outcomes.misled + outcomes.predicted + outcomes.leaked)
    if outcomes.misled:
        marginal = 1.0
    elif outcomes.propagated == 0.0 or not (noise or outcomes.initial):
        marginal = math.inf
    else:
        marginal = 1.0 / math.sqrt(outcomes.propagated)
    by_itself, within = (
        unstable_part(process.A, np.eye(process.n), marginal + margin)
        for margin in (MARGINAL, -MARGINAL if noise else MARGINAL)
    )
    reached = driven_part(process, marginal - MARGINAL).shape[1] == within.shape[1]
    certain = by_itself if outcomes.misled or outcomes.initial else within[:, :0]
    return Growth(within if reached else certain, within)


def _touches(basis: Floats, v: Floats) -> bool:
    return bool(np.linalg.norm(basis.T @ v) > _TOUCHES * np.linalg.norm(v))
