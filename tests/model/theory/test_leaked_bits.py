"""The bits that packets reveal: against exact fractions, against the information in whole paths, and in the limit."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.links import loss_of
from evedrop.model.process import Floats, Process
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.slot.link_distribution import LinkDistribution
from evedrop.model.theory.covariances import Outcomes, limit_trace, stability_bound
from evedrop.model.theory.leak import remaining_limit
from evedrop.model.theory.leaked_bits import LeakedBits
from tests.builders import MARGINAL, MICROGRID, UNSTABLE
from tests.examples import examples
from tests.model import rationals
from tests.model.rationals import Matrix, exact
from tests.model.theory.test_theory_exact_rationals import Model, models

SLOTS = 12


def bits_of(ratio: Fraction) -> float:
    """½ log₂ of a ratio that may be as near to 1 as it likes."""
    return math.log1p(float(ratio - 1)) / (2.0 * math.log(2.0))


@settings(deadline=None, max_examples=examples(40))
@given(models(lowest=0.5))
def test_the_bits_of_an_innovation(model: Model) -> None:
    """½ log₂ det Σ_k / det A Σ_{k−1} Aᵀ, for noise of any condition: nothing cancels, in large leaks and in small ones."""
    bits = LeakedBits(model.process).next(SLOTS)
    assert bits[0] == 0.0
    sigmas = rationals.state_covariances(model.A, model.Q, model.initial)
    carried = rationals.congruent(model.A, next(sigmas))
    for value in bits[1:]:
        sigma = next(sigmas)
        expected = bits_of(rationals.determinant(sigma) / rationals.determinant(carried))
        assert value == pytest.approx(expected, rel=1e-7)
        remaining = rationals.remaining(model.Q, sigma)
        assert bits_of(rationals.determinant(model.Q) / rationals.determinant(remaining)) == pytest.approx(expected)
        carried = rationals.congruent(model.A, sigma)


def test_the_bits_of_a_strongly_unstable_process() -> None:
    """Beyond the slots where Σ_k leaves double precision, each state's are those of a process of its own; none is NaN."""
    bits = [
        LeakedBits(Process(np.array(A), np.eye(len(A)), np.eye(len(A)))).next(900)
        for A in ([[2.4, 0.0], [0.0, 0.5]], [[2.4]], [[0.5]])
    ]
    assert np.allclose(bits[0], bits[1] + bits[2], rtol=1e-9, atol=0.0)


def test_the_bits_of_a_process_with_states_that_die_out() -> None:
    """States that noise never reaches hide less and less of the noise of those that it moves, and then nothing of it."""
    A = np.array([[0.5, 0.1, 0.0], [0.1, 0.4, 0.0], [0.2, 0.1, 0.9]])
    noise = np.diag([0.0, 0.0, 1.0])
    bits = LeakedBits(Process(A, noise, np.eye(3), singular_noise=True)).next(3000)
    alone = LeakedBits(Process(A[2:, 2:], noise[2:, 2:], np.eye(1))).next(3000)
    assert np.isfinite(bits).all()
    assert np.allclose(bits[100:], alone[100:], rtol=1e-9, atol=0.0)


def joint_covariance(process: Process, heard: list[int]) -> tuple[Matrix, Matrix, Matrix]:
    """The covariance of the path (x_0, w_0, …), that of the innovation packets of these slots, and that of path and packets."""
    n, last = process.n, max(heard)
    A, Q = exact(process.A), exact(process.Q)
    sigmas = rationals.state_covariances(A, Q, exact(process.initial_covariance))
    before = [next(sigmas) for _ in range(last + 1)]
    size = n * (last + 1)
    path = [[Fraction(0)] * size for _ in range(size)]
    for block in range(last + 1):
        for i in range(n):
            for j in range(n):
                path[n * block + i][n * block + j] = before[0][i][j] if block == 0 else Q[i][j]
    packets = [[Fraction(0)] * (n * len(heard)) for _ in range(n * len(heard))]
    cross = [[Fraction(0)] * (n * len(heard)) for _ in range(size)]
    for place, k in enumerate(heard):
        noise = rationals.congruent(A, before[k - 1])
        for i in range(n):
            for j in range(n):
                packets[n * place + i][n * place + j] = Q[i][j] + noise[i][j]
                cross[n * k + i][n * place + j] = Q[i][j]
    return path, packets, cross


@pytest.mark.parametrize("process", [UNSTABLE, MARGINAL, MICROGRID])
def test_the_bits_add_up_to_what_the_path_revealed(process: Process) -> None:
    """I(path; packets) = ½ log₂ det Cov(path) / det Cov(path | packets), in exact fractions: the sum over heard slots."""
    heard = [1, 2, 4, 7]
    path, packets, cross = joint_covariance(process, heard)
    explained = rationals.times(cross, rationals.inverted(packets), rationals.transposed(cross))
    left = rationals.combined((1, path), (-1, explained))
    expected = bits_of(rationals.determinant(path) / rationals.determinant(left))
    assert LeakedBits(process).next(8)[heard].sum() == pytest.approx(expected, rel=1e-10)


def test_a_stable_mode_goes_on_leaking() -> None:
    """The limit is that of M: 0 without a stable mode, and reached however large the state has become."""
    bits = LeakedBits(UNSTABLE).next(3000)
    expected = 0.5 * math.log2(np.linalg.det(UNSTABLE.Q) / np.linalg.det(remaining_limit(UNSTABLE)))
    assert bits[-1] == pytest.approx(expected, rel=1e-9)
    assert round(expected, 3) == 0.706  # as docs/mathematics/eavesdroppers.md says
    growing = Process(np.array([[1.3, 0.2], [0.0, 1.1]]), np.eye(2), np.eye(2))
    assert 0.0 <= LeakedBits(growing).next(400)[-1] < 1e-20
    steep = Process(np.array([[1e10, 0.3], [0.0, 0.999]]), np.array([[1.0, 0.5], [0.5, 1.0]]), np.eye(2))
    limit = 0.5 * math.log2(np.linalg.det(steep.Q) / np.linalg.det(remaining_limit(steep)))
    assert LeakedBits(steep).next(20_000)[-1] == pytest.approx(limit, rel=1e-9)


def test_marginal_states_hide_innovations_ever_better() -> None:
    """Σ_k = (k + 1) Q: an innovation of two states reveals log₂(1 + 1/k) bits."""
    k = np.arange(1, 600)
    np.testing.assert_allclose(LeakedBits(MICROGRID).next(600)[1:], np.log2(1.0 + 1.0 / k), rtol=1e-12)
    assert LeakedBits(MICROGRID).next(0).shape == (0,)


def test_bits_do_not_depend_on_how_many_slots_are_asked_for() -> None:
    """Across the ends of the blocks in which they are computed."""
    stream = LeakedBits(UNSTABLE)
    parts = [stream.next(slots) for slots in (1, 0, 200, 300, 99)]
    assert np.array_equal(np.concatenate(parts), LeakedBits(UNSTABLE).next(600))


def test_schemes_say_what_their_packets_reveal() -> None:
    """The table of docs/mathematics/eavesdroppers.md; nothing is claimed where it depends on the packets before."""
    bits = {}
    for name in SCHEMES:
        revealed = scheme_of(MICROGRID, {"scheme": name, **SCHEMES[name].parameters}).revealed_bits()
        if revealed is not None:
            bits[name] = [row[-1] for row in revealed.next(3)]
    leak = LeakedBits(MICROGRID).next(3)[-1]
    assert bits == {
        "cipher": [0.0, 0.0],
        "innovation": [math.inf, leak],
        "noise": [math.inf, 0.0],
        "plain": [math.inf, 0.0],
        "withholding": [math.inf, 0.0],
    }
    singular = Process(np.array([[1.0, 1.0], [1.0, 1.0]]), np.eye(2), np.eye(2))
    assert scheme_of(singular, {"scheme": "innovation", "state_probability": 0.5}).revealed_bits() is None


def test_the_rates_of_a_link() -> None:
    """Of bursts their stationary mean; of a receiver that is away 0."""
    chain = loss_of({"model": "gilbert-elliott", "p": 0.1, "r": 0.3}).chain
    assert chain is not None
    steady = LinkDistribution.steady(chain)
    away = LinkDistribution(steady.segments, ((2, 4, True), (5, 100, False)))
    np.testing.assert_allclose(steady.rates(range(3)), 0.75)
    np.testing.assert_allclose(away.rates(range(6)), [0.75, 0.75, 0.0, 0.0, 0.75, 0.0])
    slow, good = (replace(steady.segments[0], arrived=np.array([0.5])), replace(steady.segments[0], start=2))
    np.testing.assert_allclose(LinkDistribution((slow, good)).rates(range(4)), [0.375, 0.375, 0.75, 0.75])
    np.testing.assert_allclose(LinkDistribution((slow, good)).rates(range(1)), [0.375])
    for distribution in (away, LinkDistribution((slow, good))):
        assert np.array_equal(
            [float(distribution.rates(range(k, k + 1))[0]) for k in range(6)], distribution.rates(range(6))
        )


@settings(deadline=None, max_examples=examples(30))
@given(st.floats(1.05, 1.6), st.floats(0.3, 1.0), st.floats(0.1, 1.0), st.floats(0.0, 1.0))
def test_a_bounded_legitimate_error_reveals_information(rho: float, mu: float, mu_e: float, mu_d: float) -> None:
    """With a filter of covariance P̄ at the sensor: the bits of the states heard, each by the slots since the last, exceed it.

    The bound is positive although the eavesdropper's own error may be unbounded.
    """
    A, W, V = np.diag([rho, 0.8]), np.diag([0.3, 0.2]), 0.1 * np.eye(2)
    process = Process(A, W, np.eye(2))
    bounded = math.isfinite(limit_trace(process, Outcomes.legitimate(mu, mu_d)))
    assert bounded == (mu_d > stability_bound(process, mu)) or mu == 1.0
    if not bounded or mu == 1.0:
        return
    filtered = np.eye(2)
    for _ in range(200):
        P = A @ filtered @ A.T + W
        filtered = P - P @ np.linalg.solve(P + V, P)
    rate, revealed, P = mu_e * mu_d, 0.0, filtered
    for since in range(1, 400):
        P = A @ P @ A.T + W
        revealed += rate * rate * (1.0 - rate) ** (since - 1) * ratio_bits(P, filtered)
        if P.max() > 1e12:
            break
    bound = mu_e / mu * (1.0 - rho**-2) * ratio_bits(A @ filtered @ A.T + W, filtered)
    assert bound > 0.0
    # The terms that the sum leaves out are positive: with them it exceeds the bound.
    tail = rate * (1.0 - rate) ** since * ratio_bits(P, filtered)
    assert revealed + tail > bound


def ratio_bits(P: Floats, Q: Floats) -> float:
    """½ log₂ det P / det Q."""
    return 0.5 * math.log2(np.linalg.det(P) / np.linalg.det(Q))
