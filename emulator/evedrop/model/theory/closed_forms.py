"""Closed forms of receivers whose slots differ, for schemes that the outcomes of single slots do not determine.

There are bounds, and chains with a memory: of a receiver whose error follows the sensor's Markov chain, that reads a state from
a quantised packet, that takes noise packets for states, that reads some states of every state packet, and all innovations, over
a perfect link, or that lacks the reference of later packets, until a state that is sent unencrypted ends the growth of its
error.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple, final

import numpy as np

from evedrop.model.acknowledgements import HeedRule
from evedrop.model.kernels.current import kernels
from evedrop.model.kernels.elementary import cholesky
from evedrop.model.process import MARGINAL, Floats, Process, invariant_hull
from evedrop.model.receiver import Flags
from evedrop.model.schedule import NoiseDistribution, StateProbability, in_slot, mean_of
from evedrop.model.staircase import ROUNDING_OF_PACKETS, is_singular
from evedrop.model.theory.covariances import (
    LARGEST_OPERATOR,
    NOBODY,
    Growth,
    Outcomes,
    driven_part,
    has_infinite_variance,
    limit,
    limit_trace,
    lyapunov,
    radius,
    state_covariances,
    traces_of_slots,
    unbounded,
    unstable_part,
)

Hears = Callable[[bool, bool], float]
"""(whether the legitimate estimator hears a packet, whether the hijacker does) → the probability that a receiver hears it."""


class ClosedForm(ABC):
    """One receiver's theoretical error covariance over the slots of a run."""

    bound: bool = False
    """Whether this is only a lower bound, in every slot; its limit is exact."""

    @property
    @abstractmethod
    def traces(self) -> Floats:
        """The traces of all slots, (slots,)."""

    @property
    @abstractmethod
    def limit(self) -> float:
        """Trace of the limit; inf if it is unbounded, NaN if theory does not know it, or it is too large to compute."""

    @property
    @abstractmethod
    def infinite_variance(self) -> bool:
        """Whether the variance of tr P over trials has no bound (docs/mathematics/model.md, heavy tails)."""

    @property
    def growth(self) -> Growth | None:
        """The directions in which the error grows without bound; None if they are unknown."""
        return None


@dataclass(frozen=True)
class Hijack:
    """A hijacked sensor that counts the packets its eavesdropper has missed."""

    mu: float
    """Quality of the legitimate link."""
    mu_e: float
    """Quality of the link of the eavesdropper that the sensor serves."""
    heed_rule: HeedRule
    hears: Hears
    """For the receiver whose closed form is made."""


@dataclass(frozen=True)
class ReceiverConditions:
    """What theory knows of a receiver's link and of the acknowledgements, for the makers in `Scheme.closed_forms`."""

    slots: int
    legitimate: bool
    """Whether the receiver is the legitimate estimator."""
    received: float | None
    """The probability that it receives a packet that is sent; None unless losses are independent and alike in all slots."""
    uses: tuple[float, float] | None = None
    """The probabilities that its strategy uses a packet with ν = 0, and with ν = 1; None unless it decides by ν alone."""
    acknowledged: tuple[float, float] | None = None
    """The probabilities that a packet is acknowledged and the receiver heard it, and that it is acknowledged and the receiver did
    not. None: there are no acknowledgements, or their probabilities differ from slot to slot. Else `received` is known."""
    forged: bool = False
    """Whether an attacker sends acknowledgements in the legitimate estimator's name."""
    hijack: Hijack | None = None
    """The hijacked sensor, if it needs more than the last packet to decide which acknowledgements it heeds."""


ClosedFormMaker = Callable[[Any, ReceiverConditions], ClosedForm | None]
"""(a scheme, a receiver's conditions) → the receiver's closed form; None if there is none under these conditions."""


@final
@dataclass(frozen=True)
class QuantisationError:
    """White noise of covariance R_k = fraction · diag(Σ_k): the steps grow with the standard deviations of the states."""

    fraction: float

    @classmethod
    def of(cls, bits: int, standard_deviations: float) -> QuantisationError:
        """That of 2^bits steps over so many standard deviations to either side: Δ²/12 each."""
        return cls(standard_deviations**2 / (3.0 * 4.0**bits))

    def covariances(self, process: Process, slots: int) -> Floats:
        """R_k for k = 0 … slots−1, (slots, n, n); inf from where Σ_k overflows."""
        return self._of(state_covariances(process, slots))

    def limit(self, process: Process) -> Floats:
        """The limit of R_k, (n, n); its diagonal is inf, or NaN as in `unbounded`, unless A forgets."""
        return self._of(limit(process, NOBODY))

    def _of(self, sigma: Floats) -> Floats:
        return np.where(np.eye(sigma.shape[-1], dtype=np.bool_), self.fraction * sigma, 0.0)


def twin_track_bound(process: Process, slots: int) -> Floats:
    """½ tr A^k Σ0 A^kᵀ for k = 0 … slots−1, (slots,): a lower bound on the squared error of any eavesdropper of twin tracks.

    Holds for μ_e = 1, without knowledge of coin and starts, which the model takes as ideal random numbers. inf once it overflows.

    Source: docs/mathematics/schemes.md, twin track.
    """
    bound = np.empty(slots)
    grown = process.initial_covariance
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(slots):
            trace = 0.5 * float(np.trace(grown))
            bound[k] = trace if np.isfinite(trace) else np.inf
            grown = process.A @ grown @ process.A.T
    return bound


def reference_covariances(
    process: Process,
    received: float,
    acknowledged: tuple[float, float],
    slots: int,
    plain: float = 0.0,
    L: Callable[[int], Floats] | None = None,
) -> Floats:
    """E P_k of a reader of state-secrecy codes with L = A, for k = 0 … slots−1, (slots, n, n); inf from where it overflows.

    received: the probability that it hears a packet. acknowledged: the probabilities that the packet is acknowledged to
    the sensor and was heard by the reader, and that it is acknowledged and was not heard. With P⁻ and R⁻ the error and the
    error of the reference, each predicted by one slot,

        P_k = R⁻ if heard, else P⁻;   R_k = P_k if acknowledged, else R⁻;   R = 0 before the first acknowledgement,

    which is linear in (P, R), so the expectations follow it.

    plain: the probability that a packet contains the state: P_k = 0 where that is heard. L: k → L_k; R⁻ = L R Lᵀ then. With
    either these are errors of a reader that takes z plus its own reference for the state: upper bounds on those of the best one.

    Source: docs/mathematics/schemes.md, acknowledged references; docs/mathematics/attacks.md, flipped acknowledgements.
    """
    heard, unheard = acknowledged
    covariances = np.empty((slots, process.n, process.n))
    P = R = np.zeros_like(process.Q)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(slots):
            A = process.A
            predicted = A @ P @ A.T + process.Q if k else process.initial_covariance
            step = A if L is None or not k else L(k)
            carried = step @ R @ step.T
            P = received * (1.0 - plain) * carried + (1.0 - received) * predicted
            R = (1.0 - unheard - plain * heard) * carried + unheard * predicted
            if not np.isfinite(P).all():
                covariances[k:] = np.inf
                break
            covariances[k] = P
    return covariances


def reference_limit(process: Process, received: float, acknowledged: tuple[float, float], plain: float = 0.0) -> float:
    """Trace of the limit of `reference_covariances` with L = A; inf or NaN as in `unbounded`, NaN if it is too large to compute.

    Source: docs/mathematics/schemes.md, acknowledged references; docs/mathematics/attacks.md, flipped acknowledgements.
    """
    heard, unheard = acknowledged
    if unheard == 0.0:
        return limit_trace(process, Outcomes.plain(received))
    carried = np.array([[1.0 - received, received * (1.0 - plain)], [unheard, 1.0 - unheard - plain * heard]])
    kept = float(np.abs(np.linalg.eigvals(carried)).max())
    if kept * radius(process) ** 2 >= 1.0 - 1e-12:
        return float(np.trace(unbounded(process, kept)))
    n = process.n
    if 2 * n * n > LARGEST_OPERATOR:
        return float("nan")
    source = np.concatenate([(1.0 - received) * process.Q.reshape(-1), unheard * process.Q.reshape(-1)])
    operator = np.kron(carried, np.kron(process.A, process.A))
    return float(np.trace(np.linalg.solve(np.eye(2 * n * n) - operator, source)[: n * n].reshape(n, n)))


@dataclass(frozen=True)
class SensorChain:
    """The sensor's behaviour as a Markov chain, and its effect on one receiver's error.

    Entry [s, r] of the two matrices is the probability, in state s, that the receiver's error is reset to 0, or predicted,
    and that the next state is r. All slots start in `start`.

    Source: docs/mathematics/schemes.md, schedules by holding time.
    """

    start: Floats
    """Distribution of the state in slot 0, (S,)."""
    reset: Floats
    """P ← 0, (S, S)."""
    carried: Floats
    """P ← A P Aᵀ + Q, (S, S); together with `reset`, rows sum to 1."""

    def covariances(self, process: Process, slots: int, quantisation: QuantisationError | None = None) -> Floats:
        """E P_k for k = 0 … slots−1, (slots, n, n); inf from where it overflows.

        quantisation: the error that a reset leaves, if it is not 0.
        """
        covariances = np.empty((slots, process.n, process.n))
        distribution = self.start
        E = np.zeros((len(distribution), process.n, process.n))
        left = None if quantisation is None else quantisation.covariances(process, slots)
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(slots):
                source = process.Q if k else process.initial_covariance
                grown = process.A @ E @ process.A.T + distribution[:, None, None] * source
                E = np.tensordot(self.carried.T, grown, axes=1)
                if left is not None:
                    E = E + (distribution @ self.reset)[:, None, None] * left[k]
                distribution = distribution @ (self.reset + self.carried)
                covariances[k] = E.sum(axis=0)
                if not np.isfinite(covariances[k]).all():
                    covariances[k:] = np.inf
                    break
        return covariances

    def limit(self, process: Process, quantisation: QuantisationError | None = None) -> Floats:
        """Limit of E P_k, (n, n), or its mean over a period if slots repeat; `unbounded` if there is none.

        quantisation: the error that a reset leaves, if it is not 0.
        """
        states, n = len(self.start), process.n
        # The spectral radius of a Kronecker product is the product of its factors'.
        kept = float(np.max(np.abs(np.linalg.eigvals(self.carried))))
        if kept * radius(process) ** 2 >= 1.0 - 1e-12:
            return unbounded(process, kept)
        left = np.zeros((n, n)) if quantisation is None else quantisation.limit(process)
        if not np.isfinite(left).all():
            return np.full((n, n), np.trace(left))
        operator = np.kron(self.carried.T, np.kron(process.A, process.A))
        stationary = self.stationary
        noise = np.kron(self.carried.T @ stationary, process.Q.reshape(-1)) + np.kron(
            self.reset.T @ stationary, left.reshape(-1)
        )
        solution = np.linalg.solve(np.eye(len(operator)) - operator, noise)
        return np.asarray(solution.reshape(states, n, n).sum(axis=0))

    def has_infinite_variance(self, process: Process) -> bool:
        """Whether E (tr P_k)² outgrows (E tr P_k)², so that a sample mean proves nothing.

        With ν the spectral radius of `carried` on the states that occur, the second moment grows as ν ρ⁴. Where ν = 1 the error
        is not reset any more, and grows alike in all trials.

        Source: docs/mathematics/model.md, heavy tails.
        """
        occurs = self.start > 0.0
        for _ in occurs:
            occurs = occurs | (occurs @ (self.reset + self.carried) > 0.0)
        kept = float(np.abs(np.linalg.eigvals(self.carried[np.ix_(occurs, occurs)])).max())
        rho = radius(process)
        return rho > 1.0 and kept < 1.0 - 1e-12 and kept * rho**4 >= 1.0 - 1e-12

    @property
    def stationary(self) -> Floats:
        """Stationary distribution of the state, (S,)."""
        states = len(self.start)
        balance = np.vstack([(self.reset + self.carried).T - np.eye(states), np.ones(states)])
        return np.asarray(np.linalg.lstsq(balance, np.append(np.zeros(states), 1.0), rcond=None)[0])


def scheduled(threshold: int, received: float, acknowledged: tuple[float, float]) -> SensorChain:
    """The chain for a receiver of the scheme `scheduled`; state s is a holding time of s + 1, the last: threshold or more.

    received: the probability that it hears a packet that is sent. acknowledged: the probabilities that such a packet is
    acknowledged to the sensor and was heard by the receiver, and that it is acknowledged and was not heard.

    Source: docs/mathematics/schemes.md, schedules by holding time.
    """
    start, reset, carried = _blank(threshold)
    for s in range(threshold - 1):
        carried[s, s + 1] = 1.0
    _hear(reset, carried, threshold - 1, threshold - 1, received, acknowledged)
    return SensorChain(start, reset, carried)


def hijacked_schedule(threshold: int, mu: float, mu_e: float, heed_rule: HeedRule, hears: Hears) -> SensorChain:
    """The chain for a receiver of the scheme `scheduled` whose sensor is hijacked.

    A state is a holding time, as for `scheduled`, and how many packets in a row the eavesdropper has missed that the sensor
    serves: 0 … patience, or more. hears: the probability that the receiver hears a packet, by whether the estimator and that
    eavesdropper hear it.

    Source: docs/mathematics/attacks.md, the hijacked sensor.
    """
    counts, top = heed_rule.patience + 2, threshold - 1
    start, reset, carried = _blank(threshold * counts)
    start[:] = 0.0
    start[top * counts] = 1.0
    for missed in range(counts):
        for s in range(top):
            carried[s * counts + missed, (s + 1) * counts + missed] = 1.0
        before = top * counts + missed
        for legitimate, served in product((True, False), repeat=2):
            now = 0 if served else min(missed + 1, counts - 1)
            chance = (mu if legitimate else 1.0 - mu) * (mu_e if served else 1.0 - mu_e)
            heeded = heed_rule.fraction_of(now) if legitimate else 0.0
            for after, odds in ((now, heeded), (top * counts + now, 1.0 - heeded)):
                reset[before, after] += chance * odds * hears(legitimate, served)
                carried[before, after] += chance * odds * (1.0 - hears(legitimate, served))
    return SensorChain(start, reset, carried)


def encrypted_schedule(threshold: float, received: float, acknowledged: tuple[float, float]) -> SensorChain:
    """The chain for the selective eavesdropper of `encrypted-schedule`; arguments as for `scheduled`, states up to ⌈θ⌉.

    The threshold θ need not be whole: at a holding time of ⌊θ⌋ a packet is then unencrypted with probability θ − ⌊θ⌋.

    Source: docs/mathematics/schemes.md, schedules by holding time and quantised packets.
    """
    start, reset, carried = _blank(math.ceil(threshold))
    arrives = sum(acknowledged)
    for s in range(math.ceil(threshold)):
        clear = min(max(threshold - (s + 1), 0.0), 1.0)
        heard = clear * acknowledged[0]
        after = min(s + 1, len(start) - 1)
        _hear(reset, carried, s, after, clear * received, (heard, arrives - heard))
    return SensorChain(start, reset, carried)


def encrypted_fraction(threshold: float, arrives: float) -> float:
    """The fraction of packets that are encrypted in the long run, by the probability that a packet is acknowledged.

    (1−p)^{⌊θ⌋−1} (1 − (θ − ⌊θ⌋) p). Source: docs/mathematics/schemes.md, quantised packets.
    """
    whole = math.floor(threshold)
    return (1.0 - arrives) ** (whole - 1) * (1.0 - (threshold - whole) * arrives)


def threshold_for(fraction: float, arrives: float) -> float:
    """The threshold θ with which this fraction of packets is encrypted in the long run, 0 < fraction ≤ 1; inf if none has it.

    Source: docs/mathematics/schemes.md, quantised packets.
    """
    if fraction >= 1.0:
        return 1.0
    if arrives <= 0.0:
        return math.inf
    if arrives >= 1.0:
        return 2.0 - fraction
    whole = math.floor(math.log(fraction) / math.log1p(-arrives)) + 1
    left: float = fraction / (1.0 - arrives) ** (whole - 1)
    return whole + min(max((1.0 - left) / arrives, 0.0), 1.0)


def always_sent(received: float) -> SensorChain:
    """The chain for a receiver that reads every packet it hears, one in each slot."""
    return SensorChain(np.ones(1), np.array([[received]]), np.array([[1.0 - received]]))


def _blank(threshold: int) -> tuple[Floats, Floats, Floats]:
    start = np.zeros(threshold)
    start[-1] = 1.0
    return start, np.zeros((threshold, threshold)), np.zeros((threshold, threshold))


def _hear(
    reset: Floats, carried: Floats, s: int, unacknowledged: int, received: float, acknowledged: tuple[float, float]
) -> None:
    """Enter the outcomes of a packet sent in state s; after an acknowledgement the next state is 0."""
    heard, unheard = acknowledged
    reset[s, 0] += heard
    carried[s, 0] += unheard
    reset[s, unacknowledged] += received - heard
    carried[s, unacknowledged] += 1.0 - received - unheard


def synchronised_probability(mu: float, mu_d: float) -> float:
    """π_0 = μμ_d / (1 − μ(1−μ_d)): the fraction of time without error. 1 for μ = 1, whatever μ_d is.

    Source: Proposition (limiting distribution), first part.
    """
    return 1.0 if mu == 1.0 else mu * mu_d / ((1.0 - mu) + mu * mu_d)


def word_probability(mu: float, mu_d: float, innovations: int, drops: int) -> float:
    """Limiting probability p_i^j p_d^{l+1} π_0 of one word: a drop, then j innovations and l drops in a given order.

    Source: Proposition (limiting distribution), second part.
    """
    lost = 1.0 - mu
    decoded = mu * (1.0 - mu_d)
    return float(decoded**innovations * lost ** (drops + 1) * synchronised_probability(mu, mu_d))


def step_probabilities(mu: float, mu_d: float, steps: int) -> Floats:
    """P(Δ = i) for i = 0 … steps−1, (steps,): π_0, then p_d π_0 (p_i + p_d)^{i−1}. All steps together sum to 1.

    Source: Proposition (limiting distribution), summed over the 2^{i−1} words of a step.
    """
    synchronised = synchronised_probability(mu, mu_d)
    not_the_state = (1.0 - mu) + mu * (1.0 - mu_d)
    probabilities: Floats = (1.0 - mu) * synchronised * not_the_state ** np.maximum(np.arange(steps) - 1.0, 0.0)
    probabilities[:1] = synchronised
    return probabilities


@final
@dataclass(frozen=True)
class ChainForm(ClosedForm):
    """That of a receiver whose error is reset or predicted, as the sensor's behaviour and the link decide."""

    process: Process
    slots: int
    chain: SensorChain
    quantisation: QuantisationError | None = None
    """The error of a state that is read from a packet; None if there is none."""

    @cached_property
    def traces(self) -> Floats:
        """The traces of all slots, (slots,)."""
        return traces_of_slots(self.chain.covariances(self.process, self.slots, self.quantisation))

    @cached_property
    def limit(self) -> float:
        """Trace of the limit; inf if it is unbounded, NaN if theory does not know it, or it is too large to compute."""
        if len(self.chain.start) * self.process.n**2 > LARGEST_OPERATOR:
            return float("nan")
        return float(np.trace(self.chain.limit(self.process, self.quantisation)))

    @cached_property
    def infinite_variance(self) -> bool:
        """Whether the variance over trials has no bound: not if only the steps of a quantiser grow."""
        return self.chain.has_infinite_variance(self.process)


@final
@dataclass(frozen=True)
class TakesNoise(ClosedForm):
    """That of a receiver that mistakes noise packets for states, behind a link of independent losses.

    E P_k = p_d (A E P_{k−1} Aᵀ + Q) + p_i (Σ_k + N_k): noise that is used as the state leaves the error x_k − n_k.
    """

    process: Process
    distribution: NoiseDistribution
    mu_d: StateProbability
    mu_e: float
    """Quality of the receiver's link."""
    uses: tuple[float, float]
    """The probabilities that it uses a state, and noise."""
    slots: int

    @property
    def outcomes(self) -> Outcomes:
        """Those of a slot, on average over the slots; `misled` is the probability p_i that noise is used."""
        return Outcomes.eavesdropper(self.mu_e, mean_of(self.mu_d), *self.uses)

    @property
    def covariances(self) -> Floats:
        """E P_k of all slots, (slots, n, n); inf from where it overflows."""
        A, N = self.process.A, self.distribution.covariance
        sigma = state_covariances(self.process, self.slots)
        covariances = np.empty_like(sigma)
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(self.slots):
                outcomes = Outcomes.eavesdropper(self.mu_e, in_slot(self.mu_d, k), *self.uses)
                if k == 0:
                    covariances[k] = outcomes.initial * self.process.initial_covariance
                else:
                    taken = sigma[k] + (sigma[k] if N is None else N)
                    covariances[k] = (
                        outcomes.propagated * (A @ covariances[k - 1] @ A.T)
                        + outcomes.predicted * self.process.Q
                        + outcomes.misled * taken
                    )
                if not np.isfinite(covariances[k]).all():
                    covariances[k:] = np.inf
                    break
        return covariances

    @property
    def limit_covariance(self) -> Floats:
        """The limit of E P_k with the mean of μ_d, (n, n); `unbounded` for ρ ≥ 1, if noise is ever used."""
        outcomes, N = self.outcomes, self.distribution.covariance
        if outcomes.misled == 0.0:
            return limit(self.process, outcomes)
        if radius(self.process) >= 1.0:
            return unbounded(self.process, 1.0)
        sigma = limit(self.process, NOBODY)
        source = outcomes.predicted * self.process.Q + outcomes.misled * (sigma + (sigma if N is None else N))
        return lyapunov(replace(self.process, Q=source), outcomes.propagated)

    @cached_property
    def traces(self) -> Floats:
        """The traces of all slots, (slots,)."""
        return traces_of_slots(self.covariances)

    @cached_property
    def limit(self) -> float:
        """Trace of the limit; inf if it is unbounded."""
        return float(np.trace(self.limit_covariance))

    @property
    def infinite_variance(self) -> bool:
        """Whether the variance of tr P over trials has no bound: not where noise is used, which leaves an error like x itself."""
        return has_infinite_variance(self.process, self.outcomes)


_LARGEST = 1e150  # whose square is a double
_LONGEST = 2_000  # slots in which a bounded error settles, or its limit is unknown
_SETTLED, _ROUNDED = 1e-12, 1e-6  # relative change in a slot, and where rounding is added to the unencrypted states
_RANK = 1e-9  # relative: a smaller singular value is taken for 0


@final
@dataclass(frozen=True)
class ClearStatesForm(ClosedForm):
    """The theoretical error covariance of a receiver that reads the unencrypted states, slot by slot, without a closed formula.

    Behind a perfect link, with packets that are all states (μ_d = 1) or, after slot 0, all innovations (μ_d = 0), it is the same
    in every trial. Otherwise it is that of a receiver that hears more than any: all packets, and with 0 < μ_d < 1 both types in
    every slot.
    """

    process: Process
    hidden: Flags
    """Whether each state is encrypted, (n,)."""
    mu_d: float
    received: float | None
    """The probability that a packet is received; None if it differs from slot to slot or is unknown."""
    slots: int

    bound: bool = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "bound", self.received != 1.0 or 0.0 < self.mu_d < 1.0)

    @property
    def infinite_variance(self) -> bool:
        """False: the error that theory knows is the same in every trial."""
        return False

    @cached_property
    def traces(self) -> Floats:
        """The traces of all slots, (slots,); inf from where they overflow."""
        return self._followed(self.slots)

    @cached_property
    def limit(self) -> float:
        """Trace of the limit; inf if it is unbounded, NaN if it is not reached in many slots."""
        if self.growing.shape[1]:
            return math.inf
        last, before = self._followed(_LONGEST)[[-1, -2]]
        settled = _SETTLED * last
        if self._rounding is not None:  # below this, rounding adds up
            settled = _ROUNDED * last + _SETTLED**2 * np.trace(self.process.initial_covariance)
        return float(last) if abs(last - before) <= settled else math.nan

    @cached_property
    def growing(self) -> Floats:
        """An orthonormal basis of the directions in which the error grows without bound, (n, m)."""
        # In units of the states' own deviations at the start, so that ranks do not depend on the units that the user chose.
        units, axes = np.sqrt(np.diag(self.process.initial_covariance)), np.eye(self.process.n)
        A = self.process.A * units / units[:, None]
        if self.mu_d == 0.0:
            # After slot 0, e_k = A^k e_0, and e_0 is in the encrypted states.
            growing = unstable_part(A, invariant_hull(A, axes[:, self.hidden], _RANK), 1.0 + MARGINAL)
        else:
            unseen = _orthogonal_to(invariant_hull(A.T, axes[:, ~self.hidden], _RANK))
            driven = self.mu_d == 1.0 and self._noise_reaches_all
            growing = unstable_part(A, unseen, 1.0 - MARGINAL if driven else 1.0 + MARGINAL)
        return np.linalg.qr(units[:, None] * growing)[0]

    @property
    def growth(self) -> Growth:
        """Where the error grows: exactly in `growing`, or perhaps also elsewhere, but only where the state itself grows."""
        if self.mu_d == 1.0 and not self.bound and self._noise_reaches_all:
            return Growth(self.growing, self.growing)
        return Growth(self.growing, unstable_part(self.process.A, np.eye(self.process.n), 1.0 - MARGINAL))

    @cached_property
    def _noise_reaches_all(self) -> bool:
        """Whether process noise moves every mode that does not decay."""
        least = 1.0 - MARGINAL
        every = unstable_part(self.process.A, np.eye(self.process.n), least)
        return bool(driven_part(self.process, least).shape[1] == every.shape[1])

    def _followed(self, slots: int) -> Floats:
        traces = np.full(slots, np.inf)
        A, noise = self.process.A, self.process.noise_factor
        X = self._read(cholesky(self.process.initial_covariance))
        for k in range(slots):
            traces[k] = float((X * X).sum())
            moved = A @ X
            if not np.abs(moved).max() < _LARGEST:
                break
            if self.mu_d == 1.0:
                moved = np.concatenate([moved, noise], axis=1)
            after = self._read(moved) if self.mu_d > 0.0 else moved
            if np.array_equal(after, X):
                traces[k:] = traces[k]
                break
            X = after
        return traces

    @cached_property
    def _rounding(self) -> Floats | None:
        """That of the unencrypted states, as the receiver has it for singular Q, (n, n); else None."""
        if not is_singular(self.process):
            return None
        deviations = np.sqrt(np.diag(self.process.initial_covariance))
        return np.diag(ROUNDING_OF_PACKETS * np.where(self.hidden, 0.0, deviations))

    def _read(self, X: Floats) -> Floats:
        """A factor of the covariance once the unencrypted states have been read, (n, n), from one of it before, (n, m)."""
        order = np.argsort(self.hidden, kind="stable")
        clear = int((~self.hidden).sum())
        if self._rounding is not None:
            X = np.concatenate([X, self._rounding], axis=1)
        L = kernels.triangular_factors(X[order][None].copy())[0]
        L[:clear] = 0.0
        L[:, :clear] = 0.0
        factor: Floats = np.empty_like(L)
        factor[order] = L
        return factor


def _orthogonal_to(basis: Floats) -> Floats:
    """An orthonormal basis of the orthogonal complement, (n, n − s), of one with s columns."""
    u, _, _ = np.linalg.svd(basis, full_matrices=True) if basis.shape[1] else (np.eye(len(basis)), None, None)
    return np.asarray(u[:, basis.shape[1] :])


_LARGEST_EXPONENT = 700.0  # of a double


class LostReference(NamedTuple):
    """The growth of the expected error of a receiver that lacks the reference."""

    growth: float
    """The factor from slot to slot, or from one phase of unencrypted states to the next; from 1 on the error has no bound."""
    remedy: str
    """What must be changed for a factor below 1, in words that follow "unless"."""


def growth_by_coin(process: Process, plain: float, received: float) -> float:
    """The factor for each slot: ρ² times the probability of not receiving an unencrypted state.

    plain: the probability α that a packet contains the state; received: that it arrives.
    """
    return radius(process) ** 2 * (1.0 - plain * received)


def growth_by_phases(process: Process, coded: float, received: float, acknowledged: tuple[float, float]) -> float:
    """The factor from one phase of unencrypted states, which ends with an acknowledgement, to the next; inf if it is unbounded.

    coded: the acknowledged coded packets between two phases. acknowledged: the probabilities that a packet is acknowledged and
    was heard by the receiver, and that it is acknowledged and was not heard.
    """
    between, in_phase = _growths(process, received, acknowledged)
    if in_phase == 0.0 or coded == 0.0:
        return in_phase
    if not (math.isfinite(between) and math.isfinite(in_phase) and math.isfinite(coded)):
        return math.inf
    exponent = coded * math.log(between) + math.log(in_phase)
    return math.exp(exponent) if exponent < _LARGEST_EXPONENT else math.inf


def most_coded(process: Process, received: float, acknowledged: tuple[float, float]) -> float:
    """The most acknowledged coded packets between two phases with a factor below 1; −1 if even none is too many."""
    between, in_phase = _growths(process, received, acknowledged)
    if not in_phase < 1.0:
        return -1.0
    if in_phase == 0.0 or between <= 1.0:
        return math.inf
    return max(0.0, math.ceil(-math.log(in_phase) / math.log(between)) - 1.0)


def _growths(process: Process, received: float, acknowledged: tuple[float, float]) -> tuple[float, float]:
    """The factors of the slots up to the acknowledgement of one coded packet, and of a phase whose states are not received."""
    square, missed = radius(process) ** 2, acknowledged[1]
    arrives = sum(acknowledged)
    return _growth_until(square, arrives, 1.0 - arrives), _growth_until(square, missed, 1.0 - received - missed)


def _growth_until(square: float, ends: float, goes_on: float) -> float:
    """The sum over j of square^{j+1} times the probability that the growth ends after j slots; inf if it has no bound."""
    rest = 1.0 - square * goes_on
    return square * ends / rest if rest > 0.0 else math.inf
