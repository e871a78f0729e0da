import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evedrop.model.process import Process
from evedrop.model.theory.closed_forms import step_probabilities, synchronised_probability, word_probability
from evedrop.model.theory.covariances import Outcomes, limit
from evedrop.studies.papers import chain

inner = st.floats(0.05, 0.95)


@given(inner, inner)
def test_limiting_distribution_sums_to_one(mu: float, mu_d: float) -> None:
    """All steps of the chain together have probability one."""
    steps = 20_000
    rest = (1 - mu * mu_d) ** (steps - 1) * step_probabilities(mu, mu_d, 2)[1] / (mu * mu_d)
    assert step_probabilities(mu, mu_d, steps).sum() + rest == pytest.approx(1.0, rel=1e-9)


@given(inner, inner, st.integers(1, 8))
def test_a_step_is_the_sum_of_its_words(mu: float, mu_d: float, step: int) -> None:
    """P(Δ = i) adds up the 2^(i−1) words that begin with the drop."""
    words = itertools.product("DI", repeat=step - 1)
    total = sum(word_probability(mu, mu_d, word.count("I"), word.count("D")) for word in words)
    assert total == pytest.approx(step_probabilities(mu, mu_d, step + 1)[step], rel=1e-9)


@given(inner, inner)
def test_distribution_is_stationary(mu: float, mu_d: float) -> None:
    """One slot later the distribution over steps is the same: balance at 0, at 1 and further on."""
    p = step_probabilities(mu, mu_d, 50)
    p_r, p_i, p_d = mu * mu_d, mu * (1 - mu_d), 1 - mu
    assert p[0] == pytest.approx((p_r + p_i) * p[0] + p_r * (1 - p[0]), rel=1e-12)
    assert p[1] == pytest.approx(p_d * p[0], rel=1e-12)
    assert p[2:] == pytest.approx((p_i + p_d) * p[1:-1], rel=1e-12)


def test_lossless_link_is_always_synchronised() -> None:
    """With μ = 1 nothing ever drops, even if no state is ever sent."""
    assert synchronised_probability(1.0, 0.0) == synchronised_probability(1.0, 0.5) == 1.0
    assert np.array_equal(step_probabilities(1.0, 0.5, 4), [1.0, 0.0, 0.0, 0.0])
    assert synchronised_probability(0.9, 0.0) == 0.0


def test_chain_gives_the_limit_of_the_expectation() -> None:
    """Averaging the covariance of each word over the chain is the appendix's second proof of Theorem IV.3."""
    process = Process(np.array([[1.0, 0.1], [0.0, 1.0]]), np.diag([1e-3, 2e-3]), np.eye(2))
    mu, mu_d = 0.9, 0.8
    total = np.zeros((2, 2))
    for step in range(1, 13):
        for word in itertools.product("DI", repeat=step - 1):
            P = process.Q
            for event in word:
                P = process.A @ P @ process.A.T + (process.Q if event == "D" else 0.0)
            total += P * word_probability(mu, mu_d, word.count("I"), word.count("D"))
    assert total == pytest.approx(limit(process, Outcomes.legitimate(mu, mu_d)), rel=1e-4)


@pytest.mark.parametrize("case", chain.CASES)
def test_simulated_occupation_is_the_limiting_distribution(case: tuple[float, float]) -> None:
    """Link and schedule of the emulator spend in each step and word the stated fraction of slots, at five errors."""
    simulated = chain.simulate(*case, trials=400, slots=1500, progress=lambda _: None)
    for (mean, error), expected in (
        (simulated.steps, step_probabilities(*case, chain.STEPS)),
        (simulated.words, chain.words_by_theory(*case)),
    ):
        frequent = expected > 1e-3
        assert np.all(np.abs(mean - expected)[frequent] <= 5.0 * error[frequent])
