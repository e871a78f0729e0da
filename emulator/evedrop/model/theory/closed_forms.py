"""Closed forms for schemes that the outcomes of single slots do not determine: bounds, and chains with a memory.

Source: docs/mathematics.md, twin track, acknowledged references, schedules by holding time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from evedrop.model.acknowledgements import HeedRule
from evedrop.model.process import Floats, Process
from evedrop.model.theory.closed_form import Hears
from evedrop.model.theory.covariances import LARGEST_OPERATOR, Outcomes, limit_trace, radius
from evedrop.model.theory.quantisation import QuantisationError


def twin_track_bound(process: Process, slots: int) -> Floats:
    """½ tr A^k Σ0 A^kᵀ for k = 0 … slots−1, (slots,): a lower bound on the squared error of any eavesdropper of twin tracks.

    Holds for μ_e = 1, without knowledge of coin and starts, which the model takes as ideal random numbers. inf once it overflows.

    Source: docs/mathematics.md, twin track.
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

    Source: docs/mathematics.md, acknowledged references, flipped acknowledgements.
    """
    heard, unheard = acknowledged
    found = np.empty((slots, process.n, process.n))
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
                found[k:] = np.inf
                break
            found[k] = P
    return found


def reference_limit(process: Process, received: float, acknowledged: tuple[float, float], plain: float = 0.0) -> float:
    """Trace of the limit of `reference_covariances` with L = A; inf if it is unbounded, NaN if it is too large to compute.

    Source: docs/mathematics.md, acknowledged references, flipped acknowledgements.
    """
    heard, unheard = acknowledged
    if unheard == 0.0:
        return limit_trace(process, Outcomes.plain(received))
    carried = np.array([[1.0 - received, received * (1.0 - plain)], [unheard, 1.0 - unheard - plain * heard]])
    if np.abs(np.linalg.eigvals(carried)).max() * radius(process) ** 2 >= 1.0 - 1e-12:
        return float("inf")
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

    Source: docs/mathematics.md, schedules by holding time.
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
        found = np.empty((slots, process.n, process.n))
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
                found[k] = E.sum(axis=0)
                if not np.isfinite(found[k]).all():
                    found[k:] = np.inf
                    break
        return found

    def limit(self, process: Process, quantisation: QuantisationError | None = None) -> Floats:
        """Limit of E P_k, (n, n), or its mean over a period if slots repeat; all inf if it is unbounded.

        quantisation: the error that a reset leaves, if it is not 0.
        """
        states, n = len(self.start), process.n
        # The spectral radius of a Kronecker product is the product of its factors'.
        if np.max(np.abs(np.linalg.eigvals(self.carried))) * radius(process) ** 2 >= 1.0 - 1e-12:
            return np.full((n, n), np.inf)
        left = np.zeros((n, n)) if quantisation is None else quantisation.limit(process)
        if not np.isfinite(left).all():
            return np.full((n, n), np.inf)
        operator = np.kron(self.carried.T, np.kron(process.A, process.A))
        stationary = self.stationary
        noise = np.kron(self.carried.T @ stationary, process.Q.reshape(-1)) + np.kron(
            self.reset.T @ stationary, left.reshape(-1)
        )
        solution = np.linalg.solve(np.eye(len(operator)) - operator, noise)
        total: Floats = solution.reshape(states, n, n).sum(axis=0)
        return total

    def has_infinite_variance(self, process: Process) -> bool:
        """Whether E (tr P_k)² outgrows (E tr P_k)², so that a sample mean proves nothing.

        With ν the spectral radius of `carried` on the states that occur, the second moment grows as ν ρ⁴. Where ν = 1 the error
        is not reset any more, and grows alike in all trials.

        Source: docs/mathematics.md, heavy tails.
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
        stationary: Floats = np.linalg.lstsq(balance, np.append(np.zeros(states), 1.0), rcond=None)[0]
        return stationary


def scheduled(threshold: int, received: float, acknowledged: tuple[float, float]) -> SensorChain:
    """The chain for a receiver of the scheme `scheduled`; state s is a holding time of s + 1, the last: threshold or more.

    received: the probability that it hears a packet that is sent. acknowledged: the probabilities that such a packet is
    acknowledged to the sensor and was heard by the receiver, and that it is acknowledged and was not heard.

    Source: docs/mathematics.md, schedules by holding time.
    """
    start, reset, carried = _blank(threshold)
    for s in range(threshold - 1):
        carried[s, s + 1] = 1.0
    _hear(reset, carried, threshold - 1, threshold - 1, received, acknowledged)
    return SensorChain(start, reset, carried)


def hijacked_schedule(threshold: int, mu: float, mu_e: float, heed_rule: HeedRule, hears: Hears) -> SensorChain:
    """The chain for a receiver of the scheme `scheduled` whose sensor is hijacked.

    A state is a holding time, as for `scheduled`, and how many packets in a row the eavesdropper has missed that the sensor
    serves: 0 … patience, or more. hears: the probability that the receiver hears a packet, by whether the user and that
    eavesdropper hear it.

    Source: docs/mathematics.md, the hijacked sensor.
    """
    counts, top = heed_rule.patience + 2, threshold - 1
    start, reset, carried = _blank(threshold * counts)
    start[:] = 0.0
    start[top * counts] = 1.0
    for missed in range(counts):
        for s in range(top):
            carried[s * counts + missed, (s + 1) * counts + missed] = 1.0
        before = top * counts + missed
        for user, served in product((True, False), repeat=2):
            now = 0 if served else min(missed + 1, counts - 1)
            chance = (mu if user else 1.0 - mu) * (mu_e if served else 1.0 - mu_e)
            heeded = heed_rule.fraction_of(now) if user else 0.0
            for after, odds in ((now, heeded), (top * counts + now, 1.0 - heeded)):
                reset[before, after] += chance * odds * hears(user, served)
                carried[before, after] += chance * odds * (1.0 - hears(user, served))
    return SensorChain(start, reset, carried)


def encrypted_schedule(threshold: float, received: float, acknowledged: tuple[float, float]) -> SensorChain:
    """The chain for the selective eavesdropper of `encrypted-schedule`; arguments as for `scheduled`, states up to ⌈θ⌉.

    The threshold θ need not be whole: at a holding time of ⌊θ⌋ a packet is then unencrypted with probability θ − ⌊θ⌋.

    Source: docs/mathematics.md, schedules by holding time and quantised packets.
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

    (1−p)^{⌊θ⌋−1} (1 − (θ − ⌊θ⌋) p). Source: docs/mathematics.md, quantised packets.
    """
    whole = math.floor(threshold)
    return (1.0 - arrives) ** (whole - 1) * (1.0 - (threshold - whole) * arrives)


def threshold_for(fraction: float, arrives: float) -> float:
    """The threshold θ with which this fraction of packets is encrypted in the long run, 0 < fraction ≤ 1; inf if none has it.

    Source: docs/mathematics.md, quantised packets.
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


def in_sync_probability(mu: float, mu_d: float) -> float:
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
    return float(decoded**innovations * lost ** (drops + 1) * in_sync_probability(mu, mu_d))


def step_probabilities(mu: float, mu_d: float, steps: int) -> Floats:
    """P(Δ = i) for i = 0 … steps−1, (steps,): π_0, then p_d π_0 (p_i + p_d)^{i−1}. All steps together sum to 1.

    Source: Proposition (limiting distribution), summed over the 2^{i−1} words of a step.
    """
    in_sync = in_sync_probability(mu, mu_d)
    not_the_state = (1.0 - mu) + mu * (1.0 - mu_d)
    probabilities: Floats = (1.0 - mu) * in_sync * not_the_state ** np.maximum(np.arange(steps) - 1.0, 0.0)
    probabilities[:1] = in_sync
    return probabilities
