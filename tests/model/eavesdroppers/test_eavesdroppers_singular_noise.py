"""Genie, likelihood and Bayesian eavesdropper of a process whose Q is singular, against exact conditioning in fractions.

The reference conditions the joint normal distribution of the state and all packets on one number after the other. A number whose
variance is exactly 0 is either known already, or impossible: no bound of rounding decides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import product as words_of
from typing import Any, NamedTuple

import numpy as np
import pytest

from evedrop.model.eavesdroppers.bayesian import Bayesian, Genie
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.eavesdroppers.type_tests import Likelihood
from evedrop.model.kernels.elementary import Floats
from evedrop.model.process import Process, StateFactors
from evedrop.model.receiver import Action, Belief, Reception
from evedrop.model.schedule import PACKETS, NoiseDistribution, Schedule
from evedrop.model.streams import Batch
from evedrop.model.theory.covariances import Outcomes, limit_trace, theoretical_traces
from evedrop.model.theory.leak import Leaks, RemainingCovariances, remaining_limit
from tests.examples import mostly_long
from tests.model.rationals import Matrix, combined, congruent, exact, remaining, times, transposed
from tests.model.singular_processes import PROCESSES, sigmas

MU_D = 0.4
SLOTS = 6
CLOSE = 1e-9


class Posterior(NamedTuple):
    """What packets tell of the last state, if their types are known."""

    mean: list[Fraction]
    covariance: Matrix
    exact: int
    """Numbers of the packets that were known before they were heard."""
    log_density: float
    """Of all others; −inf if the packets are impossible."""


class Packets(NamedTuple):
    """Packets of one trial with their true types."""

    z: Matrix
    nu: list[bool]
    x: Matrix


def packets(process: Process, random: np.random.Generator, slots: int = SLOTS) -> Packets:
    """States that follow the process exactly, and packets of random types; all numbers have few bits."""

    def numbers(*shape: int) -> Matrix:
        return exact(random.integers(-96, 97, shape) / 64.0)

    A, G = exact(process.A), exact(process.noise_factor)
    nu = [False, *(random.random(slots - 1) > 0.5).tolist()]
    x, z = [numbers(process.n, 1)], []
    for k in range(slots):
        if k:
            w = times(G, numbers(process.n, 1))
            x.append(combined((1, times(A, x[-1])), (1, w)))
        z.append(combined((1, w), (1, numbers(process.n, 1))) if nu[k] else x[k])
    flat = ([[row[0] for row in matrix] for matrix in many] for many in (z, x))
    return Packets(next(flat), nu, next(flat))


class Covariances:
    """Of the states and packets of the first slots, exactly; each is worked out once for all words of types."""

    def __init__(self, process: Process, slots: int) -> None:
        self.n, self._slots = process.n, slots
        self._sigmas, self._Q = sigmas(process, slots), exact(process.Q)
        self._powers = [exact(np.eye(process.n))]
        for _ in range(slots):
            self._powers.append(times(self._powers[-1], exact(process.A)))
        self._with_state: dict[tuple[int, int], Matrix] = {}
        self._with_innovation: dict[int, Matrix] = {}

    def of(self, word: Sequence[bool], j: int, k: int) -> Matrix:
        """Cov(z_j, z_k) for j ≥ k, if `word` are the types; number len(word) is the last state."""
        first, second = (slot < len(word) and word[slot] for slot in (j, k))
        at, before = min(j, len(word) - 1), min(k, len(word) - 1)
        if first:
            return self._sigmas[at] if j == k else exact(np.zeros((self.n, self.n)))
        covariances: dict[Any, Matrix] = self._with_innovation if second else self._with_state
        key = at - before if second else (at, before)
        if key not in covariances:
            covariances[key] = times(self._powers[at - before], self._Q if second else self._sigmas[before])
        return covariances[key]


def conditioned(of: Covariances, word: Sequence[bool], z: Matrix, heard: Sequence[bool]) -> Posterior:
    """The last state given the packets heard, if `word` are their types, by exact conditioning of the joint distribution."""
    n = of.n
    numbers = [k for k in range(len(word)) if heard[k]] + [len(word)]
    blocks = {(j, k): of.of(word, j, k) for j in numbers for k in numbers if j >= k}
    blocks |= {(k, j): transposed(block) for (j, k), block in blocks.items()}
    joint = [[value for k in numbers for value in blocks[j, k][i]] for j in numbers for i in range(n)]
    mean, count, log_density = [Fraction(0)] * len(joint), 0, 0.0
    values = [value for k in numbers[:-1] for value in z[k]]
    for i, value in enumerate(values):
        variance, rest = joint[i][i], value - mean[i]
        if variance == 0:
            count += 1
            if rest != 0:
                return Posterior(mean, joint, 0, -math.inf)
            continue
        log_density -= 0.5 * (float(rest * rest / variance) + math.log(2.0 * math.pi * float(variance)))
        gain = [row[i] / variance for row in joint]
        mean = [m + g * rest for m, g in zip(mean, gain, strict=True)]
        own = joint[i]
        joint = [[a - g * b for a, b in zip(row, own, strict=True)] for row, g in zip(joint, gain, strict=True)]
    return Posterior(mean[-n:], [row[-n:] for row in joint[-n:]], count, log_density)


def enumerated(process: Process, z: Matrix, heard: Sequence[bool]) -> tuple[Floats, Floats]:
    """Mean and covariance of the last state over all words of types: those that explain the most numbers exactly, weighed."""
    some = [k for k in range(1, len(z)) if heard[k]]
    covariances, posteriors = Covariances(process, len(z)), []
    for types in words_of([False, True], repeat=len(some)):
        word = [False] * len(z)
        for k, innovation in zip(some, types, strict=True):
            word[k] = innovation
        posterior = conditioned(covariances, word, z, heard)
        if posterior.log_density > -math.inf:
            prior = sum(math.log(1.0 - MU_D if innovation else MU_D) for innovation in types)
            posteriors.append((posterior, posterior.log_density + prior))
    most = max(posterior.exact for posterior, _ in posteriors)
    posteriors = [(posterior, weight) for posterior, weight in posteriors if posterior.exact == most]
    top = max(weight for _, weight in posteriors)
    weights = np.array([math.exp(weight - top) for _, weight in posteriors])
    weights /= weights.sum()
    means = np.array([[float(value) for value in posterior.mean] for posterior, _ in posteriors])
    within = np.array(
        [[[float(value) for value in row] for row in posterior.covariance] for posterior, _ in posteriors]
    )
    mean = weights @ means
    away = means - mean
    return mean, np.einsum("w,wij->ij", weights, within) + np.einsum("w,wi,wj->ij", weights, away, away)


def knowledge(process: Process) -> Knowledge:
    """The knowledge of the eavesdroppers."""
    return Knowledge(process, MU_D, {}, {"schedule": bytes(32)})


def followed(receiver: Bayesian | Likelihood | Genie, z: Matrix, heard: Sequence[bool]) -> list[Belief]:
    """A receiver's beliefs, slot by slot."""
    beliefs, belief = [], receiver.prior()
    for k, packet in enumerate(z):
        numbers = np.array([[float(value)] for value in packet])
        belief = receiver.step(k, belief, Reception(np.array([heard[k]]), numbers))
        beliefs.append(belief)
    return beliefs


@pytest.mark.parametrize("case", PROCESSES)
def test_what_innovations_leave_is_exact(case: str) -> None:
    """M_k of eavesdroppers and of the theory is Q − QΣ_k⁻¹Q, in fractions."""
    process = PROCESSES[case]
    leaks, theory = Leaks(process), RemainingCovariances(process)
    for k, sigma in enumerate(sigmas(process, 12)):
        if k:
            M = np.array(remaining(exact(process.Q), sigma), np.float64)
            read = leaks.stairs.outward_covariance(leaks.at(k).remaining[:, :, None])[:, :, 0]
            scale = np.abs(process.Q).max()
            assert np.allclose(theory.next(1)[0], M, rtol=1e-12, atol=1e-14 * scale)
            assert np.allclose(read, M, rtol=1e-12, atol=1e-14 * scale)


@pytest.mark.parametrize("case", PROCESSES)
@pytest.mark.parametrize("seed", mostly_long(range(3), [1]))
def test_the_bayesian_eavesdropper_is_the_exact_posterior(case: str, seed: int) -> None:
    """Of all words of types, with what packets show without noise treated as exact."""
    process, random = PROCESSES[case], np.random.default_rng(seed)
    sent = packets(process, random)
    heard = [True, *(random.random(SLOTS - 1) < 0.8).tolist()] if seed else [True] * SLOTS
    beliefs = followed(Bayesian(knowledge(process), Batch(12, 1)), sent.z, heard)
    for k in (1, 2, 3, SLOTS - 1):
        mean, P = enumerated(process, sent.z[: k + 1], heard)
        assert np.allclose(beliefs[k].x_hat[:, 0], mean, rtol=0, atol=CLOSE)
        assert np.allclose(beliefs[k].P[:, :, 0], P, rtol=0, atol=CLOSE)


@pytest.mark.parametrize("N", [PACKETS, [[0.75, 0.25], [0.25, 1.0]]], ids=["of packets", "another"])
def test_noise_in_place_of_states_is_told_in_the_same_coordinates(N: object) -> None:
    """The distribution of noise packets: their density relative to a state's does not depend on the coordinates."""
    process, z = PROCESSES["sampled force"], np.random.default_rng(4).standard_normal((2, 5))
    leaks = Leaks(process, NoiseDistribution(N))
    for k, sigma in enumerate(sigmas(process, 5)):
        if not k:
            continue
        own = np.array(sigma, np.float64) if isinstance(N, str) else np.array(N)
        leak = leaks.at(k)
        assert np.allclose(
            (leak.white(leaks.stairs.inward(z)) ** 2).sum(axis=0), (z * np.linalg.solve(own, z)).sum(axis=0)
        )
        assert np.allclose(leaks.stairs.outward_covariance(leak.remaining[:, :, None])[:, :, 0], process.Q, atol=1e-15)
        assert np.array_equal(
            leaks.rounding(range(k, k + 1)), Leaks(process, NoiseDistribution(PACKETS)).rounding(range(k, k + 1))
        )
        assert np.allclose(leaks.rounding(range(k, k + 1)), Leaks(process).rounding(range(k, k + 1)), rtol=1e-9)


@pytest.mark.parametrize("case", PROCESSES)
def test_the_genie_is_the_exact_posterior_of_known_types(case: str) -> None:
    """Mean and covariance, after every slot, given the schedule."""
    process, random = PROCESSES[case], np.random.default_rng(5)
    genie, slots = Genie(knowledge(process), Batch(12, 1)), 12
    informed = knowledge(process)
    schedule = Schedule(informed.keys["schedule"], informed.mu_d, Batch(12, 1))
    word = [bool(k and schedule.at(k)[0]) for k in range(slots)]
    z = [[Fraction(int(value), 64) for value in random.integers(-96, 97, process.n)] for _ in range(slots)]
    A, G = exact(process.A), exact(process.noise_factor)
    x = [[value] for value in z[0]]
    heard = [True, *(random.random(slots - 1) < 0.7).tolist()]
    for k in range(1, slots):
        w = times(G, [[Fraction(int(value), 64)] for value in random.integers(-96, 97, process.n)])
        x = combined((1, times(A, x)), (1, w))
        if not word[k]:
            z[k] = [row[0] for row in x]
    assert 0 < sum(word) < slots - 1
    for k, belief in enumerate(followed(genie, z, heard)):
        posterior = conditioned(Covariances(process, k + 1), word[: k + 1], z, heard)
        assert np.allclose(belief.x_hat[:, 0], np.array(posterior.mean, np.float64), rtol=0, atol=CLOSE)
        assert np.allclose(belief.P[:, :, 0], np.array(posterior.covariance, np.float64), rtol=0, atol=CLOSE)


@pytest.mark.parametrize("strategy", [Bayesian, Likelihood])
def test_types_next_to_a_known_state_are_certain(strategy: type[Bayesian | Likelihood]) -> None:
    """A state after a state is in the range of Q, an innovation is not, however like a state it is otherwise."""
    process = PROCESSES["sampled force"]
    G, A = process.noise_factor[:, :1], process.A
    first, x = np.array([[2.0], [-1.0]]), np.array([[2.0], [-1.0]])
    states = [first]
    for draw in (0.7, -1.9, 6.0):
        x = A @ x + draw * G
        states.append(x)
    eve = strategy(knowledge(process), Batch(12, 1))
    belief, yes = eve.prior(), np.array([True])
    for k, z in enumerate(states):
        belief = eve.step(k, belief, Reception(yes, z))
        assert belief.action[0] == Action.STATE
        assert not belief.P.any()
    aside = states[-1] * 0.0 + A @ states[-1] + 1e-6 * np.array([[1.0], [0.0]])
    belief = eve.step(len(states), belief, Reception(yes, aside))
    assert belief.action[0] == Action.INNOVATION
    assert np.allclose(belief.P[:, :, 0], remaining_at(process, len(states)), rtol=1e-9)


def remaining_at(process: Process, k: int) -> Floats:
    """M_k."""
    M: Floats = RemainingCovariances(process).next(k)[-1]
    return M


def test_a_betrayed_state_and_a_late_start_are_in_the_same_coordinates() -> None:
    """A state that is learned is the estimate, with covariance 0; a receiver that begins later knows Σ of that slot."""
    process = PROCESSES["three integrators"]
    for strategy in (Bayesian, Likelihood):
        eve, x = strategy(knowledge(process), Batch(12, 2)), np.array([[1.0, 2.0], [0.5, -1.0], [3.0, 0.25]])
        belief = eve.knowing(4, x, eve.prior(4))
        after = eve.step(5, belief, Reception(np.zeros(2, np.bool_), np.zeros((3, 2))))
        assert np.allclose(after.x_hat, process.A @ x)
        assert np.allclose(after.P[:, :, 0], process.Q, atol=1e-15)
        sigma = sigmas(process, 5)[-1]
        late = eve.step(4, eve.prior(4), Reception(np.zeros(2, np.bool_), np.zeros((3, 2))))
        assert np.allclose(late.P[:, :, 0], np.array(sigma, np.float64), rtol=1e-12)


def test_expectations_of_the_genie_are_exact() -> None:
    """The recursion with M_k in fractions, and its limit: with modes that noise never reaches, too."""
    outcomes, mu_e, slots = Outcomes.genie(0.9, MU_D), Fraction(0.9), 12
    q, leaked = 1 - mu_e * Fraction(MU_D), mu_e * (1 - Fraction(MU_D))
    for process in PROCESSES.values():
        A, Q = exact(process.A), exact(process.Q)
        G = combined((1 - mu_e, exact(process.initial_covariance)))
        expected = [G]
        for sigma in sigmas(process, slots)[1:]:
            G = combined((q, congruent(A, G)), (1 - mu_e, Q), (leaked, remaining(Q, sigma)))
            expected.append(G)
        traces = [float(sum(G[i][i] for i in range(process.n))) for G in expected]
        assert np.allclose(theoretical_traces(process, outcomes, slots), traces, rtol=1e-11)
    for case in ("a mode without noise", "two of three"):
        process = PROCESSES[case]
        if math.isfinite(limit := limit_trace(process, outcomes)):
            assert theoretical_traces(process, outcomes, 800)[-1] == pytest.approx(limit, rel=1e-9)
        M = remaining_at(process, 400)
        assert np.allclose(M, remaining_limit(process), rtol=1e-9, atol=1e-15)
        assert np.linalg.eigvalsh(process.Q - M).max() > 1e-3


def test_how_often_the_last_state_is_certain() -> None:
    """A fifth to a quarter of trials with a singular Q, hardly any with diag(Q), as documented; and the belief is true."""
    singular = Process(
        np.array([[1.0, 0.1], [0.0, 1.0]]),
        np.array([[2.025e-3, 4.5e-3], [4.5e-3, 1e-2]]),
        np.array([[5.625e-3, 1.25e-2], [1.25e-2, 5e-2]]),
        singular_noise=True,
    )
    nonsingular = Process(singular.A, np.diag(np.diag(singular.Q)), singular.initial_covariance)
    certain: list[float] = []
    for process in (singular, nonsingular):
        batch, random = Batch(21, 600), np.random.default_rng(1)
        eve, belief = Bayesian(Knowledge(process, 0.3, {}, {}), batch), None
        L = np.linalg.cholesky(process.initial_covariance)
        x, carried, above = L @ random.standard_normal((2, 600)), StateFactors(process), np.zeros(600)
        for k in range(21):
            z = x
            if k:
                w = process.noise_factor @ random.standard_normal((2, 600))
                x = process.A @ x + w
                chi = carried.block(range(k, k + 1))[0] @ random.standard_normal((2, 600))
                z = np.where(random.random(600) < 0.3, x, w + chi)
            belief = eve.step(k, belief or eve.prior(), Reception(random.random(600) < 0.9, z))
            above += ((belief.x_hat - x) ** 2).sum(axis=0) - np.trace(belief.P)
        assert belief is not None
        assert abs(above.mean()) < 4.5 * above.std() / 600**0.5
        certain.append(float(np.mean(belief.memory[0].max(axis=0) > 1.0 - 1e-6)))
    assert 0.18 < certain[0] < 0.29
    assert certain[1] < 0.01
