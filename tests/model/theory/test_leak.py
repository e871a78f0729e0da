"""The genie: what it does, what theory expects of it, and that it bounds everybody else."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from evedrop.model import modulated
from evedrop.model.eavesdroppers import READERS
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.links import loss_of
from evedrop.model.process import Floats, Process, StateFactors
from evedrop.model.receiver import Action
from evedrop.model.slot.link_distribution import LinkDistribution
from evedrop.model.streams import Batch
from evedrop.model.theory.covariances import (
    Outcomes,
    limit,
    limit_trace,
    radius,
    state_covariances,
    tail_index,
    theoretical_covariances,
    theoretical_traces,
)
from evedrop.model.theory.leak import Leaks, RemainingCovariances, remaining_limit
from tests.builders import MARGINAL
from tests.examples import examples
from tests.model.listening import EXAMPLE, followed, keys, slots

SURE = 4.5  # standard errors: a normal mean is beyond with a probability below 7e-6
MIXED = Process(np.array([[1.2, 0.3, 0.1], [0.0, 0.7, 0.2], [0.0, 0.1, 0.4]]), 0.1 * np.eye(3) + 0.02, np.eye(3))


@st.composite
def systems(draw: st.DrawFn, lowest: float = 0.3, highest: float = 1.6) -> Process:
    """Random processes of one to four states."""
    n, rho = draw(st.integers(1, 4)), draw(st.floats(lowest, highest))
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    A = random.standard_normal((n, n))
    A *= rho / np.abs(np.linalg.eigvals(A)).max()
    Q, start = (f @ f.T + 0.1 * np.eye(n) for f in random.standard_normal((2, n, n)))
    return Process(A, 0.5 * (Q + Q.T), 10.0 ** random.uniform(-3, 3) * 0.5 * (start + start.T))


def conditioned(process: Process, k: int) -> tuple[Floats, Floats]:
    """QΣ_k⁻¹ and Q − QΣ_k⁻¹Q as they are written, for slots where Σ_k can be inverted."""
    sigma = state_covariances(process, k + 1)[k]
    gain = np.linalg.solve(sigma, process.Q).T
    return gain, process.Q - gain @ process.Q


def test_a_slot_of_the_genie() -> None:
    """Lost, state and innovation, one trial at a time, against the formulas with inverses, on both processes."""
    for process in (EXAMPLE, MARGINAL):
        batch = Batch(14, 60)
        genie = READERS["genie"](Knowledge(process, 0.5, {}, keys(1)), batch)
        x_hat, P = np.zeros((60, 2)), np.repeat(process.initial_covariance[None], 60, axis=0)
        for slot, beliefs in followed({"genie": genie}, slots(process, 0.5, 0.7, batch)):
            belief = beliefs["genie"]
            for r in range(60):
                if slot.k:
                    x_hat[r], P[r] = process.A @ x_hat[r], process.A @ P[r] @ process.A.T + process.Q
                if slot.gamma[r] and slot.nu[r]:
                    gain, remaining = conditioned(process, slot.k)
                    x_hat[r] += gain @ slot.z[:, r]
                    P[r] += remaining - process.Q
                elif slot.gamma[r]:
                    x_hat[r], P[r] = slot.z[:, r], 0.0
                expected = Action.LOST if not slot.gamma[r] else Action.INNOVATION if slot.nu[r] else Action.STATE
                assert belief.action[r] == expected
            assert np.allclose(belief.x_hat.T, x_hat, rtol=1e-9, atol=1e-12)
            assert np.allclose(np.moveaxis(belief.P, 2, 0), P, rtol=1e-9, atol=1e-15)


@settings(deadline=None, max_examples=examples(50))
@given(systems())
def test_the_leak_by_triangularisation_is_the_leak(process: Process) -> None:
    """Gain, what remains, Σ_k's determinant and the whitened packet, to 1e-8 of the formulas with inverses, 12 slots.

    An inverse of an ill-conditioned Σ_k has fewer digits.
    """
    leaks, remaining = Leaks(process), RemainingCovariances(process)
    z = np.random.default_rng(1).standard_normal((process.n, 3))
    for k in range(1, 13):
        sigma, (gain, M) = state_covariances(process, k + 1)[k], conditioned(process, k)
        leak, scale, lost = leaks.at(k), np.abs(process.Q).max(), np.finfo(float).eps * np.linalg.cond(sigma)
        assert np.allclose(leak.remaining, M, rtol=1e-8, atol=scale * max(1e-9, lost))
        assert np.allclose(remaining.next(1)[0], M, rtol=1e-8, atol=scale * max(1e-9, lost))
        white = leak.white(z)
        squares = (z * np.linalg.solve(sigma, z)).sum(axis=0)
        assert np.allclose((white * white).sum(axis=0), squares, rtol=max(1e-8, lost))
        assert np.allclose(leak.innovation(white), gain @ z, rtol=1e-8, atol=max(1e-9, lost * scale))
        determinant = float(np.sum(np.log(leak.state_diagonal)))
        assert determinant == pytest.approx(np.linalg.slogdet(sigma)[1], rel=1e-9, abs=1e-9)


@given(st.data())
def test_leaks_in_order_are_computed_once(data: st.DataObject) -> None:
    """For any number of slots at a time: a long live run reads them in blocks of unpredictable lengths."""
    leaks, computed = Leaks(MIXED), list[int]()
    whole, original = Leaks(MIXED).block(range(1, 400)), StateFactors.block

    def counting(factors: StateFactors, slots: range) -> Floats:
        computed.extend(slots)
        return original(factors, slots)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StateFactors, "block", counting)
        k = 1
        while k < 400:
            stop = data.draw(st.integers(k + 1, min(k + 100, 400)))
            assert np.array_equal(leaks.block(range(k, stop)), whole[k - 1 : stop - 1])
            k = stop
    assert computed == list(range(1, computed[-1] + 1))


def test_the_leak_where_the_state_covariance_cannot_be_inverted() -> None:
    """Up to slot 90 of the unstable example both ways agree to rounding of Q, and nothing remains that exceeds Q."""
    leaks, remaining = Leaks(EXAMPLE), RemainingCovariances(EXAMPLE)
    for k in range(1, 91):
        M = leaks.at(k).remaining
        assert np.allclose(M, remaining.next(1)[0], rtol=0, atol=1e-14 * 1e-3)
        assert np.linalg.eigvalsh(EXAMPLE.Q - M)[0] > -1e-16


@settings(deadline=None, max_examples=examples(60))
@given(systems(), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_the_expectation_is_the_recursion(process: Process, mu_e: float, mu_d: float) -> None:
    """P_k = q(A P Aᵀ + Q) − μ_e(1−μ_d) QΣ_k⁻¹Q from P_0 = (1−μ_e)Σ0, to 1e-8, twelve slots."""
    result = theoretical_covariances(process, Outcomes.genie(mu_e, mu_d), 12)
    q, P = 1.0 - mu_e * mu_d, (1.0 - mu_e) * process.initial_covariance
    for k in range(12):
        if k:
            leak = process.Q - conditioned(process, k)[1]
            P = q * (process.A @ P @ process.A.T + process.Q) - mu_e * (1.0 - mu_d) * leak
        scale = np.abs(process.Q).max() + np.abs(P).max()
        assert np.allclose(result[k], P, rtol=1e-8, atol=1e-9 * scale)


def test_known_values() -> None:
    """Numerical example, μ = μ_e = 0.9, Σ0 = Q, slot 60; and slots do not depend on how many are asked for at a time."""
    for mu_d, value in ((0.9, 4.462e-4), (0.7, 1.545e-3)):
        assert theoretical_traces(EXAMPLE, Outcomes.genie(0.9, mu_d), 61)[60] == pytest.approx(value, rel=5e-4)
    whole = theoretical_traces(MARGINAL, Outcomes.genie(0.9, 0.3), 700)
    assert np.array_equal(whole[:300], theoretical_traces(MARGINAL, Outcomes.genie(0.9, 0.3), 300))


@settings(deadline=None, max_examples=examples(150))
@given(systems(0.9), st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 0.999))
def test_nobody_without_the_secret_does_better(process: Process, mu: float, fraction: float, mu_d: float) -> None:
    """For μ_e ≤ μ and μ_d < 1 the genie is at no k better than the legitimate estimator, as matrices.

    It is never worse than smart, and unbounded exactly when smart is.
    """
    mu_e = mu * fraction
    ours = theoretical_covariances(process, Outcomes.legitimate(mu, mu_d), 40)
    genie = theoretical_covariances(process, Outcomes.genie(mu_e, mu_d), 40)
    smart = theoretical_covariances(process, Outcomes.eavesdropper(mu_e, mu_d, 1.0, 0.0), 40)
    for k in range(40):
        scale = np.abs(smart[k]).max() + np.abs(process.Q).max()
        assert np.linalg.eigvalsh(genie[k] - ours[k])[0] >= -1e-11 * scale
        assert np.linalg.eigvalsh(smart[k] - genie[k])[0] >= -1e-11 * scale
    limits = [
        limit_trace(process, outcomes)
        for outcomes in (Outcomes.genie(mu_e, mu_d), Outcomes.eavesdropper(mu_e, mu_d, 1, 0))
    ]
    assert math.isinf(limits[0]) == math.isinf(limits[1])


@pytest.mark.parametrize("process", [EXAMPLE, MIXED], ids=["unstable", "mixed"])
def test_the_limit_is_where_it_goes(process: Process) -> None:
    """The expectation of slot 600 is the limit, to 1e-9; the leak ends in unstable directions, and goes on in stable ones."""
    remaining = RemainingCovariances(process)
    for _ in range(600):
        M = remaining.next(1)[0]
    assert np.allclose(M, remaining_limit(process), rtol=0, atol=1e-12 * np.abs(process.Q).max())
    leaks = np.linalg.eigvalsh(process.Q - M)
    assert (leaks[-1] > 1e-3) == (process is MIXED)
    outcomes = Outcomes.genie(0.9, 0.9)
    last = theoretical_covariances(process, outcomes, 601)[600]
    assert np.allclose(last, limit(process, outcomes), rtol=1e-9, atol=1e-9 * np.abs(last).max())


@settings(deadline=None, max_examples=examples(40))
@given(systems(0.3, 0.9), st.floats(0.01, 1.0), st.floats(0.0, 1.0))
def test_the_limit_of_stable_processes(process: Process, mu_e: float, mu_d: float) -> None:
    """There Σ_k converges, and what remains of the noise is Q − QΣ⁻¹Q with Σ its limit."""
    assume(radius(process) < 1.0)
    outcomes = Outcomes.genie(mu_e, mu_d)
    last = theoretical_covariances(process, outcomes, 400)[399]
    assert np.allclose(last, limit(process, outcomes), rtol=1e-7, atol=1e-8 * np.abs(process.Q).max())


def test_bursts_and_tails() -> None:
    """Behind a bursty link of one quality it is the independent one; the limit is where the recursion goes; tails as smart's."""

    def at(quality: float) -> Outcomes:
        return Outcomes.genie(quality, 0.8)

    even = loss_of({"model": "gilbert-elliott", "p": 0.1, "r": 0.3, "good": 0.2, "bad": 0.2}).chain
    bursts = loss_of({"model": "gilbert-elliott", "p": 0.05, "r": 0.8}).chain
    assert even is not None
    assert bursts is not None
    traces = modulated.ModulatedCovariance(EXAMPLE, LinkDistribution.steady(even), at).next_traces(50)
    assert np.allclose(traces, theoretical_traces(EXAMPLE, Outcomes.genie(0.8, 0.8), 50), rtol=1e-12)
    for process in (EXAMPLE, MIXED):
        late = modulated.ModulatedCovariance(process, LinkDistribution.steady(bursts), at).next_traces(800)[-1]
        assert late == pytest.approx(modulated.limit_trace(process, bursts, at), rel=1e-9)
    smart = Outcomes.eavesdropper(0.9, 0.7, 1.0, 0.0)
    assert tail_index(EXAMPLE, Outcomes.genie(0.9, 0.7)) == pytest.approx(tail_index(EXAMPLE, smart), rel=1e-14)
    assert limit_trace(EXAMPLE, Outcomes.genie(1.0, 0.9)) > 0.0


def test_simulated_genies_agree_with_theory() -> None:
    """Squared error and reported trace, every third slot of two processes, 4000 trials, at 4.5 standard errors."""
    for process, mu_d in ((MARGINAL, 0.3), (EXAMPLE, 0.9)):
        batch = Batch(31, 4000)
        genie = READERS["genie"](Knowledge(process, mu_d, {}, keys(3)), batch)
        expected = theoretical_traces(process, Outcomes.genie(0.9, mu_d), 31)
        for slot, beliefs in followed({"genie": genie}, slots(process, mu_d, 0.9, batch, 3)):
            belief = beliefs["genie"]
            if slot.k % 3 == 0 and slot.k:
                for sample in (((slot.x - belief.x_hat) ** 2).sum(axis=0), np.trace(belief.P)):
                    spread = sample.std(ddof=1) / np.sqrt(4000)
                    assert abs(sample.mean() - expected[slot.k]) <= SURE * spread, slot.k


@pytest.mark.thorough
def test_it_bounds_every_strategy() -> None:
    """No strategy that hears the same packets has a smaller mean error in any slot, at 4.5 standard errors of the difference.

    Learners are left out: they are slow, and know less than the others.
    """
    batch, parameters = Batch(60, 2000), {"use_state": 0.9, "use_innovation": 0.1}
    receivers = {
        name: made(Knowledge(MARGINAL, 0.3, parameters, keys(5)), batch)
        for name, made in READERS.items()
        if not made.costly
    }
    for slot, beliefs in followed(receivers, slots(MARGINAL, 0.3, 0.9, batch, 5)):
        errors = {name: ((slot.x - belief.x_hat) ** 2).sum(axis=0) for name, belief in beliefs.items()}
        for name, error in errors.items():
            excess = error - errors["genie"]
            assert excess.mean() >= -SURE * excess.std(ddof=1) / np.sqrt(2000) - 1e-15, (slot.k, name)


def test_nothing_is_left_to_leak_of_a_process_without_stable_directions() -> None:
    """In the limit Σ grows without bound in every direction, so that an innovation says nothing of the noise."""
    unstable = Process(np.array([[1.2, 0.3], [0.0, 1.1]]), 0.1 * np.eye(2) + 0.02, np.eye(2))
    assert np.array_equal(remaining_limit(unstable), unstable.Q)
    stable = Process(0.5 * np.eye(2), unstable.Q, np.eye(2))
    assert np.linalg.eigvalsh(stable.Q - remaining_limit(stable))[0] > 0.0
