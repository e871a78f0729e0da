"""Lücke, Lu and Quevedo: what their program computes is what ours does, and which of their errors have an expectation."""

from __future__ import annotations

import numpy as np
import pytest

from evedrop.model.process import Process
from evedrop.model.reference_code import ReferenceCode
from evedrop.studies.papers.luecke2022 import MU, STABLE, UNSTABLE, TransmissionPolicy, growth, mean_traces
from tests.model.mixed_runs import covariances


def published_filter(
    process: Process, L: np.ndarray, plain: np.ndarray, acks: np.ndarray, heard: np.ndarray
) -> np.ndarray:
    """P by their equations for x and z, slot by slot from a known x_0; events (slots,), those of slot 0 without meaning.

    Σ_xx = A P Aᵀ + Q, Σ_xz = A P Hᵀ + Q, Σ_zz = H P Hᵀ + Q with H = A − L; without an acknowledgement of the slot before also
    A S Lᵀ in Σ_xz, and H S Lᵀ + L Sᵀ Hᵀ + L Z Lᵀ in Σ_zz. Then a state or a coded state is observed, or nothing.
    """
    A, Q, H = process.A, process.Q, process.A - L
    P = S = Z = np.zeros_like(Q)
    covariances = [P]
    for k in range(1, len(plain)):
        xx, xz, zz = A @ P @ A.T + Q, A @ P @ H.T + Q, H @ P @ H.T + Q
        if not acks[k - 1] and k > 1:
            xz = xz + A @ S @ L.T
            zz = zz + H @ S @ L.T + L @ S.T @ H.T + L @ Z @ L.T
        none = np.zeros_like(Q)
        if not heard[k]:
            P, S, Z = xx, xz, zz
        elif plain[k]:
            P, S, Z = none, none, zz - xz.T @ np.linalg.solve(xx, xz)
        else:
            P, S, Z = xx - xz @ np.linalg.solve(zz, xz.T), none, none
        covariances.append(P)
    return np.array(covariances)


@pytest.mark.parametrize(("process", "open_loop"), [(STABLE, False), (UNSTABLE, True)])
def test_their_filter_is_ours(process: Process, open_loop: bool) -> None:
    """The same covariances over the same events, to rounding."""
    rng = np.random.default_rng(4)
    slots, trials = 60, 40
    plain, flips = rng.random((slots, trials)) < 0.3, rng.random((slots, trials)) < 0.1
    heard = rng.random((slots, trials)) < 0.7
    acks = heard ^ flips
    plain[0] = heard[0] = acks[0] = True  # so that x_0 is known
    ours = covariances(process, plain, acks, heard, open_loop)
    L = ReferenceCode(process, open_loop).at(1)
    for r in range(trials):
        theirs = published_filter(process, L, plain[:, r], acks[:, r], heard[:, r])
        assert np.allclose(ours[..., r], theirs, rtol=1e-9, atol=1e-9)


def test_coded_packets_tell_nothing_about_a_lost_reference() -> None:
    """With L = A the error of the unstable mode grows 1.44-fold a slot, whatever arrives and is acknowledged."""
    rng = np.random.default_rng(5)
    slots, trials = 12, 50
    plain = np.zeros((slots, trials), bool)
    heard, acks = rng.random((2, slots, trials)) < 0.5
    heard[0] = acks[0] = acks[1] = True
    heard[1] = False  # a forged acknowledgement
    mode = np.array([0.7, 0.1])
    assert mode @ UNSTABLE.A == pytest.approx(1.2 * mode)
    errors = np.einsum("i,kijr,j->kr", mode, covariances(UNSTABLE, plain, acks, heard, True), mode)
    assert (errors[1:] >= errors[1] * 1.44 ** np.arange(slots - 1)[:, None] * (1 - 1e-9)).all()
    assert (errors[2:] <= 1.44 * errors[1:-1] + mode @ UNSTABLE.Q @ mode + 1e-9).all()


def test_where_the_expected_error_of_the_unstable_process_has_a_bound() -> None:
    """α above (1 − 1/ρ²)/μ; θ that up to six acknowledged coded packets reach. Their two policies are outside."""
    least = (1.0 - 1.0 / 1.44) / MU
    assert growth(TransmissionPolicy(alpha=least), MU) == pytest.approx(1.0)
    assert growth(TransmissionPolicy(alpha=0.305), MU) == pytest.approx(1.44 * 0.756)
    # One acknowledged coded packet: grown by Σ (1.44 · 0.26)^j 1.44 · 0.74; a state that is not received: acknowledged or not.
    coded = 1.44 * 0.74 / (1 - 1.44 * 0.26)
    missed = 1.44 * 0.02 / (1 - 1.44 * 0.18)
    for theta, packets in ((0.174, 6), (0.175, 7), (0.188, 7)):
        assert growth(TransmissionPolicy(theta=theta), MU) == pytest.approx(coded**packets * missed)
    assert growth(TransmissionPolicy(theta=0.174), MU) < 1.0 < growth(TransmissionPolicy(theta=0.175), MU)
    unheard = 1.44 * 0.2 * 0.74 / (1 - 1.44 * 0.2 * 0.26)
    assert growth(TransmissionPolicy(theta=0.0), MU, legitimate=False) == pytest.approx(unheard)


def test_trials_do_not_depend_on_their_batch() -> None:
    """A trial has the same covariances alone and among others."""
    policy = TransmissionPolicy(alpha=0.3)
    whole = mean_traces(STABLE, policy, (0.8, 0.6), 7, 20)
    assert np.array_equal(mean_traces(STABLE, policy, (0.8, 0.6), 7, 20, side_by_side=3), whole)
    assert whole.shape == (2, 7)
    assert len(set(whole[0])) == 7
