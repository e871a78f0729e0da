"""The Bayesian eavesdropper against enumeration of all type words, the exact genie, and itself."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.bayesian import CAPACITY, Bayesian
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Action, Receiver, Reception
from evedrop.model.streams import Batch
from evedrop.model.theory.covariances import Outcomes, theoretical_traces
from tests.builders import MARGINAL, MICROGRID
from tests.examples import examples
from tests.model.listening import EXAMPLE, followed, keys, slots

SURE = 4.5  # standard errors: a normal mean is beyond with a probability below 7e-6


def made(name: str, process: Process, mu_d: float, batch: Batch, seed: int = 1) -> Receiver:
    """A strategy without parameters."""
    return STRATEGIES[name](Knowledge(process, mu_d, {}, keys(seed)), batch)


def enumerated(process: Process, mu_d: float, z: Floats, gamma: list[bool]) -> tuple[Floats, Floats, float]:
    """Mean and covariance of x_k given the packets, by all 2^k words of types, and P(ν_k = 0) of the last.

    Each word is a Kalman filter of its own on the joint vector (x_0, w_0 … w_{k−1}, χ_1 … χ_k): linear observations of it,
    conditioned in one go by pseudo-inverse. Nothing of the mixture's own algebra is used.
    """
    k, n = len(gamma) - 1, process.n
    A, blocks = process.A, [process.initial_covariance, *[process.Q] * k]
    Sigma = process.initial_covariance
    for _ in range(k):
        blocks.append(A @ Sigma @ A.T)
        Sigma = A @ Sigma @ A.T + process.Q
    size = n * len(blocks)
    joint = np.zeros((size, size))
    for i, block in enumerate(blocks):
        joint[i * n : (i + 1) * n, i * n : (i + 1) * n] = block

    def part(i: int) -> Floats:
        chosen = np.zeros((n, size))
        chosen[:, i * n : (i + 1) * n] = np.eye(n)
        return chosen

    states = [part(0)]
    for i in range(1, k + 1):
        states.append(A @ states[-1] + part(i))
    weights, means, covariances, last = [], [], [], []
    for word in product((0, 1), repeat=k):
        nu = (0, *word)
        H = [part(i) + part(k + i) if nu[i] else states[i] for i in range(k + 1) if gamma[i]]
        prior = float(np.prod([mu_d if type_ == 0 else 1.0 - mu_d for type_ in word]))
        mean, P, density = np.zeros(n), states[k] @ joint @ states[k].T, 0.0
        if H:
            stacked = np.vstack(H)
            seen = np.concatenate([z[i] for i in range(k + 1) if gamma[i]])
            S = stacked @ joint @ stacked.T
            gain = states[k] @ joint @ stacked.T @ np.linalg.inv(S)
            mean, P = gain @ seen, P - gain @ stacked @ joint @ states[k].T
            density = -0.5 * (seen @ np.linalg.solve(S, seen) + np.linalg.slogdet(S)[1])
        weights.append(np.log(prior) + density)
        means.append(mean)
        covariances.append(P)
        last.append(nu[k] == 0)
    weight = np.exp(np.array(weights) - np.max(weights))
    weight /= weight.sum()
    mean = np.einsum("j,ji->i", weight, np.array(means))
    away = np.array(means) - mean
    P = np.einsum("j,jab->ab", weight, np.array(covariances) + away[:, :, None] * away[:, None, :])
    return mean, P, float(weight[np.array(last)].sum())


@given(
    st.integers(1, 3), st.floats(0.5, 1.5), st.floats(0.05, 0.95), st.lists(st.booleans(), min_size=1, max_size=7),
    st.integers(0, 2**32),
)  # fmt: skip
@settings(deadline=None, max_examples=examples(60))
def test_it_is_the_posterior_over_all_type_words(
    n: int, radius: float, mu_d: float, gamma: list[bool], seed: int
) -> None:
    """Random systems, losses and μ_d, seven slots: x̂ and P to 1e-8 of an enumeration of all words of types."""
    random = np.random.default_rng(seed)
    A = random.standard_normal((n, n))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    Q, start = ((f @ f.T + 0.2 * np.eye(n)) for f in random.standard_normal((2, n, n)))
    process = Process(A, Q, start)
    bayesian = Bayesian(Knowledge(process, mu_d, {}, {}), Batch(len(gamma), 1))
    belief, z = bayesian.prior(), []
    for slot in slots(process, mu_d, 1.0, Batch(len(gamma), 1, seed % 1000)):
        z.append(slot.z[:, 0])
        belief = bayesian.step(slot.k, belief, Reception(np.array(gamma[slot.k : slot.k + 1]), slot.z))
        mean, P, state = enumerated(process, mu_d, np.array(z), gamma[: slot.k + 1])
        scale = 1.0 + np.abs(P).max()
        assert np.allclose(belief.x_hat[:, 0], mean, rtol=1e-8, atol=1e-8 * np.sqrt(scale))
        assert np.allclose(belief.P[:, :, 0], P, rtol=1e-8, atol=1e-8 * scale)
        if gamma[slot.k] and abs(state - 0.5) > 1e-9:
            assert belief.action[0] == (Action.STATE if state > 0.5 else Action.INNOVATION)


@pytest.mark.thorough
def test_it_reports_the_truth() -> None:
    """Its reported trace is the mean of its squared error given what it heard: at every tenth slot, at 4.5 standard errors."""
    batch = Batch(101, 4000)
    receivers = {"bayesian": made("bayesian", MARGINAL, 0.3, batch)}
    for slot, beliefs in followed(receivers, slots(MARGINAL, 0.3, 0.9, batch)):
        if slot.k % 10 == 0:
            belief = beliefs["bayesian"]
            excess = ((slot.x - belief.x_hat) ** 2).sum(axis=0) - np.trace(belief.P)
            assert abs(excess.mean()) <= SURE * excess.std(ddof=1) / np.sqrt(4000) + 1e-15, slot.k


@pytest.mark.parametrize(
    ("mu_d", "genie", "smart"), [(0.9, 4.462e-4, 5.077e-4), (0.7, 1.545e-3, 1.760e-3)], ids=["0.9", "0.7"]
)
def test_it_becomes_the_genie_in_the_numerical_example(mu_d: float, genie: float, smart: float) -> None:
    """Slot 60: exact genie plus the mean of (Bayes − genie) over the same trials is the genie's error to 0.2 % and 4.5 σ.

    In every slot Bayes is not better, at 4.5 standard errors, and by slot 10 it has been worse than smart.
    """
    batch, count = Batch(61, 3000), 3000
    receivers = {name: made(name, EXAMPLE, mu_d, batch) for name in ("bayesian", "genie", "smart")}
    exact = theoretical_traces(EXAMPLE, Outcomes.genie(0.9, mu_d), 61)
    careless = theoretical_traces(EXAMPLE, Outcomes.eavesdropper(0.9, mu_d, 1.0, 0.0), 61)
    assert (exact[60], careless[60]) == pytest.approx((genie, smart), rel=5e-4)
    worse = 0.0
    for slot, beliefs in followed(receivers, slots(EXAMPLE, mu_d, 0.9, batch)):
        errors = {name: ((slot.x - belief.x_hat) ** 2).sum(axis=0) for name, belief in beliefs.items()}
        excess = errors["bayesian"] - errors["genie"]
        spread = excess.std(ddof=1) / np.sqrt(count)
        assert excess.mean() >= -SURE * spread - 1e-15, slot.k
        if slot.k in {5, 10}:
            worse = max(worse, float((exact[slot.k] + excess.mean()) / careless[slot.k]))
    assert worse > 1.5
    assert abs(excess.mean()) <= SURE * spread + 1e-15
    assert exact[60] + excess.mean() == pytest.approx(genie, rel=2e-3)


@pytest.mark.parametrize(
    ("process", "mu_d", "mu_e", "count", "tolerance"),
    [
        (EXAMPLE, 0.7, 0.9, 61, 1e-4),
        (MARGINAL, 0.3, 0.9, 200, 1e-2),
        (MICROGRID, 0.5, 0.6, 200, 1e-3),
        (MICROGRID, 0.1, 0.6, 200, 5e-2),  # the types stay in the dark for hundreds of slots, all places are taken
    ],
    ids=["numerical", "marginal", "microgrid", "dark"],
)
@pytest.mark.thorough
def test_twice_the_components_change_nothing(
    process: Process, mu_d: float, mu_e: float, count: int, tolerance: float
) -> None:
    """Its mean error over 500 trials and all slots is that of one with twice as many components, to what is stated here."""
    batch = Batch(count, 500)
    receivers = {
        str(size): Bayesian(Knowledge(process, mu_d, {}, {}), batch, size) for size in (CAPACITY, 2 * CAPACITY)
    }
    means = dict.fromkeys(receivers, 0.0)
    for slot, beliefs in followed(receivers, slots(process, mu_d, mu_e, batch)):
        for name, belief in beliefs.items():
            means[name] += float(((slot.x - belief.x_hat) ** 2).sum()) / (count * 500)
            assert belief.memory[0].shape[0] <= int(name)
            assert np.all(np.abs(belief.memory[0].sum(axis=0) - 1.0) < 1e-14)
    few, many = means.values()
    assert few == pytest.approx(many, rel=tolerance)


def test_merged_components_keep_mean_and_covariance() -> None:
    """Where there is no room, two components become one of the same moments.

    With room for two instead of many, x̂ and P of the slot in which they first merge do not change.
    """
    batch = Batch(4, 200)
    receivers = {str(size): Bayesian(Knowledge(MICROGRID, 0.3, {}, {}), batch, size) for size in (2, 9)}
    merged = 0
    for slot, beliefs in followed(receivers, slots(MICROGRID, 0.3, 1.0, batch)):
        if slot.k == 2:
            few, many = beliefs["2"], beliefs["9"]
            merged = int(np.count_nonzero((many.memory[0] > 0).sum(axis=0) > 2))
            assert np.allclose(few.x_hat, many.x_hat, rtol=0, atol=1e-17)
            assert np.allclose(few.P, many.P, rtol=0, atol=1e-18)
    assert merged == 200


@pytest.mark.parametrize("mu_d", [0.0, 1.0])
def test_certain_types(mu_d: float) -> None:
    """At μ_d = 1 it is naive; at μ_d = 0 it is the genie: to rounding, over 200 slots."""
    batch = Batch(200, 40)
    twin = "naive" if mu_d else "genie"
    receivers = {name: made(name, MARGINAL, mu_d, batch) for name in ("bayesian", twin)}
    for _, beliefs in followed(receivers, slots(MARGINAL, mu_d, 0.7, batch)):
        assert np.allclose(beliefs["bayesian"].x_hat, beliefs[twin].x_hat, rtol=1e-9, atol=1e-9)
        assert np.allclose(beliefs["bayesian"].P, beliefs[twin].P, rtol=1e-9, atol=1e-12)


@pytest.mark.long
def test_it_may_come_late_and_stays_itself() -> None:
    """Slots 28 600 to 30 000 of the microgrid, for a receiver that heard nothing before: it finds the state.

    Weights and P are in order, and the error is what it must be, 4.67e-5 within a fifth.
    """
    process, late, batch = MICROGRID, 28_600, Batch(30_000, 20)
    bayesian = Bayesian(Knowledge(process, 0.5, {}, {}), batch)
    belief, errors = bayesian.prior(late), []
    for slot in slots(process, 0.5, 0.6, batch):
        if slot.k >= late:
            belief = bayesian.step(slot.k, belief, Reception(slot.gamma, slot.z))
            errors.append(((slot.x - belief.x_hat) ** 2).sum(axis=0).mean())
    assert np.all(np.abs(belief.memory[0].sum(axis=0) - 1.0) < 1e-14)
    assert np.all(np.linalg.eigvalsh(np.moveaxis(belief.P, 2, 0)) >= 0.0)
    assert np.mean(errors[200:]) == pytest.approx(4.67e-5, rel=0.2)


@pytest.mark.long
@pytest.mark.parametrize(("mu_d", "mean"), [(0.1, 3.6e-4), (0.5, 4.7e-5)])
def test_a_day_of_the_microgrid(mu_d: float, mean: float) -> None:
    """Day means of 60 trials × 86 400 slots, within 5 % of the known values."""
    batch = Batch(86_400, 60)
    receivers, total = {"bayesian": made("bayesian", MICROGRID, mu_d, batch)}, 0.0
    for slot, beliefs in followed(receivers, slots(MICROGRID, mu_d, 0.6, batch)):
        total += float(((slot.x - beliefs["bayesian"].x_hat) ** 2).sum())
    assert total / (86_400 * 60) == pytest.approx(mean, rel=0.05)


def test_unstable_covariances_survive_where_cholesky_fails() -> None:
    """Deaf until slot 80 of the numerical example, where Σ_k cannot be factored any more: then one packet, and it is right."""
    batch = Batch(86, 300)
    receiver, belief = made("bayesian", EXAMPLE, 0.9, batch), None
    belief = receiver.prior()
    for slot in slots(EXAMPLE, 0.9, 1.0, batch):
        belief = receiver.step(slot.k, belief, Reception(np.full(300, slot.k >= 80), slot.z))
        if slot.k == 79:
            assert np.linalg.cond(belief.P[:, :, 0]) > 1e16
    error = ((slot.x - belief.x_hat) ** 2).sum(axis=0)
    assert np.median(error) < 1e-2
    assert np.all(np.isfinite(belief.P))
