"""Schemes, against textbook estimators one trial at a time, and their statistics."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evedrop.model.process import Floats, Process, Trajectory
from evedrop.model.receiver import Action, Belief, Reception
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.streams import Batch, Stream, normals, uniforms
from evedrop.model.theory.covariances import state_covariances
from tests.builders import DRIFTING, UNSTABLE, stream_keys
from tests.examples import examples

STREAMS = {stream for scheme in SCHEMES.values() for stream in scheme.secret_streams}
KEYS = stream_keys(4, ("process", *sorted(STREAMS)))
MU_D = 0.4


def made(name: str, process: Process) -> Scheme:
    """A scheme with its example parameters, but with μ_d as here."""
    parameters = SCHEMES[name].parameters
    given = {"state_probability": MU_D} if "state_probability" in parameters else {}
    return scheme_of(process, {"scheme": name, **parameters, **given})


def packets(scheme: str, process: Process, batch: Batch) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """X (n, R), z (n, R) and ν (R,) of every slot."""
    trajectory = Trajectory(process, KEYS["process"], batch)
    encoder = made(scheme, process).encoder(KEYS, batch)
    for k in range(batch.slots):
        x = trajectory.advance()
        z, nu, *_ = encoder.encode(k, x, trajectory.predicted)
        yield x.copy(), z.copy(), nu.copy()


def beliefs(scheme: str, process: Process, batch: Batch, gamma: np.ndarray) -> list[Belief]:
    """What the legitimate estimator reports after every slot, given γ (slots, R)."""
    estimator = made(scheme, process).estimator(KEYS, batch)
    belief, beliefs = estimator.prior(), []
    for k, (_, z, _) in enumerate(packets(scheme, process, batch)):
        belief = estimator.step(k, belief, Reception(gamma[k], z))
        beliefs.append(Belief(belief.x_hat.copy(), belief.P.copy(), belief.action.copy()))
    return beliefs


def chi_of(process: Process, k: int, r: int) -> Floats:
    """χ_k of a trial: from the noise stream, coloured by the Cholesky factor of A Σ_{k−1} Aᵀ propagated by LAPACK's QR."""
    if k == 0:
        return np.zeros(process.n)
    L, G = np.linalg.cholesky(process.initial_covariance), np.linalg.cholesky(process.Q)
    for _ in range(k - 1):
        R = np.linalg.qr(np.hstack([process.A @ L, G]).T, mode="r")
        L = (R * np.sign(np.diag(R))[:, None]).T
    xi = normals(Stream(KEYS["noise"], range(r, r + 1), process.n).words(range(k, k + 1)))[0, 0]
    chi: Floats = process.A @ L @ xi
    return chi


def nu_of(k: int, r: int) -> bool:
    """ν_k of a trial."""
    return bool(k and uniforms(Stream(KEYS["schedule"], range(r, r + 1), 1).words(range(k, k + 1)))[0, 0, 0] >= MU_D)


@pytest.mark.parametrize(("process", "slots"), [(DRIFTING, 60), (UNSTABLE, 40)])
def test_packets_are_the_papers(process: Process, slots: int) -> None:
    """Z is x, or x_k − A x_{k−1} + χ_k where ν = 1, with ν and χ drawn and coloured by other means."""
    before = np.zeros((process.n, 4))
    for k, (x, z, nu) in enumerate(packets("innovation", process, Batch(slots, 4, 10))):
        assert nu.tolist() == [nu_of(k, r) for r in range(10, 14)]
        for r in range(4):
            chi = chi_of(process, k, 10 + r)
            expected = x[:, r] - process.A @ before[:, r] + chi if nu[r] else x[:, r]
            assert np.allclose(
                z[:, r], expected, rtol=0, atol=1e-11 * max(1.0, float(np.abs(x).max()), float(np.abs(chi).max()))
            )
        before = x


@pytest.mark.parametrize(("process", "slots"), [(DRIFTING, 60), (UNSTABLE, 40)])
@settings(max_examples=examples(40), deadline=None)
@given(seed=st.integers(0, 2**31), quality=st.sampled_from([0.0, 0.3, 0.8, 1.0]))
def test_legitimate_estimator_is_the_textbooks(process: Process, slots: int, seed: int, quality: float) -> None:
    """Lost: (A x̂, A P Aᵀ + Q); state: (z, 0); innovation: (A x̂ + z − χ, A P Aᵀ); before slot 0: (0, Σ0), not predicted."""
    batch = Batch(slots, 2, 5)
    gamma = np.random.default_rng(seed).random((slots, 2)) < quality
    result = beliefs("innovation", process, batch, gamma)
    A, Q = process.A, process.Q
    for r in range(2):
        x_hat, P = np.zeros(process.n), process.initial_covariance
        for k, (_, z, nu) in enumerate(packets("innovation", process, batch)):
            if k:
                x_hat, carried = A @ x_hat, A @ P @ A.T
                P = carried + Q
            action = Action.LOST
            if gamma[k, r] and not nu[r]:
                x_hat, P, action = z[:, r], np.zeros_like(P), Action.STATE
            elif gamma[k, r]:
                x_hat, P, action = x_hat + z[:, r] - chi_of(process, k, 5 + r), carried, Action.INNOVATION
            scale = max(1.0, float(np.abs(z).max()))
            assert np.allclose(result[k].x_hat[:, r], x_hat, rtol=1e-10, atol=1e-9 * scale)
            assert np.allclose(result[k].P[:, :, r], P, rtol=1e-10, atol=1e-12)
            assert result[k].action[r] == action


def test_plain_scheme_is_the_textbooks() -> None:
    """Z = x always; lost: (A x̂, A P Aᵀ + Q), received: (z, 0)."""
    batch = Batch(40, 3)
    gamma = np.random.default_rng(0).random((40, 3)) < 0.6
    result = beliefs("plain", DRIFTING, batch, gamma)
    x_hat, P = np.zeros((3, 3)), np.repeat(DRIFTING.initial_covariance[:, :, None], 3, axis=2)
    for k, (x, z, nu) in enumerate(packets("plain", DRIFTING, batch)):
        assert np.array_equal(x, z)
        assert not nu.any()
        if k:
            x_hat = DRIFTING.A @ x_hat
            P = np.einsum("ij,jkr,lk->ilr", DRIFTING.A, P, DRIFTING.A) + DRIFTING.Q[:, :, None]
        x_hat, P = np.where(gamma[k], x, x_hat), np.where(gamma[k], 0.0, P)
        assert np.allclose(result[k].x_hat, x_hat, rtol=1e-12, atol=1e-13)
        assert np.allclose(result[k].P, P, rtol=1e-12, atol=1e-15)
        assert np.array_equal(result[k].action, np.where(gamma[k], Action.STATE, Action.LOST))


def test_a_lost_packet_desynchronises_nothing() -> None:
    """After any losses the next state packet makes the estimate exact, and decoded innovations keep it exact."""
    slots = 80
    gamma = np.ones((slots, 50), bool)
    gamma[10:30] = False
    result = beliefs("innovation", DRIFTING, Batch(slots, 50), gamma)
    sent = list(packets("innovation", DRIFTING, Batch(slots, 50)))
    synced = np.ones(50, bool)
    for k, (x, _, nu) in enumerate(sent):
        synced = (synced & gamma[k]) | (gamma[k] & ~nu)
        assert np.allclose(result[k].x_hat[:, synced], x[:, synced], rtol=0, atol=1e-12)
        assert not result[k].P[:, :, synced].any()
    assert synced.all()


def test_encoding_noise_has_its_covariance() -> None:
    """χ is white, normal, of covariance A Σ_{k−1} Aᵀ and independent of the process: 20 000 trials at 1e-6 confidence."""
    trials = 20_000
    covariances = state_covariances(DRIFTING, 4)
    before = np.zeros((3, trials))
    chis: list[np.ndarray] = []
    for k, (x, z, nu) in enumerate(packets("innovation", DRIFTING, Batch(4, trials))):
        if k:
            chi = (z - (x - DRIFTING.A @ before))[:, nu]
            white = np.linalg.solve(np.linalg.cholesky(DRIFTING.A @ covariances[k - 1] @ DRIFTING.A.T), chi)
            assert 1e-6 < stats.chi2.cdf(np.sum(white * white), white.size) < 1 - 1e-6
            assert stats.kstest(white.ravel(), "norm").pvalue > 1e-6
            limit = 4.9 / np.sqrt(white.shape[1])
            for i in range(3):
                for j in range(3):
                    other = x[j, nu] / np.sqrt(covariances[k][j, j])
                    assert abs(np.mean(white[i] * other)) < 1.1 * limit
                    assert i == j or abs(np.mean(white[i] * white[j])) < 1.1 * limit
            chis.append(white)
        before = x
    assert len(chis) == 3


@pytest.mark.parametrize("kind", [False, True])
def test_packets_of_either_type_look_alike(kind: bool) -> None:
    """E z zᵀ is Σ_k for states and for innovations: whitened by Σ_k both are standard normal, at 1e-6 confidence."""
    covariances = state_covariances(DRIFTING, 8)
    for k, (_, z, nu) in enumerate(packets("innovation", DRIFTING, Batch(8, 20_000))):
        chosen = z[:, nu == kind]
        if k == 0:
            assert not nu.any()
        if chosen.size:
            white = np.linalg.solve(np.linalg.cholesky(covariances[k]), chosen)
            assert 1e-6 < stats.chi2.cdf(np.sum(white * white), white.size) < 1 - 1e-6
            limit = 5.0 / np.sqrt(white.shape[1])
            assert np.all(np.abs(white @ white.T / white.shape[1] - np.eye(3)) < np.sqrt(2) * limit)
            assert np.all(np.abs(white.mean(axis=1)) < limit)


def test_schedule_has_its_probability() -> None:
    """States come with probability μ_d, and always in slot 0: binomial bounds at 1e-6 confidence."""
    nus = np.stack([nu for _, _, nu in packets("innovation", DRIFTING, Batch(50, 2000))])
    assert not nus[0].any()
    assert stats.binomtest(int((~nus[1:]).sum()), nus[1:].size, MU_D).pvalue > 1e-6


@pytest.mark.parametrize("mu_d", [0.0, 1.0])
def test_certain_schedules(mu_d: float) -> None:
    """μ_d = 1 sends states only; μ_d = 0 innovations only, from slot 1 on."""
    encoder = scheme_of(DRIFTING, {"scheme": "innovation", "state_probability": mu_d}).encoder(KEYS, Batch(30, 20))
    trajectory = Trajectory(DRIFTING, KEYS["process"], Batch(30, 20))
    for k in range(30):
        x = trajectory.advance()
        assert encoder.encode(k, x, trajectory.predicted).nu.all() == (mu_d == 0.0 and k > 0)
