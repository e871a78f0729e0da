"""State-secrecy codes: what acknowledged references keep from an eavesdropper, and what becomes of them under attack."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.process import Process
from evedrop.model.receiver import Action, Reception
from evedrop.model.reference import ReferenceCode, ReferenceReceiver, stationary_covariance
from evedrop.model.schemes.acknowledged import Acknowledged
from evedrop.model.theory.closed_forms import reference_covariances
from evedrop.model.theory.covariances import expected_covariances
from evedrop.streams import Batch
from tests.builders import DRIFTING, UNSTABLE
from tests.model.slot_loop import STABLE, Played, play


def played_over(process: Process, gamma: np.ndarray, gamma_e: np.ndarray, acks: np.ndarray) -> Played:
    """The scheme with one eavesdropper of references, over given events, all (slots, R)."""
    slots, trials = gamma.shape
    batch = Batch(slots, trials)
    eve = STRATEGIES["reference"](Knowledge(process, 1.0, {}, {}), batch)
    links = {"legitimate": gamma, "eve": gamma_e}
    return play(Acknowledged(process), batch, links, {"eve": eve}, lambda k, *_: acks[k])


def all_events(slots: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every course that γ, γᵉ and the acknowledgement link may take, one a trial: three of (slots, 8^slots)."""
    courses = np.array(list(itertools.product(range(8), repeat=slots))).T
    return courses % 2 == 1, courses // 2 % 2 == 1, courses // 4 == 1


@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING, STABLE])
def test_packets_are_the_codes(process: Process) -> None:
    """Z is x_k − L^{k−t} x_t with t the last acknowledged slot, as the header says; x_k with −1 before the first."""
    rng = np.random.default_rng(5)
    gamma, heard, acks = rng.random((3, 25, 40)) < 0.7
    played = played_over(process, gamma, heard, gamma & acks)
    L = ReferenceCode(process).L
    for k, packet in enumerate(played.packets):
        assert packet.header is not None
        for r in range(40):
            slots = [t for t in range(k) if gamma[t, r] and acks[t, r]]
            assert packet.header[0, r] == (slots[-1] if slots else -1)
            power = np.linalg.matrix_power(L, k - slots[-1]) if slots else 0.0 * L
            expected = played.x[k][:, r] - power @ played.x[slots[-1] if slots else 0][:, r]
            scale = np.abs(played.x[k]).max() + np.abs(power).max() * np.abs(played.x[0]).max() + 1.0
            assert np.allclose(packet.z[:, r], expected, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING, STABLE])
def test_the_user_reads_every_packet_whichever_acknowledgements_arrive(process: Process) -> None:
    """Unless they are forged: after any losses of packets and acknowledgements (x, 0) where received, else (A x̂, A P Aᵀ + Q)."""
    rng = np.random.default_rng(6)
    gamma, link = rng.random((2, 40, 200)) < np.array([0.6, 0.5])[:, None, None]
    played = played_over(process, gamma, gamma, gamma & link)
    P = np.repeat(process.initial_covariance[:, :, None], 200, axis=2)
    for k, belief in enumerate(played.beliefs["legitimate"]):
        if k:
            P = np.einsum("ij,jkr,lk->ilr", process.A, P, process.A) + process.Q[:, :, None]
        P = np.where(gamma[k], 0.0, P)
        assert np.allclose(belief.P, P, rtol=1e-10, atol=1e-13)
        scale = np.abs(played.x[k]).max() + 1.0
        assert np.allclose(belief.x_hat[:, gamma[k]], played.x[k][:, gamma[k]], rtol=0, atol=1e-11 * scale)
        assert (belief.action == np.where(gamma[k], Action.STATE, Action.LOST)).all()


def conditioned(process: Process, played: Played, r: int, gamma_e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
            L = np.linalg.matrix_power(ReferenceCode(process).L, k - t) if t >= 0 else np.zeros((n, n))
            rows.append(states[k] - L @ states[max(t, 0)])
            values.append(packet.z[:, r])
    x = states[-1]
    if not rows:
        return np.zeros(n), x @ joint @ x.T
    H, z = np.vstack(rows), np.concatenate(values)
    gain = np.linalg.pinv(H @ joint @ H.T, rcond=1e-13, hermitian=True)
    cross = x @ joint @ H.T
    return cross @ gain @ z, x @ joint @ x.T - cross @ gain @ cross.T


def test_the_eavesdropper_of_references_is_optimal() -> None:
    """For L = A its estimate and covariance are those of the state given all that it heard, in every course of four slots."""
    process = Process(np.array([[1.1, 0.3], [0.2, 0.9]]), np.array([[0.5, 0.1], [0.1, 0.4]]), np.eye(2))
    gamma, gamma_e, link = all_events(4)
    played = played_over(process, gamma, gamma_e, gamma & link)
    belief = played.beliefs["eve"][-1]
    for r in np.random.default_rng(0).choice(gamma.shape[1], 500, replace=False):
        mean, covariance = conditioned(process, played, r, gamma_e)
        assert np.allclose(belief.x_hat[:, r], mean, rtol=0, atol=1e-9)
        assert np.allclose(belief.P[:, :, r], covariance, rtol=0, atol=1e-9)


@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING])
@pytest.mark.parametrize("rule", ["honest", "blocked", "critical blocked", "forged"])
def test_expectations_are_the_recursion(process: Process, rule: str) -> None:
    """E P of user and eavesdropper over every course of four slots, each with its probability, is the recursion's, exactly."""
    gamma, gamma_e, link = all_events(4)
    acks = {
        "honest": gamma & link,
        "blocked": np.zeros_like(gamma),
        "critical blocked": gamma & gamma_e & link,
        "forged": link,
    }[rule]
    mu, mu_e, arrives = 0.7, 0.6, 0.8
    played = played_over(process, gamma, gamma_e, acks)
    weights = np.where(gamma, mu, 1 - mu) * np.where(gamma_e, mu_e, 1 - mu_e) * np.where(link, arrives, 1 - arrives)
    chances = weights.prod(0)
    assert np.isclose(chances.sum(), 1.0)
    for name, heard, quality in (("legitimate", gamma, mu), ("eve", gamma_e, mu_e)):
        joint = [float(chances[acks[0] & (heard[0] == flag)].sum()) for flag in (True, False)]
        expected = reference_covariances(process, quality, (joint[0], joint[1]), 4)
        for k, belief in enumerate(played.beliefs[name]):
            assert np.allclose(belief.P @ chances, expected[k], rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize(
    ("initial", "honest"), [(1e-3 * np.eye(2), 4.91e7), (np.eye(2), 2.36e10)], ids=["from Q", "from I"]
)
def test_the_papers_example(initial: np.ndarray, honest: float) -> None:
    """Slot 40, μ = μ_e = 0.9: lost for good with honest acknowledgements; as good as the user where the critical ones fail."""
    process = Process(UNSTABLE.A, UNSTABLE.Q, initial)
    found = reference_covariances(process, 0.9, (0.81, 0.09), 41)
    assert np.trace(found[40]) == pytest.approx(honest, rel=2e-3)
    user = np.trace(expected_covariances(process, Acknowledged(process).outcomes(0.9), 41)[40])
    assert user == pytest.approx(2.284e-4, rel=2e-4)
    for acknowledged in ((0.0, 0.0), (0.81, 0.0)):
        blocked = np.trace(reference_covariances(process, 0.9, acknowledged, 41)[40])
        assert blocked == pytest.approx(user, rel=1e-12)


def test_blocked_acknowledgements_open_every_packet() -> None:
    """Without acknowledgements, or without the critical ones, the eavesdropper reads all that it hears."""
    rng = np.random.default_rng(8)
    gamma, gamma_e = rng.random((2, 30, 300)) < 0.8
    for acks in (np.zeros_like(gamma), gamma & gamma_e):
        played = played_over(UNSTABLE, gamma, gamma_e, acks)
        for k, belief in enumerate(played.beliefs["eve"]):
            assert not belief.P[:, :, gamma_e[k]].any()


def test_one_forged_acknowledgement_loses_the_user() -> None:
    """Acknowledged in its name where it heard nothing, the user never again has an error below A^m P A^mᵀ."""
    gamma, forged = np.ones((12, 1), bool), np.ones((12, 1), bool)
    gamma[4] = False
    belief = played_over(UNSTABLE, gamma, gamma, forged).beliefs["legitimate"]
    for k in range(5, 12):
        power = np.linalg.matrix_power(UNSTABLE.A, k - 4)
        assert np.allclose(belief[k].P[:, :, 0], power @ UNSTABLE.Q @ power.T, rtol=1e-9)
        assert belief[k].action[0] == Action.INNOVATION


def test_a_stable_code_makes_packets_independent_of_the_state() -> None:
    """For stable A and stationary start z_k has no covariance with x_k, over any age of the reference, and L = Σ A⁻ᵀ Σ⁻¹."""
    sigma = stationary_covariance(STABLE)
    assert np.allclose(sigma, STABLE.A @ sigma @ STABLE.A.T + STABLE.Q, rtol=1e-12)
    L = ReferenceCode(STABLE).L
    assert np.allclose(L, sigma @ np.linalg.inv(STABLE.A).T @ np.linalg.inv(sigma), rtol=1e-9)
    for age in range(1, 20):
        correlation = sigma - np.linalg.matrix_power(STABLE.A, age) @ sigma @ np.linalg.matrix_power(L, age).T
        assert np.abs(correlation).max() < 1e-9 * np.abs(np.linalg.matrix_power(L, age)).max()


def test_information_on_a_stable_state_decays_at_the_open_loop_rate() -> None:
    """Information J on x_t beyond Σ⁻¹ is Bᵏᵀ J Bᵏ on x_{t+k}, B = Σ Aᵀ Σ⁻¹, even for a receiver of all packets since."""
    sigma, code = stationary_covariance(STABLE), ReferenceCode(STABLE)
    J = np.array([[40.0, 3.0], [3.0, 25.0]])
    n, steps = 2, 5
    start = np.linalg.inv(np.linalg.inv(sigma) + J)  # of x_t given what is known
    joint = np.kron(np.eye(steps + 1), STABLE.Q)
    joint[:n, :n] = start
    states = [np.hstack([np.eye(n), np.zeros((n, n * steps))])]
    for k in range(1, steps + 1):
        states.append(STABLE.A @ states[-1])
        states[-1][:, k * n : (k + 1) * n] += np.eye(n)
    H = np.vstack([states[k] - code.L @ states[k - 1] for k in range(1, steps + 1)])
    x = states[-1]
    cross = x @ joint @ H.T
    covariance = x @ joint @ x.T - cross @ np.linalg.solve(H @ joint @ H.T, cross.T)
    B = np.linalg.matrix_power(sigma @ STABLE.A.T @ np.linalg.inv(sigma), steps)
    assert np.allclose(np.linalg.inv(covariance), np.linalg.inv(sigma) + B.T @ J @ B, rtol=1e-6)


def test_a_stable_reference_that_is_too_old_is_let_go() -> None:
    """Beyond the age at which L^m x_t drowns x_k the packet is the state again, and nothing overflows on any side."""
    process = Process(0.2 * np.eye(2) + 0.05, 0.1 * np.eye(2), np.eye(2))
    longest = ReferenceCode(process).longest
    assert 5 < longest < 60
    slots = 1000
    gamma, acks = np.ones((slots, 4), bool), np.zeros((slots, 4), bool)
    acks[3] = True
    gamma[5:900, 1:] = False
    played = played_over(process, gamma, gamma, acks)
    headers = [int(packet.header[0, 0]) for packet in played.packets if packet.header is not None]
    assert headers == [-1] * 4 + [3] * longest + [-1] * (slots - 4 - longest)
    for k in (0, 4, 3 + longest, slots - 1):
        last = played.beliefs["legitimate"][k]
        heard = gamma[k]
        assert np.allclose(last.x_hat[:, heard], played.x[k][:, heard], atol=1e-2 * np.sqrt(0.1))
        assert not last.P[:, :, heard].any()


@pytest.mark.parametrize("a", [0.3, 0.9, 0.9999, 1.0 - 1e-5])
def test_the_age_at_which_a_reference_drowns_the_state_is_exact(a: float) -> None:
    """Of one state, L is 1/a: the last m with 2⁻⁵³ a^−m √Σ ≤ 0.01 √Q; of a slow one, found without going slot by slot."""
    code = ReferenceCode(Process(np.array([[a]]), np.array([[1e-3]]), np.eye(1)))
    sigma = 1e-3 / (1.0 - a * a)
    assert float(stationary_covariance(Process(np.array([[a]]), np.array([[1e-3]]), np.eye(1)))[0, 0]) == pytest.approx(
        sigma
    )
    expected = math.floor(math.log(0.01 * 2.0**53 * math.sqrt(1e-3 / sigma)) / -math.log(a))
    assert abs(code.longest - expected) <= 1 + 1e-6 * expected


def test_the_age_of_a_reference_is_the_last_slot_within_the_limit() -> None:
    """Of several states, against powers of L one after the other; a process that is not stable has no such age."""
    for process in (STABLE, Process(np.array([[0.95, 0.2], [0.0, 0.6]]), np.diag([1.0, 1e-3]), np.eye(2))):
        code, sigma = ReferenceCode(process), stationary_covariance(process)
        limit = (0.01 * 2.0**53) ** 2 * process.Q.diagonal().min()
        traces = [
            np.trace(np.linalg.matrix_power(code.L, m) @ sigma @ np.linalg.matrix_power(code.L, m).T)
            for m in range(400)
        ]
        assert code.longest == sum(trace <= limit for trace in traces) - 1
    assert ReferenceCode(UNSTABLE).longest > 10**15


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
    z = x[k] - np.linalg.matrix_power(UNSTABLE.A, k - learns_at) @ x[learns_at]
    belief = spy.step(k, belief, Reception(~nothing, z, np.full((1, 2), learns_at)))
    assert np.allclose(belief.x_hat, x[k], rtol=1e-12)
    assert not belief.P.any()
