"""The paper's errata, numbered as in docs/errata.md: what is printed fails the very test that the correction passes."""

import numpy as np
import pytest

from evedrop.model.process import Floats, Process, Trajectory, mistakes_of
from evedrop.model.schemes.innovation import Innovation
from evedrop.model.streams import Batch
from evedrop.model.theory.covariances import (
    Outcomes,
    limit_trace,
    state_covariances,
    theoretical_covariances,
    theoretical_traces,
)
from evedrop.model.theory.design import best_difference, design, relative_secrecy
from evedrop.model.theory.ratio import Adversary
from evedrop.studies.papers import microgrid
from tests.builders import stream_keys

A = np.array([[1.0, 0.3], [0.5, 1.001]])
Q = 1e-3 * np.eye(2)
START = np.eye(2)
EXAMPLE = Process(A, Q, START)
MU, MU_D = 0.9, 0.6


def power(k: int, M: Floats) -> Floats:
    """A^k M (A^k)ᵀ."""
    Ak: Floats = np.linalg.matrix_power(A, k)
    return Ak @ M @ Ak.T


def legitimate_formula(k: int, start_weight: float) -> Floats:
    """The finite-k expectation with a factor before its Σ0 term: 1 as printed, 1−μ corrected."""
    kept = 1 - MU * MU_D
    noise = sum((kept**j * power(j, Q) for j in range(k)), np.zeros((2, 2)))
    return start_weight * kept**k * power(k, START) + (1 - MU) * noise


def misled_by(k: int) -> Floats:
    """f_k = 2 (A^k Σ0 A^kᵀ + Σ A^(k−1−l) Q A^(k−1−l)ᵀ), as the lemma has it."""
    return 2 * (power(k, START) + sum((power(k - 1 - j, Q) for j in range(k - 1)), np.zeros((2, 2))))


def eavesdropper_formula(k: int, mu_b1: float, first: Floats) -> Floats:
    """The class's finite-k expectation with a given first term."""
    p_i = MU * (1 - MU_D) * mu_b1
    p_d = 1 - MU * MU_D - p_i
    noise = sum((p_d ** (j + 1) * power(j, Q) for j in range(k)), np.zeros((2, 2)))
    misled = sum((p_d**j * power(j, misled_by(k - j)) for j in range(k)), np.zeros((2, 2)))
    return first + noise + p_i * misled


def words_mean(k: int, legitimate: bool, mu_b1: float) -> Floats:
    """The mean over events, slot by slot, straight from the conditional covariances."""
    E, sigma = (1 - MU) * START, START
    for _ in range(k):
        predicted = A @ E @ A.T + Q
        if legitimate:
            E = (1 - MU) * predicted + MU * (1 - MU_D) * (A @ E @ A.T)
        else:
            used = MU * (1 - MU_D) * mu_b1
            E = (1 - MU * MU_D - used) * predicted + used * 2 * (A @ sigma @ A.T)
        sigma = A @ sigma @ A.T + Q
    return E


@pytest.mark.parametrize("k", [1, 2, 7, 20])
def test_item_1_legitimate_expectation(k: int) -> None:
    """The Σ0 term needs the factor 1−μ: corrected it is the mean over events, printed it is not."""
    truth = words_mean(k, legitimate=True, mu_b1=0.0)
    assert legitimate_formula(k, 1 - MU) == pytest.approx(truth, rel=1e-12)
    assert theoretical_covariances(EXAMPLE, Outcomes.legitimate(MU, MU_D), k + 1)[k] == pytest.approx(truth, rel=1e-12)
    assert legitimate_formula(k, 1.0) != pytest.approx(truth, rel=1e-3)


def test_item_1_numbers() -> None:
    """At k = 1 the trace is 0.1079; the printed formula gives 1.0775."""
    assert np.trace(legitimate_formula(1, 1 - MU)) == pytest.approx(0.1079, abs=5e-5)
    assert np.trace(legitimate_formula(1, 1.0)) == pytest.approx(1.0775, abs=5e-5)


@pytest.mark.parametrize("mu_b1", [0.0, 1.0], ids=["smart", "naive"])
@pytest.mark.parametrize("k", [1, 2, 7, 20])
def test_item_2_eavesdropper_expectation(k: int, mu_b1: float) -> None:
    """The first term is p_0 p_d^k A^k Σ0 A^kᵀ: so it is the mean over events, as printed it is not."""
    p_d = 1 - MU * MU_D - MU * (1 - MU_D) * mu_b1
    truth = words_mean(k, legitimate=False, mu_b1=mu_b1)
    corrected = eavesdropper_formula(k, mu_b1, (1 - MU) * p_d**k * power(k, START))
    assert corrected == pytest.approx(truth, rel=1e-10)
    ours = theoretical_covariances(EXAMPLE, Outcomes.eavesdropper(MU, MU_D, 1.0, mu_b1), k + 1)[k]
    assert ours == pytest.approx(truth, rel=1e-12)
    if p_d**k * np.trace(power(k, START)) > 1e-6 * np.trace(truth):  # beyond, the first term is forgotten anyway
        assert eavesdropper_formula(k, mu_b1, p_d**k * power(k - 1, START)) != pytest.approx(truth, rel=1e-7)


def test_item_2_numbers() -> None:
    """At k = 1: smart 0.1087 against 0.9209 printed, naive 1.7099 against 1.8864 printed."""
    for mu_b1, p_d, corrected, printed in ((0.0, 0.46, 0.1087, 0.9209), (1.0, 0.1, 1.7099, 1.8864)):
        first = (1 - MU) * p_d * power(1, START)
        assert np.trace(eavesdropper_formula(1, mu_b1, first)) == pytest.approx(corrected, abs=5e-5)
        assert np.trace(eavesdropper_formula(1, mu_b1, p_d * START)) == pytest.approx(printed, abs=5e-5)


def test_item_2_base_case_of_the_proof() -> None:
    """The proof's E P_1 lacks p_d Q, and has p_d² where p_0 p_d is meant: the two differ for a suspicious one."""
    mu_b, mu_b1 = 0.8, 0.3
    p_i = MU * (1 - MU_D) * mu_b1
    p_d = 1 - MU * MU_D * mu_b - p_i
    printed = p_d**2 * power(1, START) + p_i * misled_by(1)
    truth = theoretical_covariances(EXAMPLE, Outcomes.eavesdropper(MU, MU_D, mu_b, mu_b1), 2)[1]
    assert (1 - MU * mu_b) * p_d * power(1, START) + p_d * Q + p_i * misled_by(1) == pytest.approx(truth, rel=1e-12)
    assert printed != pytest.approx(truth, rel=1e-3)


@pytest.mark.thorough
def test_item_3_interchanged_numbers() -> None:
    """Printed optimum and upper end of 0.95 are those of 0.99 and the reverse; the last digits are off as well."""
    for mu_e, printed_best, printed_high, best, high in (
        (0.95, 0.5745, 0.8931, 0.5571, 0.9388),
        (0.99, 0.5571, 0.9384, 0.5745, 0.8933),
    ):
        smart = Adversary("smart", mu_e, 1.0, 0.0)
        found_best = best_difference(EXAMPLE, MU, smart)
        ((_, found_high),) = relative_secrecy(EXAMPLE, MU, smart)
        assert found_best == pytest.approx(best, abs=5e-5)
        assert found_best != pytest.approx(printed_best, abs=1e-2)
        assert found_high == pytest.approx(high, abs=5e-5)
        assert found_high != pytest.approx(printed_high, abs=1e-2)
        assert all(abs(found_high - other) > 1e-4 for other in (0.8931, 0.9384))


def test_item_3_lower_ends() -> None:
    """Just above the printed lower end 0.5342 the better eavesdroppers do better than the legitimate estimator."""
    for mu_e, low in ((0.95, 0.54153), (0.99, 0.54790)):
        smart = Adversary("smart", mu_e, 1.0, 0.0)
        ((found_low, _),) = relative_secrecy(EXAMPLE, MU, smart)
        assert found_low == pytest.approx(low, abs=1e-5)
        for mu_d, sign in ((0.5343, -1.0), (low - 1e-4, -1.0), (low + 1e-4, 1.0)):
            ours = limit_trace(EXAMPLE, Outcomes.legitimate(MU, mu_d))
            assert np.sign(limit_trace(EXAMPLE, smart.outcomes(mu_d)) - ours) == sign


@pytest.mark.thorough
def test_item_4_microgrid() -> None:
    """Smart is at most 2.35 times worse than the legitimate estimator, nowhere near 10³; naive with ± 50 % is."""
    legitimate, smart, naive = microgrid.theory(microgrid.DAY, [0.1, 0.5, 0.9])
    assert legitimate == pytest.approx([1.333e-4, 2.667e-5, 1.481e-5], rel=5e-4)
    assert smart == pytest.approx([3.133e-4, 4.667e-5, 1.704e-5], rel=5e-4)
    assert naive == pytest.approx([9.0e3, 5.0e3, 1.0e3], rel=1e-3)
    assert (smart / legitimate).max() == pytest.approx(2.35, rel=1e-3)


@pytest.mark.parametrize("mu_d", [0.1, 0.3, 0.49])
def test_item_5_naive_is_beaten_by_no_estimate_at_all(mu_d: float) -> None:
    """For μ_d < 1/2 the constant estimate 0 has less error than the naive eavesdropper in the long run."""
    process = microgrid.process()
    naive = theoretical_traces(process, Outcomes.eavesdropper(0.6, mu_d, 1.0, 1.0), 5000)[-1]
    zero = np.trace(state_covariances(process, 5000)[-1])
    assert naive > zero
    assert naive / zero == pytest.approx(2 * (1 - mu_d), rel=2e-3)


def test_item_6_successive_packets_tell_types_apart() -> None:
    """E[z_k z_(k−1)ᵀ] is A Σ_(k−1) for two states and 0 with an innovation, though E[z_k z_kᵀ] is Σ_k for both."""
    process = Process(np.array([[1.0, 0.1], [0.0, 0.95]]), np.diag([0.1, 0.2]), np.eye(2))
    batch = Batch(slots=4, trials=40_000)
    keys = stream_keys(6, ("process", "schedule", "noise"))
    trajectory, encoder = Trajectory(process, keys["process"], batch), Innovation(process, 0.5).encoder(keys, batch)
    packets = []
    for k in range(batch.slots):
        x = trajectory.advance()
        packets.append(encoder.encode(k, x, trajectory.predicted))
    (before, nu_before), (now, nu) = ((packet.z, packet.nu) for packet in packets[-2:])
    sigma = state_covariances(process, 4)
    for innovation, cross in ((False, process.A @ sigma[2]), (True, np.zeros((2, 2)))):
        chosen = ~nu_before & (nu == innovation)
        products = now[:, None, chosen] * before[None, :, chosen]
        error = products.std(axis=2, ddof=1) / np.sqrt(chosen.sum())
        assert np.all(np.abs(products.mean(axis=2) - cross) <= 5 * error)
        own = now[:, None, chosen] * now[None, :, chosen]
        error = own.std(axis=2, ddof=1) / np.sqrt(chosen.sum())
        assert np.all(np.abs(own.mean(axis=2) - sigma[3]) <= 5 * error)


def test_item_6_size_of_the_leak() -> None:
    """An eavesdropper that knows the schedule and uses the leak does better than smart, and not better than the estimator."""
    process = Process(A, Q, Q)
    for mu_d, values in ((0.9, (2.672e-4, 4.462e-4, 5.077e-4)), (0.7, (4.756e-4, 1.545e-3, 1.760e-3))):
        information, genie = np.linalg.inv(process.initial_covariance), (1 - MU) * process.initial_covariance
        kept = 1 - MU * mu_d
        for _ in range(60):
            inner = information + A.T @ np.linalg.solve(Q, A)
            leak = Q - A @ np.linalg.solve(inner, A.T)  # Q Σ_k⁻¹ Q, without forming Σ_k, which is soon singular
            information = np.linalg.solve(Q, leak) @ np.linalg.inv(Q)
            genie = kept * (A @ genie @ A.T + Q) - MU * (1 - mu_d) * leak
        legitimate = theoretical_traces(process, Outcomes.legitimate(MU, mu_d), 61)[-1]
        smart = theoretical_traces(process, Outcomes.eavesdropper(MU, mu_d, 1.0, 0.0), 61)[-1]
        assert (legitimate, np.trace(genie), smart) == pytest.approx(values, rel=5e-4)


def test_item_7_kalman_innovations_can_be_singular_and_betray_the_type() -> None:
    """One sensor on two states gives a Q of rank 1: it is refused, and x_k − A x_(k−1) in its range gives states away."""
    F, C, noise = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[1.0, 0.0]]), 0.1 * np.eye(2)
    P = np.eye(2)
    for _ in range(500):
        P = F @ P @ F.T + noise
        gain = P @ C.T / (C @ P @ C.T + 0.5)
        P = P - gain @ C @ P
    innovation = C @ (F @ P @ F.T + noise) @ C.T + 0.5
    singular = gain @ innovation @ gain.T
    assert np.linalg.matrix_rank(singular) == 1
    assert np.linalg.cond(singular) > 1e12
    exact = np.outer([0.75, 0.5], [0.75, 0.5])
    assert any(entry == "Q" and "positive definite" in text for entry, text in mistakes_of(F, exact, np.eye(2)))
    random = np.random.default_rng(7)
    outside = np.array([-gain[1, 0], gain[0, 0]])
    x = random.standard_normal(2)
    w = gain[:, 0] * random.standard_normal()
    state, packet = F @ x + w, w + random.standard_normal(2)
    assert outside @ (state - F @ x) == pytest.approx(0.0, abs=1e-12)
    assert abs(outside @ (packet - F @ x)) > 1e-3


@pytest.mark.parametrize(("mu_e", "last"), [(0.95, 86), (0.99, 58)])
@pytest.mark.thorough
def test_item_8_every_slot_fails_early(mu_e: float, last: int) -> None:
    """At each μ_d* with Σ0 = I the better eavesdropper is ahead up to slot 86 (0.95) or 58 (0.99)."""
    smart = Adversary("smart", mu_e, 1.0, 0.0)
    best = best_difference(EXAMPLE, MU, smart)
    assert best is not None
    result = design(EXAMPLE, MU, best, [smart], slots=1000).eavesdroppers["smart"]
    assert result.violated == ((1, last),)
