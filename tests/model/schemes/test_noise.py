"""Noise in place of states: the packets, the error of taking noise for a state, and adversaries that tell the two apart."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product as words
from typing import Any

import numpy as np
import pytest
from scipy import stats

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.bayesian import Bayesian
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.kernels import reference
from evedrop.model.kernels.elementary import cholesky
from evedrop.model.outcomes import uses_of
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Action, Receiver, Reception
from evedrop.model.schedule import PACKETS, NoiseDistribution
from evedrop.model.schemes.noise import Noise
from evedrop.model.schemes.plain import Plain
from evedrop.model.streams import Batch
from evedrop.model.theory.closed_forms import ReceiverConditions, TakesNoise
from evedrop.model.theory.covariances import NOBODY, Outcomes, limit, state_covariances, theoretical_covariances
from evedrop.model.theory.leak import Leaks
from tests.builders import UNSTABLE
from tests.examples import mostly_long
from tests.model.slot_loop import STABLE, Played, coins, keys_of, play

SMALL = [[0.02, 0.004], [0.004, 0.03]]
"""A covariance of noise that is smaller than that of the states of `STABLE`."""
DISTRIBUTIONS = pytest.mark.parametrize("given", [SMALL, PACKETS], ids=["matrix", "packets"])


def spy(name: str, given: Any, batch: Batch, mu_d: float = 0.6, **parameters: float) -> Receiver:
    """An eavesdropper that knows the distribution of the noise."""
    strategy = STRATEGIES[name]
    keys = keys_of(strategy.streams(parameters))
    return strategy(Knowledge(STABLE, mu_d, parameters, keys, None, NoiseDistribution(given)), batch)


def covariance_of(given: Any, k: int) -> Floats:
    """N_k, for `STABLE`."""
    return state_covariances(STABLE, k + 1)[k] if given == PACKETS else np.array(given)


@DISTRIBUTIONS
def test_packets_are_states_or_noise_of_the_given_covariance(given: Any) -> None:
    """Noise is white, normal, of covariance N_k and independent of the state, at 1e-6 confidence; the rest are states."""
    trials = 20_000
    played = play(Noise(STABLE, 0.4, given), Batch(6, trials), {"legitimate": np.ones((6, trials), bool)})
    assert not played.packets[0].nu.any()
    for k, (x, packet) in enumerate(zip(played.x, played.packets, strict=True)):
        assert np.array_equal(packet.z[:, ~packet.nu], x[:, ~packet.nu])
        if k:
            noise = packet.z[:, packet.nu]
            assert stats.binomtest(noise.shape[1], trials, 0.6).pvalue > 1e-6
            white = np.linalg.solve(np.linalg.cholesky(covariance_of(given, k)), noise)
            assert 1e-6 < stats.chi2.cdf(np.sum(white * white), white.size) < 1 - 1e-6
            others = x[:, packet.nu] / np.sqrt(np.diag(state_covariances(STABLE, k + 1)[k]))[:, None]
            products = [white[0] * white[1], *(a * b for a in white for b in others)]
            assert max(abs(float(product.mean())) for product in products) < 5.5 / np.sqrt(noise.shape[1])


@DISTRIBUTIONS
def test_blocks_of_packets_are_those_of_single_slots(given: Any) -> None:
    """To the bit, wherever a block begins."""
    scheme, batch = Noise(STABLE, 0.4, given), Batch(9, 4)
    keys = keys_of(scheme.secret_streams)
    x = np.random.default_rng(1).standard_normal((9, 2, 4))
    encoder = scheme.encoder(keys, batch)
    single = [encoder.encode(k, x[k], x[k]) for k in range(9)]
    for first in (0, 5):
        block = scheme.encoder(keys, batch).encode_block(range(first, 9), x[first:], x[first:])
        assert np.array_equal(block.z, [packet.z for packet in single[first:]])
        assert np.array_equal(block.nu, [packet.nu for packet in single[first:]])


def taken_by(scheme: Noise, strategy: str, mu_e: float, slots: int, **parameters: float) -> TakesNoise:
    """The closed form that the scheme states for a strategy that takes noise for states."""
    form = scheme.closed_forms[strategy](scheme, ReceiverConditions(slots, False, mu_e, uses_of(strategy, parameters)))
    assert isinstance(form, TakesNoise)
    assert form.growth is None
    assert not form.infinite_variance
    assert form.traces.tolist() == np.trace(form.covariances, axis1=1, axis2=2).tolist()
    assert form.limit == np.trace(form.limit_covariance)
    return form


@DISTRIBUTIONS
def test_errors_are_the_closed_forms(given: Any) -> None:
    """Legitimate, smart, naive and suspicious: the mean squared error is that of theory in every slot, at 5 standard errors."""
    slots, trials, scheme = 15, 20_000, Noise(STABLE, 0.4, given)
    batch, some = Batch(slots, trials), {"use_state": 0.7, "use_innovation": 0.3}
    made = {name: spy(name, given, batch, 0.4) for name in ("naive", "smart")}
    made["suspicious"] = spy("suspicious", given, batch, 0.4, **some)
    gamma = {name: coins(0.8, slots, trials, i) for i, name in enumerate(("legitimate", *made))}
    played = play(scheme, batch, gamma, made)
    forms = {"legitimate": scheme.outcomes(0.8), "smart": scheme.eavesdropper_outcomes(0.8, 1.0, 0.0)}
    for name in gamma:
        outcomes = forms.get(name)
        if outcomes is None:
            expected = taken_by(scheme, name, 0.8, slots, **(some if name == "suspicious" else {})).covariances
        else:
            expected = theoretical_covariances(STABLE, outcomes, slots)
        errors = played.squared_error(name)
        apart = np.abs(errors.mean(axis=1) - np.trace(expected, axis1=1, axis2=2))
        assert (apart < 5.0 * errors.std(axis=1) / np.sqrt(trials) + 1e-15).all(), name


def test_noise_may_begin_later() -> None:
    """With μ_d(k) of each slot: states alone up to a slot, and naive's error from there on is that of theory."""
    mu_d = [1.0] * 6 + [0.3] * 6
    scheme, batch = Noise(STABLE, mu_d, SMALL), Batch(12, 20_000)
    gamma = {name: coins(0.8, 12, 20_000, i) for i, name in enumerate(("legitimate", "naive", "power-test"))}
    distribution, keys = NoiseDistribution(SMALL), dict[str, bytes]()
    made = {
        name: STRATEGIES[name](Knowledge(STABLE, scheme.state_probability, {}, keys, scheme.mu_d, distribution), batch)  # type: ignore[arg-type]
        for name in ("naive", "power-test")
    }
    played = play(scheme, batch, gamma, made)
    assert not any(packet.nu.any() for packet in played.packets[:6])
    assert all(0.68 < packet.nu.mean() < 0.72 for packet in played.packets[6:])
    taken = taken_by(scheme, "naive", 0.8, 12)
    errors = played.squared_error("naive")
    apart = np.abs(errors.mean(axis=1) - np.trace(taken.covariances, axis1=1, axis2=2))
    assert (apart < 5.0 * errors.std(axis=1) / np.sqrt(20_000) + 1e-15).all()
    actions = np.array([belief.action for belief in played.beliefs["power-test"]])
    assert not (actions[:6] == Action.DISCARDED).any()
    assert (actions[6:] == Action.DISCARDED).any()


@DISTRIBUTIONS
def test_the_error_of_taking_noise_is_that_of_all_courses(given: Any) -> None:
    """Enumerated over five slots: lost or ignored, state, noise taken, with the covariance of each course by itself."""
    mu_e, mu_d = 0.7, 0.6
    p_d, p_r, p_i = 1.0 - mu_e, mu_e * mu_d, mu_e * (1.0 - mu_d)
    taken = TakesNoise(STABLE, NoiseDistribution(given), mu_d, mu_e, (1.0, 1.0), 2000)
    covariances, A, Q = taken.covariances, STABLE.A, STABLE.Q
    total = np.zeros((2, 2))
    for course in words((0, 1, 2), repeat=4):
        for first in (False, True):  # whether the packet of slot 0, always the state, is used
            P = np.zeros((2, 2)) if first else STABLE.initial_covariance
            weight = 1.0 - p_d if first else p_d
            for k, event in enumerate(course, 1):
                noise = state_covariances(STABLE, 5)[k] + covariance_of(given, k)
                P = (A @ P @ A.T + Q, np.zeros((2, 2)), noise)[event]
                weight *= (p_d, p_r, p_i)[event]
            total += weight * P
    np.testing.assert_allclose(covariances[4], total, rtol=1e-12)
    np.testing.assert_allclose(covariances[-1], taken.limit_covariance, rtol=1e-9)


def test_limits_of_taking_noise() -> None:
    """Unbounded where the process is unstable; that of smart if no noise is taken; beyond double precision all slots are inf."""
    unstable = TakesNoise(UNSTABLE, NoiseDistribution(PACKETS), 0.6, 0.7, (1.0, 1.0), 1200)
    assert np.isinf(unstable.limit_covariance).all()
    covariances = unstable.covariances
    assert np.isfinite(covariances[1000]).all()
    assert np.isinf(covariances[-1]).all()
    never = TakesNoise(STABLE, NoiseDistribution(PACKETS), 0.6, 0.7, (1.0, 0.0), 1)
    assert np.array_equal(never.limit_covariance, limit(STABLE, Outcomes.eavesdropper(0.7, 0.6, 1.0, 0.0)))
    assert Plain.closed_forms == {}
    make = Noise.closed_forms["naive"]
    assert make(Noise(STABLE, 0.4, PACKETS), ReceiverConditions(5, False, 0.7, uses_of("bayesian", {}))) is None
    assert make(Noise(STABLE, 0.4, PACKETS), ReceiverConditions(5, False, None, (1.0, 1.0))) is None


def test_the_published_recursions_are_these() -> None:
    """Of a sensor that filters, with P̄ added and γ, γᵉ the losses, as published: EP = aP̄ + (1−a)(A EP Aᵀ + Q), a = (1−γ)(1−μ).

    EPᵉ = (1−γᵉ)((1−μ)P̄ + μ P_n) + γᵉ(A EPᵉ Aᵀ + Q) with P_n = P_OL + P̄: that of `naive`.
    """
    A, W, V = np.array([[0.5, 0.1], [0.4, 0.6]]), 0.01 * np.eye(2), 0.01 * np.eye(2)
    P = W
    for _ in range(200):
        before = A @ P @ A.T + W
        gain = before @ np.linalg.inv(before + V)
        P = before - gain @ before
    network = Process(A, gain @ (before + V) @ gain.T, W)
    open_loop = limit(Process(A, W, W), NOBODY)
    losses, mu = 0.3, 0.4
    scheme = Noise(network, 1.0 - mu, P.tolist())
    a = (1.0 - losses) * (1.0 - mu)
    legitimate, eve = open_loop, open_loop
    for _ in range(3000):
        legitimate = a * P + (1.0 - a) * (A @ legitimate @ A.T + W)
        used = (1.0 - mu) * P + mu * (open_loop + P)
        eve = (1.0 - losses) * used + losses * (A @ eve @ A.T + W)
    np.testing.assert_allclose(limit(network, scheme.outcomes(1.0 - losses)) + P, legitimate, rtol=1e-9)
    taken = taken_by(scheme, "naive", 1.0 - losses, 8)
    np.testing.assert_allclose(taken.limit_covariance + P, eve, rtol=1e-9)
    assert (np.trace(open_loop), np.trace(P)) == pytest.approx((0.0388, 0.0109), abs=5e-5)


def heard_slots(played: Played) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """K, z and γ of every slot."""
    for k, packet in enumerate(played.packets):
        yield k, packet.z, played.received["legitimate"][k]


def enumerated(z: np.ndarray, gamma: np.ndarray, mu_d: float, given: Any) -> tuple[Floats, Floats]:
    """Posterior mean and covariance of the last state, over all words of types, by scipy's densities."""
    A, Q = STABLE.A, STABLE.Q
    weights, means, covariances = [], [], []
    for word in words((True, False), repeat=len(z) - 1):
        weight, m, P = 1.0, np.zeros(2), STABLE.initial_covariance
        for k, state in enumerate((True, *word)):
            if k:
                m, P = A @ m, A @ P @ A.T + Q
            if not gamma[k]:
                weight *= 0.5 if k else 1.0  # either type is as good, and is counted twice
            elif state:
                weight *= (mu_d * stats.multivariate_normal(m, P).pdf(z[k])) if k else 1.0
                m, P = z[k], np.zeros((2, 2))
            else:
                weight *= (1.0 - mu_d) * stats.multivariate_normal(np.zeros(2), covariance_of(given, k)).pdf(z[k])
        weights.append(weight)
        means.append(m)
        covariances.append(P)
    w = np.array(weights) / np.sum(weights)
    mean: Floats = np.einsum("i,ij->j", w, np.array(means))
    apart = np.array(means) - mean
    spread: Floats = np.einsum("i,ijk->jk", w, np.array(covariances)) + np.einsum("i,ij,ik->jk", w, apart, apart)
    return mean, spread


@DISTRIBUTIONS
def test_the_bayesian_eavesdropper_is_the_posterior_over_all_words(given: Any) -> None:
    """Six slots, eight trials: x̂ and P to 1e-8 of an enumeration of all words of types, with losses."""
    batch = Batch(6, 8)
    played = play(Noise(STABLE, 0.6, given), batch, {"legitimate": coins(0.8, 6, 8, 3)})
    reader = spy("bayesian", given, batch)
    belief, z, gamma = reader.prior(), [], []
    for k, packet, heard in heard_slots(played):
        belief = reader.step(k, belief, Reception(heard, packet))
        z.append(packet)
        gamma.append(heard)
        for r in range(8):
            mean, P = enumerated(np.array(z)[:, :, r], np.array(gamma)[:, r], 0.6, given)
            np.testing.assert_allclose(belief.x_hat[:, r], mean, rtol=1e-8, atol=1e-9)
            np.testing.assert_allclose(belief.P[:, :, r], P, rtol=1e-8, atol=1e-10)


@DISTRIBUTIONS
def test_kernels_agree_on_mixtures_of_states_and_noise(given: Any) -> None:
    """The kernel in use and numpy's, to the bit."""
    batch = Batch(30, 5)
    played = play(Noise(STABLE, 0.4, given), batch, {"legitimate": coins(0.8, 30, 5, 3)})
    z, gamma = np.array([packet.z for packet in played.packets]), np.array(played.received["legitimate"])
    reader = spy("bayesian", given, batch, 0.4)
    assert isinstance(reader, Bayesian)
    beliefs, _ = reader.follow(range(30), reader.prior(), gamma, z)
    leaks = Leaks(STABLE, NoiseDistribution(given)).block(range(30))
    exact, before = np.zeros((30, STABLE.n)), reader.prior().memory
    followed = reference.follow_mixture(STABLE.A, cholesky(STABLE.Q), leaks, exact, before, gamma, z, 0.4, 12, True)
    assert np.array_equal(beliefs.x_hat, followed[0])
    assert np.array_equal(beliefs.P, followed[1])
    assert np.array_equal(beliefs.action, followed[2])


@DISTRIBUTIONS
@pytest.mark.parametrize("name", mostly_long(["likelihood", "power-test"], ["likelihood"]))
def test_detectors_decide_by_the_ratio_of_densities(name: str, given: Any) -> None:
    """The power test by the density of states at any time, `likelihood` by that of a state after its own estimate."""
    batch = Batch(12, 40)
    played = play(Noise(STABLE, 0.6, given), batch, {"legitimate": coins(0.8, 12, 40, 3)})
    reader = spy(name, given, batch)
    belief, sigma, both = reader.prior(), state_covariances(STABLE, 12), set()
    for k, z, gamma in heard_slots(played):
        after = reader.step(k, belief, Reception(gamma, z))
        for r in np.flatnonzero(gamma):
            m, P = STABLE.A @ belief.x_hat[:, r], STABLE.A @ belief.P[:, :, r] @ STABLE.A.T + STABLE.Q
            if name == "power-test":
                m, P = np.zeros(2), sigma[k]
            state = stats.multivariate_normal(m, P).logpdf(z[:, r])
            noise = stats.multivariate_normal(np.zeros(2), covariance_of(given, k)).logpdf(z[:, r])
            used = k == 0 or np.log(0.6) + state > np.log(0.4) + noise
            assert (after.action[r] == Action.STATE) == used
            both.add(used)
            if used:
                assert np.array_equal(after.x_hat[:, r], z[:, r])
            else:
                np.testing.assert_allclose(after.x_hat[:, r], STABLE.A @ belief.x_hat[:, r], rtol=1e-12)
        assert np.array_equal(after.action == Action.LOST, ~gamma)
        belief = after
    # Of packets that are all as large, the power test tells nothing.
    assert both == ({True} if name == "power-test" and given == PACKETS else {True, False})


@pytest.mark.parametrize("mu_d", [0.0, 1.0])
def test_a_power_test_needs_no_test_where_all_packets_are_alike(mu_d: float) -> None:
    """Of states alone it uses all; of noise alone none but the first; noise of a scheme without noise is as large as states."""
    strategy, gamma = STRATEGIES["power-test"], np.ones(3, bool)
    reader = strategy(Knowledge(STABLE, mu_d, {}, {}), Batch(2, 3))
    first = reader.step(0, reader.prior(), Reception(gamma, np.ones((2, 3))))
    assert (first.action == Action.STATE).all()
    second = reader.step(1, first, Reception(gamma, np.ones((2, 3))))
    assert (second.action == (Action.STATE if mu_d else Action.DISCARDED)).all()


def test_full_noise_hides_more_than_quiet_noise() -> None:
    """Unmasking: the power test and the Bayesian eavesdropper err less if the noise is small; the estimator errs alike."""
    slots, trials, errors = 60, 2000, {}
    batch = Batch(slots, trials)
    for given in (SMALL, PACKETS):
        made = {name: spy(name, given, batch, 0.3) for name in ("power-test", "bayesian", "smart")}
        gamma = {name: coins(0.8, slots, trials, 7) for name in ("legitimate", *made)}
        played = play(Noise(STABLE, 0.3, given), batch, gamma, made)
        errors[str(given)] = {name: float(played.squared_error(name)[20:].mean()) for name in gamma}
    quiet, full = errors[str(SMALL)], errors[PACKETS]
    assert quiet["legitimate"] == full["legitimate"] == quiet["smart"] == full["smart"]
    for name in ("power-test", "bayesian"):
        assert quiet["smart"] < 0.98 * quiet[name] < 0.9 * full[name]


def test_no_receiver_without_the_secret_does_better_than_one_with_the_schedule() -> None:
    """The bound of theory is smart's error; a scheme that takes noise has no closed form by the outcomes of a slot."""
    scheme = Noise(STABLE, 0.4, SMALL)
    assert scheme.bound_outcomes(0.7) == scheme.eavesdropper_outcomes(0.7, 1.0, 0.0) == scheme.outcomes(0.7)
    assert scheme.eavesdropper_outcomes(0.7, 1.0, 0.1) is None
    assert Noise(STABLE, 1.0, SMALL).eavesdropper_outcomes(0.7, 1.0, 1.0) == Outcomes.plain(0.7)
    other: Any = type("Other", (Noise,), {})
    assert other(STABLE, 0.4, SMALL).bound_outcomes(0.7) is None
    assert Plain(STABLE).bound_outcomes(0.7) == Outcomes.genie(0.7, 1.0)


@pytest.mark.parametrize(
    ("value", "why"),
    [
        ("filter", "the sensor has no filter"),
        ("loud", 'expected "packets"'),
        ([], 'expected "packets"'),
        ([[1.0, 0.0]], 'expected "packets"'),
        ([[1.0, "a"], [0.0, 1.0]], 'expected "packets"'),
        ([[1.0, 2.0], [2.0, 1.0]], "is not positive definite"),
        ([[1.0, 0.2], [0.1, 1.0]], "is not symmetric"),
    ],
)
def test_covariances_that_are_none_are_refused(value: Any, why: str) -> None:
    """With what was found and what was expected."""
    ((entry, sentence),) = Noise.mistakes({"noise_covariance": value})
    assert entry == "noise_covariance"
    assert why in sentence


def test_the_noise_has_the_dimensions_of_the_state() -> None:
    """Which shows only with the process."""
    assert Noise.mistakes({"noise_covariance": SMALL, "state_probability": 0.5}) == []
    assert Noise.mistakes_with(STABLE, {"noise_covariance": SMALL}) == []
    assert Noise.mistakes_with(STABLE, {"noise_covariance": PACKETS}) == []
    assert Noise.mistakes_with(STABLE, {"noise_covariance": [[1.0]]}) == [
        ("noise_covariance", "is 1 × 1; expected 2 × 2, as A is")
    ]
    assert Plain.mistakes_with(STABLE, {}) == []


def test_the_user_follows_blocks_of_slots_as_single_ones() -> None:
    """Its beliefs are the same to the bit; both sides share ν, and nothing is to be decoded."""
    scheme, batch = Noise(STABLE, 0.6, SMALL), Batch(12, 5)
    shared = scheme.shared(keys_of(scheme.secret_streams), batch)
    played = play(scheme, batch, {"legitimate": coins(0.8, 12, 5, 3)})
    assert np.array_equal([shared.nu(k) for k in range(12)], [packet.nu for packet in played.packets])
    assert not shared.chi(3).any()
    legitimate, z = shared.estimator(), np.array([packet.z for packet in played.packets])
    beliefs_, _ = legitimate.follow(range(12), legitimate.prior(), np.array(played.received["legitimate"]), z)
    assert np.array_equal(beliefs_.x_hat, [belief.x_hat for belief in played.beliefs["legitimate"]])
    assert np.array_equal(beliefs_.P, [belief.P for belief in played.beliefs["legitimate"]])
