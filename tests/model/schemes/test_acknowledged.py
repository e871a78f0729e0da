"""Receivers of state-secrecy codes: what they know, and what becomes of them under attack."""

from __future__ import annotations

import numpy as np
import pytest

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.process import Process
from evedrop.model.receiver import Action, Reception
from evedrop.model.reference_code import ReferenceReceiver
from evedrop.model.schemes.acknowledged import Acknowledged, OpenLoop
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.streams import Batch
from tests.builders import DRIFTING, UNSTABLE
from tests.model.acknowledged_runs import MIXED, SINGULAR, all_events, carried, played_over
from tests.model.slot_loop import STABLE, Played

CODES = pytest.mark.parametrize("scheme", [Acknowledged, OpenLoop])


@CODES
@pytest.mark.parametrize(
    "process",
    [UNSTABLE, DRIFTING, *(pytest.param(stable, marks=pytest.mark.long) for stable in (STABLE, MIXED)), SINGULAR],
)
def test_packets_are_the_codes(process: Process, scheme: type[Scheme]) -> None:
    """Z is x_k − L_{t,k} x_t with t the last acknowledged slot, as the header says; x_k with −1 before the first."""
    rng = np.random.default_rng(5)
    gamma, heard, acks = rng.random((3, 20, 30)) < 0.7
    played = played_over(process, gamma, heard, gamma & acks, scheme)
    matrices = {(t, k): carried(process, t, k, scheme) for k in range(20) for t in range(k)}
    for k, packet in enumerate(played.packets):
        assert packet.header is not None
        for r in range(30):
            slots = [t for t in range(k) if gamma[t, r] and acks[t, r]]
            content = [] if scheme is Acknowledged else [2 if slots else 0]
            assert packet.header[:, r].tolist() == [slots[-1] if slots else -1, *content]
            L = matrices[slots[-1], k] if slots else 0.0 * process.A
            expected = played.x[k][:, r] - L @ played.x[slots[-1] if slots else 0][:, r]
            scale = np.abs(played.x[k]).max() + np.abs(L).max() * np.abs(played.x[0]).max() + 1.0
            assert np.allclose(packet.z[:, r], expected, rtol=0, atol=1e-12 * scale)


@CODES
@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING, STABLE, MIXED, SINGULAR])
def test_the_user_reads_every_packet_whichever_acknowledgements_arrive(process: Process, scheme: type[Scheme]) -> None:
    """Unless they are forged: after any losses of packets and acknowledgements (x, 0) where received, else (A x̂, A P Aᵀ + Q)."""
    rng = np.random.default_rng(6)
    gamma, link = rng.random((2, 40, 200)) < np.array([0.6, 0.5])[:, None, None]
    played = played_over(process, gamma, gamma, gamma & link, scheme)
    P = np.repeat(process.initial_covariance[:, :, None], 200, axis=2)
    for k, belief in enumerate(played.beliefs["legitimate"]):
        if k:
            P = np.einsum("ij,jkr,lk->ilr", process.A, P, process.A) + process.Q[:, :, None]
        P = np.where(gamma[k], 0.0, P)
        assert np.allclose(belief.P, P, rtol=1e-10, atol=1e-13)
        # A reference may be 2³⁰ times the state, whose last digits are lost then.
        scale = (1e4 if process is MIXED else 1.0) * (np.abs(played.x[k]).max() + 1.0)
        assert np.allclose(belief.x_hat[:, gamma[k]], played.x[k][:, gamma[k]], rtol=0, atol=1e-11 * scale)
        assert (belief.action == np.where(gamma[k], Action.STATE, Action.LOST)).all()


def conditioned(
    process: Process, played: Played, r: int, gamma_e: np.ndarray, scheme: type[Scheme] = Acknowledged
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the last x given all that the eavesdropper heard in trial r, by conditioning (x_0, w, …)."""
    n, slots = process.n, len(played.x)
    joint = np.kron(np.eye(slots), process.Q)
    joint[:n, :n] = process.initial_covariance
    states = [np.hstack([np.eye(n), np.zeros((n, n * (slots - 1)))])]
    for k in range(1, slots):
        states.append(process.A @ states[-1])
        states[-1][:, k * n : (k + 1) * n] += np.eye(n)
    rows, values = [], []
    for k in range(slots):
        if gamma_e[k, r]:
            packet = played.packets[k]
            assert packet.header is not None
            t = int(packet.header[0, r])
            L = carried(process, t, k, scheme) if t >= 0 else np.zeros((n, n))
            rows.append(states[k] - L @ states[max(t, 0)])
            values.append(packet.z[:, r])
    x = states[-1]
    if not rows:
        return np.zeros(n), x @ joint @ x.T
    H, z = np.vstack(rows), np.concatenate(values)
    gain = np.linalg.pinv(H @ joint @ H.T, rcond=1e-13, hermitian=True)
    cross = x @ joint @ H.T
    return cross @ gain @ z, x @ joint @ x.T - cross @ gain @ cross.T


@CODES
@pytest.mark.parametrize(
    "process", [UNSTABLE, *(pytest.param(stable, marks=pytest.mark.long) for stable in (STABLE, MIXED)), SINGULAR]
)
def test_the_eavesdropper_of_references_is_optimal(process: Process, scheme: type[Scheme]) -> None:
    """Its estimate and covariance are those of the state given all that it heard, in courses of five slots, for either code."""
    gamma, gamma_e, link = all_events(5)
    played = played_over(process, gamma, gamma_e, gamma & link, scheme)
    belief = played.beliefs["eve"][-1]
    for r in np.random.default_rng(0).choice(gamma.shape[1], 200, replace=False):
        mean, covariance = conditioned(process, played, r, gamma_e, scheme)
        assert np.allclose(belief.x_hat[:, r], mean, rtol=0, atol=1e-8)
        assert np.allclose(belief.P[:, :, r], covariance, rtol=0, atol=1e-8)


def test_the_action_of_a_reader_of_references_is_not_known_from_its_link() -> None:
    """It depends on the header."""
    with pytest.raises(NotImplementedError, match="depends on the packet's header"):
        ReferenceReceiver(UNSTABLE, 3).act(0, np.ones(3, bool))


def test_a_header_that_names_what_nobody_has_is_discarded() -> None:
    """Slots to come, forgotten ones and nonsense are not decoded, and change nothing but the packet's fate."""
    receiver = ReferenceReceiver(UNSTABLE, 3)
    belief = receiver.prior()
    z, on = np.ones((2, 3)), np.ones(3, bool)
    for k in range(3):
        belief = receiver.step(k, belief, Reception(on, z, np.full((1, 3), k - 1)))
    after = receiver.step(3, belief, Reception(on, z, np.array([[3, 0, -7]])))
    assert (after.action == Action.DISCARDED).all()
    assert np.allclose(after.x_hat, UNSTABLE.A @ belief.x_hat)
    without = receiver.step(3, belief, Reception(on, z))
    assert (without.action == Action.STATE).all()
    assert np.array_equal(without.x_hat, z)


def test_acknowledgements_must_be_of_the_slot_just_sent() -> None:
    """A late acknowledgement is refused: the state it speaks of is no longer kept."""
    encoder = Acknowledged(UNSTABLE).encoder({}, Batch(3, 1))
    x = np.ones((2, 1))
    encoder.encode(0, x, x)
    encoder.encode(1, x, x)
    with pytest.raises(ValueError, match="acknowledgements of slot 0 after slot 1 was sent"):
        encoder.acknowledged(0, np.ones(1, bool))


def test_a_betrayed_state_is_a_reference_like_any_other() -> None:
    """An eavesdropper that learns x_3 reads every packet with a reference to slot 3, exactly."""
    batch, learns_at = Batch(8, 2), 3
    parameters = {"reads_as": "reference", "learns_at": learns_at}
    spy = STRATEGIES["replay-informed"](Knowledge(UNSTABLE, 1.0, parameters, {}), batch)
    x = np.random.default_rng(2).normal(size=(8, 2, 2))
    belief, nothing = spy.prior(), np.zeros(2, bool)
    for k in range(learns_at + 2):
        belief = spy.step(k, belief, Reception(nothing, x[k], truth=x[k] if k == learns_at else None))
        assert (k == learns_at) == np.array_equal(belief.x_hat, x[k])
    k = learns_at + 2
    z = x[k] - carried(UNSTABLE, learns_at, k) @ x[learns_at]
    belief = spy.step(k, belief, Reception(~nothing, z, np.full((1, 2), learns_at)))
    assert np.allclose(belief.x_hat, x[k], rtol=1e-12)
    assert np.abs(belief.P).max() < 1e-28  # the rounding of x_3
    # Once it has read a packet, the reference of that packet stays valid when it learns another state.
    z = x[k + 1] - carried(UNSTABLE, learns_at, k + 1) @ x[learns_at]
    spy = STRATEGIES["replay-informed"](Knowledge(UNSTABLE, 1.0, {**parameters, "learns_at": k}, {}), batch)
    belief = spy.step(k, belief, Reception(nothing, x[k], truth=x[k]))
    belief = spy.step(k + 1, belief, Reception(~nothing, z, np.full((1, 2), learns_at)))
    assert np.allclose(belief.x_hat, x[k + 1], rtol=1e-12)


def test_a_receiver_that_begins_later_knows_the_states_distribution() -> None:
    """Before slot 5 the factor of its knowledge is that of its covariance in slot 4; it follows references since then."""
    for process in (UNSTABLE, STABLE):
        receiver = ReferenceReceiver(process, 2)
        belief = receiver.prior(5)
        X = belief.memory[2][:, :, 0]
        assert np.allclose(X @ X.T, belief.P[:, :, 0], rtol=1e-12)
        on, z = np.ones(2, bool), np.ones((2, 2))
        for t, action in ((3, Action.DISCARDED), (4, Action.INNOVATION)):
            assert (receiver.step(5, belief, Reception(on, z, np.full((1, 2), t))).action == action).all()


def test_a_state_that_is_betrayed_in_slot_0_is_known() -> None:
    """With no reference yet; the next packet with a reference to slot 0 is read, up to the rounding of x_0."""
    receiver = ReferenceReceiver(STABLE, 2)
    x = np.ones((2, 2))
    belief = receiver.informed(0, x, receiver.prior())
    after = receiver.step(1, belief, Reception(np.ones(2, bool), x, np.zeros((1, 2), np.int64)))
    assert np.allclose(after.x_hat, x + carried(STABLE, 0, 1) @ x, rtol=1e-12)
    assert np.abs(after.P).max() < 1e-28


def test_each_trial_follows_its_own_headers_code() -> None:
    """In one batch, one packet is coded, one with L = A, and one is the state; each is read as it would be alone."""
    receiver, alone = ReferenceReceiver(STABLE, 3), ReferenceReceiver(STABLE, 1)
    x = np.array([[1.0, 2.0, 3.0], [0.5, 0.1, -1.0]])
    belief, single = receiver.prior(), alone.prior()
    slot, on = np.zeros(3, np.int64), np.ones(3, bool)
    belief = receiver.step(0, belief, Reception(on, x, np.array([slot - 1, slot])))
    belief = receiver.step(1, belief, Reception(on, 0.1 * x, np.array([slot, [1, 2, 0]])))
    expected = [carried(STABLE, 0, 1) @ x[:, 0] + 0.1 * x[:, 0], STABLE.A @ x[:, 1] + 0.1 * x[:, 1], 0.1 * x[:, 2]]
    assert np.allclose(belief.x_hat, np.array(expected).T, rtol=1e-12)
    for r in range(3):
        single = alone.step(0, alone.prior(), Reception(on[:1], x[:, [r]], np.array([[-1], [0]])))
        single = alone.step(1, single, Reception(on[:1], 0.1 * x[:, [r]], np.array([[0], [[1, 2, 0][r]]])))
        assert single.x_hat.tobytes() == belief.x_hat[:, [r]].copy().tobytes()
    # A reference that is named with another code than before is not followed.
    assert (receiver.step(2, belief, Reception(on, x, np.array([slot, [2, 1, 2]]))).action == Action.DISCARDED).all()


def test_blocked_acknowledgements_open_every_packet() -> None:
    """Without acknowledgements, or without the critical ones, the eavesdropper reads all that it hears."""
    rng = np.random.default_rng(8)
    gamma, gamma_e = rng.random((2, 30, 300)) < 0.8
    for acks in (np.zeros_like(gamma), gamma & gamma_e):
        played = played_over(UNSTABLE, gamma, gamma_e, acks)
        for k, belief in enumerate(played.beliefs["eve"]):
            assert not belief.P[:, :, gamma_e[k]].any()


def test_one_forged_acknowledgement_loses_the_legitimate_estimator() -> None:
    """Acknowledged in its name where it heard nothing, the legitimate estimator never again has an error below A^m P A^mᵀ."""
    gamma, forged = np.ones((12, 1), bool), np.ones((12, 1), bool)
    gamma[4] = False
    belief = played_over(UNSTABLE, gamma, gamma, forged, OpenLoop).beliefs["legitimate"]
    for k in range(5, 12):
        power = np.linalg.matrix_power(UNSTABLE.A, k - 4)
        assert np.allclose(belief[k].P[:, :, 0], power @ UNSTABLE.Q @ power.T, rtol=1e-9)
        assert belief[k].action[0] == Action.INNOVATION
