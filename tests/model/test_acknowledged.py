"""State-secrecy codes: what acknowledged references keep from an eavesdropper, and what becomes of them under attack."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np
import pytest

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.process import Process
from evedrop.model.receiver import Action, Reception
from evedrop.model.reference import ReferenceReceiver
from evedrop.model.reference_code import ReferenceCode
from evedrop.model.reference_floor import reference_floor
from evedrop.model.schemes.acknowledged import Acknowledged
from evedrop.model.schemes.open_loop import OpenLoop
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.theory.closed_forms import reference_covariances
from evedrop.model.theory.covariances import expected_covariances
from evedrop.streams import Batch
from tests.builders import DRIFTING, UNSTABLE
from tests.model.rationals import (
    combined,
    congruent,
    exact,
    identity,
    inverted,
    state_covariances,
    times,
    transposed,
)
from tests.model.slot_loop import STABLE, Played, play

MIXED = Process(
    np.array([[1.2, 0.1], [0.0, 0.5]]), np.array([[0.6, 0.2], [0.2, 0.5]]), np.array([[4.0, 0.0], [0.0, 0.3]])
)
"""One unstable mode and a stable one."""
SINGULAR = Process(np.array([[1.1, 0.0], [0.0, 0.0]]), 0.1 * np.eye(2), np.eye(2))
CODES = pytest.mark.parametrize("scheme", [Acknowledged, OpenLoop])


def played_over(
    process: Process,
    gamma: np.ndarray,
    gamma_e: np.ndarray,
    acks: np.ndarray,
    scheme: type[Scheme] = Acknowledged,
) -> Played:
    """The scheme with one eavesdropper of references, over given events, all (slots, R)."""
    slots, trials = gamma.shape
    batch = Batch(slots, trials)
    eve = STRATEGIES["reference"](Knowledge(process, 1.0, {}, {}), batch)
    links = {"legitimate": gamma, "eve": gamma_e}
    return play(scheme(process), batch, links, {"eve": eve}, lambda k, *_: acks[k])


def all_events(slots: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every course that γ, γᵉ and the acknowledgement link may take, one a trial: three of (slots, 8^slots)."""
    courses = np.array(list(itertools.product(range(8), repeat=slots))).T
    return courses % 2 == 1, courses // 2 % 2 == 1, courses // 4 == 1


def carried(process: Process, t: int, k: int, scheme: type[Scheme] = Acknowledged) -> np.ndarray:
    """The matrix by which the reference of slot t is carried to slot k, from its definition in exact rationals."""
    A, Q = exact(process.A), exact(process.Q)
    power = identity(process.n)
    for _ in range(k - t):
        power = times(A, power)
    if scheme is Acknowledged and process is not SINGULAR:
        sigmas = list(itertools.islice(state_covariances(A, Q, exact(process.initial_covariance), 200), k + 1))
        power = times(sigmas[k], transposed(inverted(power)), inverted(sigmas[t]))
    return np.array([[float(value) for value in row] for row in power])


@CODES
@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING, STABLE, MIXED, SINGULAR])
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
@pytest.mark.parametrize("process", [UNSTABLE, STABLE, MIXED, SINGULAR])
def test_the_eavesdropper_of_references_is_optimal(process: Process, scheme: type[Scheme]) -> None:
    """Its estimate and covariance are those of the state given all that it heard, in courses of five slots, for either code."""
    gamma, gamma_e, link = all_events(5)
    played = played_over(process, gamma, gamma_e, gamma & link, scheme)
    belief = played.beliefs["eve"][-1]
    for r in np.random.default_rng(0).choice(gamma.shape[1], 200, replace=False):
        mean, covariance = conditioned(process, played, r, gamma_e, scheme)
        assert np.allclose(belief.x_hat[:, r], mean, rtol=0, atol=1e-8)
        assert np.allclose(belief.P[:, :, r], covariance, rtol=0, atol=1e-8)


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
    played = played_over(process, gamma, gamma_e, acks, OpenLoop)
    weights = np.where(gamma, mu, 1 - mu) * np.where(gamma_e, mu_e, 1 - mu_e) * np.where(link, arrives, 1 - arrives)
    chances = weights.prod(0)
    assert np.isclose(chances.sum(), 1.0)
    for name, heard, quality in (("legitimate", gamma, mu), ("eve", gamma_e, mu_e)):
        joint = [float(chances[acks[0] & (heard[0] == flag)].sum()) for flag in (True, False)]
        expected = reference_covariances(process, quality, (joint[0], joint[1]), 4)
        for k, belief in enumerate(played.beliefs[name]):
            assert np.allclose(belief.P @ chances, expected[k], rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("process", [UNSTABLE, STABLE, MIXED])
@pytest.mark.parametrize("back", [0.0, 0.8])
def test_the_floor_is_below_the_exact_expectation(process: Process, back: float) -> None:
    """Over every course of five slots: a bound in each slot, exact without critical slots, and close to what it bounds."""
    slots = 5
    gamma, gamma_e, link = all_events(slots)
    mu, mu_e = 0.7, 0.9
    played = played_over(process, gamma, gamma_e, gamma & link)
    weights = np.where(gamma, mu, 1 - mu) * np.where(gamma_e, mu_e, 1 - mu_e) * np.where(link, back, 1 - back)
    chances = weights.prod(0)
    acknowledged = (mu * back * mu_e, mu * back * (1.0 - mu_e))
    floor = reference_floor(process, mu_e, acknowledged, slots)
    exact_traces = np.array([np.trace(belief.P @ chances) for belief in played.beliefs["eve"]])
    assert (floor <= exact_traces * (1 + 1e-9)).all()
    assert (floor >= (0.9 if back else 1 - 1e-9) * exact_traces).all()


def test_the_floor_follows_many_slots() -> None:
    """Of hundreds of critical slots some stand for others: the bound falls by little, and reaches the error of not listening."""
    found = reference_floor(STABLE, 0.9, (0.81, 0.09), 400)
    sigma = list(itertools.islice(exact_sigmas(STABLE), 400))[-1]
    assert found[-1] == pytest.approx(np.trace(sigma), rel=1e-6)
    assert found[-1] <= np.trace(sigma) * (1 + 1e-12)
    seldom = reference_floor(STABLE, 0.9, (0.9, 1e-3), 400)
    assert 0.2 * np.trace(sigma) < seldom[-1] < (1.0 - 0.999**400) * np.trace(sigma) + 0.1 * np.trace(sigma)
    assert np.isinf(reference_floor(MIXED, 0.9, (0.81, 0.09), 3000)[-1])


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
    belief = played_over(UNSTABLE, gamma, gamma, forged, OpenLoop).beliefs["legitimate"]
    for k in range(5, 12):
        power = np.linalg.matrix_power(UNSTABLE.A, k - 4)
        assert np.allclose(belief[k].P[:, :, 0], power @ UNSTABLE.Q @ power.T, rtol=1e-9)
        assert belief[k].action[0] == Action.INNOVATION


@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING, STABLE, MIXED])
def test_packets_are_independent_of_the_state(process: Process) -> None:
    """Cov(x_k − L_{t,k} x_t, x_k) is 0 exactly, in fractions, and the code has these L_{t,k} to 12 digits."""
    A, Q = exact(process.A), exact(process.Q)
    sigmas = [exact(process.initial_covariance)]
    code = ReferenceCode(process)
    for _ in range(12):
        sigmas.append(combined((1, congruent(A, sigmas[-1])), (1, Q)))
    for t in (0, 1, 5):
        L, crossed, found = identity(process.n), sigmas[t], np.eye(process.n)
        for k in range(t + 1, 13):
            # One slot's L is A + Q A⁻ᵀ Σ⁻¹; the covariance of x_k and x_t is A^{k−t} Σ_t.
            step = combined((1, A), (1, times(Q, transposed(inverted(A)), inverted(sigmas[k - 1]))))
            L, crossed, found = times(step, L), times(A, crossed), code.at(k) @ found
            assert combined((1, sigmas[k]), (-1, times(L, transposed(crossed)))) == combined((0, Q))
            expected = np.array([[float(value) for value in row] for row in L])
            assert np.allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def errors_after_a_critical_slot(scheme: type[Scheme]) -> dict[int, np.ndarray]:
    """Age → the error variance of each state over that of a receiver that hears nothing, (2,): slots 0 to 10 are missed."""
    slots = 27
    gamma, heard, acks = np.ones((3, slots, 1), bool)
    heard[:11] = False
    acks[11:] = False
    played = played_over(MIXED, gamma, heard, acks, scheme)
    sigma, ratios = MIXED.initial_covariance, dict[int, np.ndarray]()
    for k, belief in enumerate(played.beliefs["eve"]):
        sigma = MIXED.A @ sigma @ MIXED.A.T + MIXED.Q if k else sigma
        ratios[k - 10] = belief.P[:, :, 0].diagonal() / sigma.diagonal()
    return ratios


def test_the_hole_that_an_open_loop_leaves_for_stable_modes() -> None:
    """An eavesdropper that missed the reference and hears all packets since: 0.4 % of the stable state's open loop after four."""
    before, after = errors_after_a_critical_slot(OpenLoop), errors_after_a_critical_slot(Acknowledged)
    for age, (unstable, stable) in {1: (0.998, 0.25), 4: (0.995, 0.0039), 16: (0.993, 0.0)}.items():
        assert before[age] == pytest.approx([unstable, stable], abs=6e-4)
        assert after[age] == pytest.approx([1.0, 1.0], rel=1e-9)


def test_information_decays_at_the_open_loop_rate() -> None:
    """Information J beyond Σ_t⁻¹ is Bᵀ J B on x_k, B = Σ_t A^{mᵀ} Σ_k⁻¹, for a receiver of all packets since slot t."""
    slots, t = 12, 4
    gamma, heard, acks = np.ones((3, slots, 1), bool)
    heard[t] = False
    acks[t + 1 :] = False
    for process in (STABLE, MIXED, UNSTABLE):
        beliefs = played_over(process, gamma, heard, acks).beliefs["eve"]
        sigma = [process.initial_covariance]
        for _ in range(slots):
            sigma.append(process.A @ sigma[-1] @ process.A.T + process.Q)
        J = np.linalg.inv(beliefs[t].P[:, :, 0]) - np.linalg.inv(sigma[t])
        for k in range(t + 1, slots):
            B = sigma[t] @ np.linalg.matrix_power(process.A, k - t).T @ np.linalg.inv(sigma[k])
            expected = np.linalg.inv(np.linalg.inv(sigma[k]) + B.T @ J @ B)
            assert np.allclose(beliefs[k].P[:, :, 0], expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


def test_a_reference_that_is_too_old_is_let_go() -> None:
    """Beyond the age at which L x_t drowns x_k the packet is the state again, and nothing overflows on any side."""
    process = Process(0.2 * np.eye(2) + 0.05, 0.1 * np.eye(2), np.eye(2))
    slots = 1000
    gamma, acks = np.ones((slots, 4), bool), np.zeros((slots, 4), bool)
    acks[3] = True
    gamma[5:900, 1:] = False
    played = played_over(process, gamma, gamma, acks)
    headers = [int(packet.header[0, 0]) for packet in played.packets if packet.header is not None]
    longest = headers.count(3)
    assert 5 < longest < 60
    assert headers == [-1] * 4 + [3] * longest + [-1] * (slots - 4 - longest)
    for k in (0, 4, 3 + longest, slots - 1):
        last = played.beliefs["legitimate"][k]
        heard = gamma[k]
        assert np.allclose(last.x_hat[:, heard], played.x[k][:, heard], atol=1e-2 * np.sqrt(0.1))
        assert not last.P[:, :, heard].any()


@pytest.mark.parametrize("a", [0.3, 0.9, 0.99])
def test_the_age_at_which_a_reference_drowns_the_state(a: float) -> None:
    """Of one state in its stationary law L is 1/a: the last m with 2⁻⁵³ a^−m √Σ ≤ 0.01 √Q, or up to an eighth less."""
    sigma = 1e-3 / (1.0 - a * a)
    code = ReferenceCode(Process(np.array([[a]]), np.array([[1e-3]]), np.array([[sigma]])))
    longest = math.floor(math.log(0.01 * 2.0**53 * math.sqrt(1e-3 / sigma)) / -math.log(a))
    for k in (1, longest - 1, longest, longest + 1, 2 * longest, 3 * longest):
        assert min(k, longest - longest // 8 - 1) <= k - code.oldest(k) <= longest
    assert code.oldest(longest) == 0 < code.oldest(longest + 1)


def test_the_age_of_a_reference_is_within_the_limit() -> None:
    """Of several states: the oldest reference in use is within the limit, and one an eighth older was not."""
    for process in (STABLE, MIXED):
        code = ReferenceCode(process)
        limit = (0.01 * 2.0**53) ** 2 * process.Q.diagonal().min()

        def size(t: int, k: int, process: Process = process, limit: float = limit) -> bool:
            sigma = list(itertools.islice(exact_sigmas(process), t + 1))[t]
            L = carried(process, t, k)
            return bool(np.trace(L @ sigma @ L.T) <= limit)

        for k in (20, 90):
            t = code.oldest(k)
            assert size(t, k)
            assert t == 0 or not size(max(0, t - 1 - (k - t) // 8), k)
    assert ReferenceCode(UNSTABLE).oldest(30) == ReferenceCode(SINGULAR).oldest(10**9) == 0


def exact_sigmas(process: Process) -> Iterator[np.ndarray]:
    """The state's covariances from exact rationals."""
    sigmas = state_covariances(exact(process.A), exact(process.Q), exact(process.initial_covariance))
    return (np.array([[float(v) for v in row] for row in sigma]) for sigma in sigmas)


def test_an_almost_singular_process_is_carried_by_itself() -> None:
    """Where A⁻¹ has no correct digits L is A; where no reference of any age is within the limit every packet is the state."""
    assert not ReferenceCode(Process(np.diag([1.1, 1e-15]), np.eye(2), np.eye(2))).decorrelates
    small = ReferenceCode(Process(np.diag([1.1, 1e-13]), np.diag([1e-4, 1.0]), np.eye(2)))
    assert small.decorrelates
    assert [small.oldest(k) for k in range(4)] == [0, 1, 2, 3]


def test_slots_of_the_code_may_be_read_in_any_order() -> None:
    """The matrices of early slots are computed again, with the same bits."""
    process = Process(np.eye(64) * 0.9 + 0.001, np.eye(64), np.eye(64))
    code = ReferenceCode(process)
    first = code.at(3).copy()
    for k in range(3, 20 * 64, 64):
        _ = code.at(k)
    assert np.array_equal(code.at(3), first)


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


def test_a_receiver_that_begins_later_knows_the_states_law() -> None:
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
