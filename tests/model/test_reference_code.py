"""The matrices that carry a reference: packets that are independent of the state, and how old a reference may be."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from evedrop.model.process import Process
from evedrop.model.reference_code import ReferenceCode
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.acknowledged import Acknowledged, OpenLoop
from evedrop.model.schemes.scheme import Scheme
from tests.builders import DRIFTING, UNSTABLE
from tests.model.acknowledged_runs import MIXED, SINGULAR, carried, exact_sigmas, played_over
from tests.model.rationals import (
    combined,
    congruent,
    exact,
    identity,
    inverted,
    times,
    transposed,
)
from tests.model.slot_loop import STABLE


@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING, STABLE, MIXED])
def test_packets_are_independent_of_the_state(process: Process) -> None:
    """Cov(x_k − L_{t,k} x_t, x_k) is 0 exactly, in fractions, and the code has these L_{t,k} to 12 digits."""
    A, Q = exact(process.A), exact(process.Q)
    sigmas = [exact(process.initial_covariance)]
    code = ReferenceCode(process)
    for _ in range(12):
        sigmas.append(combined((1, congruent(A, sigmas[-1])), (1, Q)))
    for t in (0, 1, 5):
        L, crossed, inverse = identity(process.n), sigmas[t], np.eye(process.n)
        for k in range(t + 1, 13):
            # One slot's L is A + Q A⁻ᵀ Σ⁻¹; the covariance of x_k and x_t is A^{k−t} Σ_t.
            step = combined((1, A), (1, times(Q, transposed(inverted(A)), inverted(sigmas[k - 1]))))
            L, crossed, inverse = times(step, L), times(A, crossed), code.at(k) @ inverse
            assert combined((1, sigmas[k]), (-1, times(L, transposed(crossed)))) == combined((0, Q))
            expected = np.array([[float(value) for value in row] for row in L])
            assert np.allclose(inverse, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


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
    """Of one state in its stationary distribution L is 1/a: the last m with 2⁻⁵³ a^−m √Σ ≤ 0.01 √Q, or up to an eighth less."""
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


def test_an_almost_singular_process_is_carried_by_itself() -> None:
    """Where A⁻¹ has no correct digits L is A; where no reference of any age is within the limit every packet is the state."""
    assert not ReferenceCode(Process(np.diag([1.1, 1e-15]), np.eye(2), np.eye(2))).decorrelates
    small = ReferenceCode(Process(np.diag([1.1, 1e-13]), np.diag([1e-4, 1.0]), np.eye(2)))
    assert small.decorrelates
    assert [small.oldest(k) for k in range(4)] == [0, 1, 2, 3]


@pytest.mark.parametrize("name", ["acknowledged", "random-code", "threshold-code"])
def test_a_singular_process_is_warned_of(name: str) -> None:
    """By every scheme with such a code, and by no other."""
    singular, nonsingular = (Process(np.diag([1.1, last]), np.eye(2), np.eye(2)) for last in (0.0, 0.5))
    parameters = dict(SCHEMES[name].parameters)
    (warning,) = scheme_of(singular, {"scheme": name, **parameters}).warnings()
    assert warning.startswith("process.A is singular to double precision (max |A| · max |A⁻¹| exceeds 9e13)")
    assert scheme_of(nonsingular, {"scheme": name, **parameters}).warnings() == []
    assert scheme_of(singular, {"scheme": "open-loop"}).warnings() == []


def test_slots_of_the_code_may_be_read_in_any_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """The matrices of early slots are computed again, with the same bits."""
    monkeypatch.setattr("evedrop.model.reference_code._NUMBERS_KEPT", 1)  # two blocks, as of many states
    process = Process(np.eye(4) * 0.9 + 0.001, np.eye(4), np.eye(4))
    code = ReferenceCode(process)
    first = code.at(3).copy()
    for k in range(3, 20 * 64, 64):
        _ = code.at(k)
    assert np.array_equal(code.at(3), first)


def test_the_age_of_a_reference_in_an_early_slot_is_computed_again() -> None:
    """Only the ages of the last slots are kept, and those of earlier slots are the same when they are computed again."""
    process = Process(np.array([[0.2]]), np.array([[1.0]]), np.array([[1.0]]))
    ages = [ReferenceCode(process).oldest(k) for k in range(60)]
    assert ages[-1] > 0
    code = ReferenceCode(process, ages_kept=5)
    assert [code.oldest(k) for k in range(60)] == ages
    assert [code.oldest(k) for k in (59, 55, 54, 3, 0, 20)] == [ages[k] for k in (59, 55, 54, 3, 0, 20)]
