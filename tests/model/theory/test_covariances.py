import itertools
import math
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.links.chain import Chain
from evedrop.model.modulated import ModulatedCovariance
from evedrop.model.process import Floats, Process, StateFactors
from evedrop.model.slot.link_distribution import LinkDistribution
from evedrop.model.theory.covariances import (
    NOBODY,
    Outcomes,
    TheoreticalCovariance,
    has_infinite_variance,
    limit,
    limit_trace,
    lyapunov,
    misled_covariances,
    noise_covariances,
    stability_bound,
    state_covariances,
    tail_index,
    theoretical_covariances,
    theoretical_traces,
)
from tests.builders import MICROGRID, UNSTABLE
from tests.examples import examples

probabilities = st.one_of(st.floats(0.0, 1.0), st.sampled_from([0.0, 1.0]))


@st.composite
def covariances(draw: st.DrawFn, n: int) -> Floats:
    """A symmetric positive definite matrix."""
    factor = np.array(draw(st.lists(st.floats(-1.0, 1.0), min_size=n * n, max_size=n * n))).reshape(n, n)
    positive: Floats = factor @ factor.T + draw(st.floats(0.01, 1.0)) * np.eye(n)
    return positive


@st.composite
def processes(draw: st.DrawFn) -> Process:
    """A process of one to three states with spectral radius from 1 to 1.5."""
    n = draw(st.integers(1, 3))
    A = np.array(draw(st.lists(st.floats(-1.0, 1.0), min_size=n * n, max_size=n * n))).reshape(n, n) + 0.1 * np.eye(n)
    radius = float(np.max(np.abs(np.linalg.eigvals(A))))
    if radius < 1e-3:
        A, radius = np.eye(n), 1.0
    return Process(A / radius * draw(st.floats(1.0, 1.5)), draw(covariances(n)), draw(covariances(n)))


def recursion(
    process: Process, slots: int, step: Callable[[Floats, Floats], Floats], first: float
) -> Floats:  # the textbook: one slot after the other, from the events' own conditional covariances
    """E_k by E_k = step(E_{k−1}, Σ_{k−1})."""
    E, sigma = first * process.initial_covariance, process.initial_covariance
    covariances = [E]
    for _ in range(1, slots):
        E, sigma = step(E, sigma), process.A @ sigma @ process.A.T + process.Q
        covariances.append(E)
    return np.array(covariances)


def legitimate_recursion(process: Process, slots: int, mu: float, mu_d: float) -> Floats:
    """Drops and innovations of the estimator with the secret."""
    A, Q = process.A, process.Q
    return recursion(
        process,
        slots,
        lambda E, _: (1 - mu) * (A @ E @ A.T + Q) + mu * (1 - mu_d) * (A @ E @ A.T),
        1 - mu,
    )


def eavesdropper_recursion(process: Process, slots: int, mu_e: float, mu_d: float, b0: float, b1: float) -> Floats:
    """All five events of an eavesdropper."""
    A, Q = process.A, process.Q
    return recursion(
        process,
        slots,
        lambda E, sigma: (
            (1 - mu_e) * (A @ E @ A.T + Q)
            + mu_e * mu_d * (1 - b0) * (A @ E @ A.T + Q)
            + mu_e * (1 - mu_d) * (1 - b1) * (A @ E @ A.T + Q)
            + mu_e * (1 - mu_d) * b1 * 2 * (A @ sigma @ A.T)
        ),
        1 - mu_e + mu_e * (1 - b0),
    )


def close(actual: Floats, expected: Floats) -> bool:
    """Equal to 1e-10 of each slot's largest entry."""
    scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
    return bool(np.all(np.abs(actual - expected) <= 1e-10 * scale + 1e-300))


@given(processes(), probabilities, probabilities, st.integers(1, 80))
@settings(deadline=None, max_examples=examples(60))
def test_legitimate_expectation_is_the_recursion(process: Process, mu: float, mu_d: float, slots: int) -> None:
    """E P_k of the legitimate estimator equals the slot-by-slot recursion over its events."""
    result = theoretical_covariances(process, Outcomes.legitimate(mu, mu_d), slots)
    assert close(result, legitimate_recursion(process, slots, mu, mu_d))


@given(processes(), probabilities, probabilities, probabilities, probabilities, st.integers(1, 80))
@settings(deadline=None, max_examples=examples(60))
def test_eavesdropper_expectation_is_the_recursion(
    process: Process, mu_e: float, mu_d: float, b0: float, b1: float, slots: int
) -> None:
    """E P_k of any strategy of the class equals the slot-by-slot recursion over its five events."""
    result = theoretical_covariances(process, Outcomes.eavesdropper(mu_e, mu_d, b0, b1), slots)
    assert close(result, eavesdropper_recursion(process, slots, mu_e, mu_d, b0, b1))


@pytest.mark.thorough
@given(processes(), probabilities, probabilities, probabilities, probabilities)
@settings(deadline=None, max_examples=examples(40))
def test_outcomes_are_a_distribution(process: Process, mu_e: float, mu_d: float, b0: float, b1: float) -> None:
    """The outcomes of a slot sum to one, for the truth and for the belief."""
    for outcomes in (Outcomes.eavesdropper(mu_e, mu_d, b0, b1), Outcomes.legitimate(mu_e, mu_d)):
        for view in (outcomes, outcomes.reported):
            assert view.predicted + view.state + view.misled + view.decoded == pytest.approx(1.0, abs=1e-12)
            assert min(view.predicted, view.state, view.misled, view.decoded, view.initial) >= -1e-15


def test_long_runs_cross_blocks() -> None:
    """Blocks of slots join without a seam: runs of several blocks equal the recursion."""
    for outcomes, reference in (
        (Outcomes.legitimate(0.9, 0.6), legitimate_recursion(UNSTABLE, 1050, 0.9, 0.6)),
        (Outcomes.eavesdropper(0.9, 0.6, 1, 1), eavesdropper_recursion(UNSTABLE, 1050, 0.9, 0.6, 1, 1)),
    ):
        assert close(theoretical_covariances(UNSTABLE, outcomes, 1050), reference)
    naive = theoretical_covariances(MICROGRID, Outcomes.eavesdropper(0.6, 0.1, 1, 1), 5000)
    assert close(naive, eavesdropper_recursion(MICROGRID, 5000, 0.6, 0.1, 1, 1))


@given(processes(), probabilities, probabilities, st.lists(st.integers(0, 1500), min_size=1, max_size=5))
@settings(deadline=None, max_examples=examples(25))
def test_chunks_are_the_whole(process: Process, mu: float, mu_d: float, chunks: list[int]) -> None:
    """Asked for in chunks of any size, the expectation is the same to the last bit."""
    outcomes = Outcomes.eavesdropper(mu, mu_d, 0.9, 0.2)
    whole = theoretical_traces(process, outcomes, sum(chunks))
    source = TheoreticalCovariance(process, outcomes)
    parts = np.concatenate([source.next_traces(chunk) for chunk in chunks])
    assert np.array_equal(whole, parts)


def enumerated(process: Process, k: int, events: dict[str, float], first: float) -> Floats:
    """E P_k over every word of events: L lost, S state used, D decoded, M misled."""
    A, Q = process.A, process.Q
    sigmas = [process.initial_covariance]
    for _ in range(k):
        sigmas.append(A @ sigmas[-1] @ A.T + Q)
    total = np.zeros_like(Q)
    for start, weight in ((process.initial_covariance, first), (np.zeros_like(Q), 1.0 - first)):
        for word in itertools.product(events, repeat=k):
            P, probability = start, weight
            for slot, event in enumerate(word, 1):
                carried = A @ P @ A.T
                f = 2 * (A @ sigmas[slot - 1] @ A.T)
                P = {"L": carried + Q, "S": np.zeros_like(Q), "D": carried, "M": f}[event]
                probability *= events[event]
            total = total + probability * P
    return total


@pytest.mark.parametrize("k", [1, 2, 5])
def test_expectation_is_the_mean_over_all_words(k: int) -> None:
    """E P_k is the probability-weighted mean over every sequence of events."""
    mu, mu_d, b0, b1 = 0.7, 0.6, 0.8, 0.3
    ours = {"L": 1 - mu, "S": mu * mu_d, "D": mu * (1 - mu_d)}
    theoretical_covariance = theoretical_covariances(UNSTABLE, Outcomes.legitimate(mu, mu_d), k + 1)[k]
    assert theoretical_covariance == pytest.approx(enumerated(UNSTABLE, k, ours, 1 - mu), rel=1e-12)
    theirs = {"S": mu * mu_d * b0, "M": mu * (1 - mu_d) * b1}
    theirs["L"] = 1 - sum(theirs.values())
    theoretical_covariance = theoretical_covariances(UNSTABLE, Outcomes.eavesdropper(mu, mu_d, b0, b1), k + 1)[k]
    assert theoretical_covariance == pytest.approx(enumerated(UNSTABLE, k, theirs, 1 - mu * b0), rel=1e-12)


def test_belief_ignores_being_misled() -> None:
    """The belief's expectation is the recursion B_k = p_d (A B Aᵀ + Q), which the naive one takes for its error."""
    A, Q = UNSTABLE.A, UNSTABLE.Q
    for b0, b1 in ((1.0, 1.0), (0.8, 0.3)):
        outcomes = Outcomes.eavesdropper(0.9, 0.6, b0, b1)
        p_d = 1 - 0.9 * 0.6 * b0 - 0.9 * 0.4 * b1

        def step(B: Floats, _: Floats, p_d: float = p_d) -> Floats:
            return p_d * (A @ B @ A.T + Q)

        reference = recursion(UNSTABLE, 60, step, 1 - 0.9 * b0)
        assert close(theoretical_covariances(UNSTABLE, outcomes.reported, 60), reference)
    smart = Outcomes.eavesdropper(0.9, 0.6, 1.0, 0.0)
    assert smart.reported == smart


def test_noise_has_the_covariance_of_the_carried_state() -> None:
    """E[χ_k χ_kᵀ] + Q = Σ_k for k ≥ 1, so that either type of packet has the state's covariance."""
    sigma = state_covariances(UNSTABLE, 30)
    noise = noise_covariances(UNSTABLE, 30)
    assert np.allclose(noise[1:] + UNSTABLE.Q, sigma[1:], rtol=1e-12)
    assert np.array_equal(noise[0], np.zeros((2, 2)))
    assert np.array_equal(misled_covariances(UNSTABLE, 30), 2.0 * noise)
    assert noise_covariances(UNSTABLE, 0).shape == (0, 2, 2)


@pytest.mark.parametrize("scale", [1.0, 1e60, 1e200])
@pytest.mark.thorough
def test_overflow_is_infinite_and_silent(scale: float) -> None:
    """Beyond double precision every expectation is inf, from then on, never nan and without a warning."""
    process = Process(scale * np.array([[1.0, -0.9], [0.3, -1.2]]), np.eye(2), np.eye(2))
    for outcomes in (Outcomes.legitimate(0.5, 0.1), Outcomes.eavesdropper(0.9, 0.1, 1, 1), Outcomes.plain(0.0)):
        traces = theoretical_traces(process, outcomes, 40_000)
        assert not np.any(np.isnan(traces))
        assert math.isinf(traces[-1])
        first = int(np.argmax(np.isinf(traces)))
        assert np.all(np.isinf(traces[first:]))
        assert np.all(np.isfinite(traces[:first]))
    assert np.isinf(misled_covariances(process, 6000)[-1]).all()


def test_bounded_expectation_of_unstable_process_stays_at_its_limit() -> None:
    """After 86 400 slots, when A^k has long overflowed, the expectation still is its limit."""
    outcomes = Outcomes.legitimate(0.9, 0.6)
    assert theoretical_traces(UNSTABLE, outcomes, 86_400)[-1] == pytest.approx(
        limit_trace(UNSTABLE, outcomes), rel=1e-12
    )


@given(processes(), st.floats(0.05, 1.0), st.floats(0.05, 1.0), st.sampled_from([(1.0, 0.0), (0.7, 0.0)]))
@settings(deadline=None, max_examples=examples(60))
def test_limits_are_where_long_runs_end(process: Process, mu: float, mu_d: float, use: tuple[float, float]) -> None:
    """Where (kept ρ²) < 0.98 the run ends at the limit; where it exceeds 1, limit and bound say unbounded."""
    for outcomes, quality in (
        (Outcomes.legitimate(mu, mu_d), mu),
        (Outcomes.eavesdropper(mu, mu_d, *use), mu * use[0]),
    ):
        rate = outcomes.propagated * process.spectral_radius**2
        if rate < 0.98:
            assert mu_d > stability_bound(process, quality)
            assert close(theoretical_covariances(process, outcomes, 3000)[-1:], limit(process, outcomes)[None])
        elif rate > 1.0 + 1e-9 and outcomes.predicted > 0.0:
            assert mu_d < stability_bound(process, quality)
            assert math.isinf(limit_trace(process, outcomes))


@given(processes(), st.floats(0.0, 1.0), st.floats(0.0, 0.999))
@settings(deadline=None, max_examples=examples(40))
def test_a_misled_receiver_is_unbounded(process: Process, mu_d: float, loss: float) -> None:
    """Corollaries V.3 and V.4: with any chance of using an innovation the error diverges."""
    outcomes = Outcomes.eavesdropper(1.0 - loss, min(mu_d, 0.999), 1.0, 0.5)
    assert math.isinf(limit_trace(process, outcomes))


@given(processes(), st.floats(0.05, 0.95), st.floats(0.1, 0.95), st.floats(0.01, 0.5))
@settings(deadline=None, max_examples=examples(40))
def test_traces_fall_as_the_state_is_sent_more_often(process: Process, mu: float, mu_d: float, more: float) -> None:
    """Lemma VI.1: J and J_e fall as μ_d rises."""
    higher = min(1.0, mu_d + more)
    for kind in (Outcomes.legitimate, lambda mu, mu_d: Outcomes.eavesdropper(mu, mu_d, 1.0, 0.0)):
        lower_trace, higher_trace = limit_trace(process, kind(mu, mu_d)), limit_trace(process, kind(mu, higher))
        assert higher_trace < lower_trace or math.isinf(lower_trace)


def test_near_the_bound_no_number_comes_from_a_failed_solve() -> None:
    """Just above the bound the limit is large and finite, at it and below it infinite."""
    bound = stability_bound(UNSTABLE, 0.9)
    above = [limit_trace(UNSTABLE, Outcomes.legitimate(0.9, bound + 10.0**-e)) for e in (3, 6, 9)]
    assert above == sorted(above)
    assert all(math.isfinite(trace) and trace > 0.0 for trace in above)
    assert above[2] / above[1] == pytest.approx(1000.0, rel=1e-3)
    for mu_d in (bound - 1e-12, bound - 1e-3, 0.0):
        assert math.isinf(limit_trace(UNSTABLE, Outcomes.legitimate(0.9, mu_d)))
    assert np.isinf(lyapunov(UNSTABLE, 1.0)).all()


def test_stability_bounds_of_special_links() -> None:
    """0 for a marginally stable process, beyond 1 or inf where no μ_d will do, 0 for a stable one."""
    assert stability_bound(MICROGRID, 0.6) == 0.0
    assert stability_bound(UNSTABLE, 0.9) == pytest.approx(0.534206, abs=5e-7)
    assert stability_bound(UNSTABLE, 0.4) > 1.0
    assert math.isinf(stability_bound(UNSTABLE, 0.0))
    assert math.isinf(stability_bound(MICROGRID, 0.0))
    stable = Process(0.5 * np.eye(2), np.eye(2), np.eye(2))
    assert stability_bound(stable, 0.0) == stability_bound(stable, 0.3) == 0.0
    assert math.isfinite(limit_trace(stable, Outcomes.eavesdropper(0.9, 0.5, 1, 1)))


def test_lossless_link_has_no_error() -> None:
    """With μ = 1 the legitimate error is 0 in every slot and in the limit, whatever μ_d."""
    for mu_d in (0.0, 0.1, 1.0):
        assert np.array_equal(theoretical_traces(UNSTABLE, Outcomes.legitimate(1.0, mu_d), 50), np.zeros(50))
        assert limit_trace(UNSTABLE, Outcomes.legitimate(1.0, mu_d)) == 0.0


def test_microgrid_closed_form() -> None:
    """For A = I the limits are (1−μ) tr Q/(μμ_d) and (1−μ_eμ_d) tr Q/(μ_eμ_d), and the naive ratio is 2(1−μ_d)."""
    for mu_d in (0.1, 0.5, 0.9):
        ours = limit_trace(MICROGRID, Outcomes.legitimate(0.6, mu_d))
        theirs = limit_trace(MICROGRID, Outcomes.eavesdropper(0.6, mu_d, 1, 0))
        assert ours == pytest.approx(0.4 * 2e-5 / (0.6 * mu_d), rel=1e-12)
        assert theirs == pytest.approx((1 - 0.6 * mu_d) * 2e-5 / (0.6 * mu_d), rel=1e-12)
        naive = theoretical_traces(MICROGRID, Outcomes.eavesdropper(0.6, mu_d, 1, 1), 86_400)[-1]
        sigma = np.trace(MICROGRID.initial_covariance + 86_399 * MICROGRID.Q)
        assert naive / sigma == pytest.approx(2 * (1 - mu_d), rel=1e-4)


def test_variance_is_infinite_below_the_square_of_the_bound() -> None:
    """The example's tr P has no variance for μ_d < 0.8116, where (1−μμ_d) ρ⁴ = 1; the microgrid's always has one."""
    assert has_infinite_variance(UNSTABLE, Outcomes.legitimate(0.9, 0.8115))
    assert not has_infinite_variance(UNSTABLE, Outcomes.legitimate(0.9, 0.8117))
    smart = Outcomes.eavesdropper(0.5, 0.9, 1, 0)
    assert tail_index(UNSTABLE, smart) == pytest.approx(-math.log(0.55) / (2 * math.log(UNSTABLE.spectral_radius)))
    for outcomes in (
        Outcomes.legitimate(1.0, 0.6), Outcomes.plain(1.0), Outcomes.eavesdropper(0.9, 0.6, 1, 1),
    ):  # fmt: skip
        assert math.isinf(tail_index(UNSTABLE, outcomes))
    assert math.isinf(tail_index(MICROGRID, Outcomes.legitimate(0.1, 0.1)))


@pytest.mark.parametrize("mu_d", [0.7, 0.81, 0.82, 0.9])
def test_second_moment_diverges_where_variance_is_said_infinite(mu_d: float) -> None:
    """For a scalar process the exact recursion of E P_k² grows without bound exactly where α ≤ 2."""
    a, q, mu = 1.3877986573692194, 1e-3, 0.9
    scalar = Process(np.array([[a]]), np.array([[q]]), np.array([[q]]))
    first, second = (1 - mu) * q, (1 - mu) * q**2
    history = []
    for _ in range(1500):
        lost = a**4 * second + 2 * a**2 * q * first + q**2
        second = (1 - mu) * lost + mu * (1 - mu_d) * a**4 * second
        first = (1 - mu) * (a**2 * first + q) + mu * (1 - mu_d) * a**2 * first
        history.append(second)
    diverges = history[-1] > 1.001 * history[-400]
    assert diverges == has_infinite_variance(scalar, Outcomes.legitimate(mu, mu_d))


@pytest.mark.parametrize(("b0", "b1"), [(1.0, 1.0), (0.8, 0.3)])
def test_misled_error_grows_in_proportion_to_the_state(b0: float, b1: float) -> None:
    """The ratio tr E P_k / tr Σ_k tends to 2 p_i / (p_i + p_r), for naive 2 (1 − μ_d)."""
    outcomes = Outcomes.eavesdropper(0.9, 0.6, b0, b1)
    ratio = theoretical_traces(UNSTABLE, outcomes, 300)[-1] / np.trace(state_covariances(UNSTABLE, 300)[-1])
    assert ratio == pytest.approx(2 * 0.4 * b1 / (0.4 * b1 + 0.6 * b0), rel=1e-9)


def test_misled_error_stays_within_a_factor_of_its_expectation() -> None:
    """Why a misled receiver has no heavy tail: no sequence of events gives more than a fixed multiple of E tr P_k."""
    outcomes = Outcomes.eavesdropper(0.9, 0.6, 1, 1)
    expected = theoretical_traces(UNSTABLE, outcomes, 200)
    sigma = np.trace(state_covariances(UNSTABLE, 200), axis1=1, axis2=2)
    ratio = 2.0 * sigma[5:] / expected[5:]
    assert ratio.max() < 1.01 * ratio[:20].max()


@pytest.mark.parametrize(
    "A",
    [
        [[3.0, -3.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        [[2.5, -1.5, -1.0], [1.5, -0.5, -1.0], [1.0, -1.0, 1.0]],
        [[2.0, -1.0], [1.0, 0.0]],
    ],
)
def test_a_multiple_root_on_the_unit_circle_in_a_long_run(A: list[list[float]]) -> None:
    """Whatever the coordinates, to 1e-4 after 14,000 slots: against Σ_k from its factors, where nothing can cancel."""
    process, slots = Process(np.array(A), np.eye(len(A)), np.eye(len(A))), 14_000
    carried = StateFactors(process).block(range(slots))
    expected = (carried**2).sum(axis=(1, 2)) + len(A)
    assert np.allclose(theoretical_traces(process, NOBODY, slots), expected, rtol=1e-4)
    covariances = theoretical_covariances(process, NOBODY, 3000)
    factors = np.concatenate([carried, np.broadcast_to(process.noise_factor, carried.shape)], axis=2)[1:3000]
    assert np.allclose(covariances[1:], factors @ factors.transpose(0, 2, 1), rtol=1e-5)
    chain = Chain(np.ones((1, 1)), np.ones(1), np.zeros(1))
    silent = ModulatedCovariance(process, LinkDistribution.steady(chain), Outcomes.plain)
    assert np.allclose(silent.next_traces(slots), expected, rtol=1e-4)
    misled, twice = Outcomes.eavesdropper(0.9, 0.5, 1.0, 1.0), misled_covariances(process, 4000)[-1]
    assert theoretical_traces(process, misled, 4000)[-1] == pytest.approx(0.5 * np.trace(twice), rel=1e-2)


@pytest.mark.parametrize(
    "coefficients",
    [[-3, 3, -1], [-4, 6, -4, 1], [-3, 4, -4, 3, -1]],
    ids=["triple", "quadruple", "triple, and a complex pair"],
)
def test_a_root_of_higher_order_on_the_unit_circle_in_a_very_long_run(coefficients: list[int]) -> None:
    """Of a companion matrix, in whole numbers: tr Σ_k is a sum of squares of the entries of A^j."""
    order = len(coefficients)
    A = np.eye(order, k=-1)
    A[0] = [-coefficient for coefficient in coefficients]
    process, slots = Process(A, np.eye(order), np.eye(order)), 60_000
    traces = theoretical_traces(process, NOBODY, slots)
    power, total = np.eye(order, dtype=object).astype(int).astype(object), 0
    dynamics = A.astype(int).astype(object)
    for k in range(slots):
        total += (power * power).sum()
        if k in {29_999, slots - 1}:
            assert traces[k] == pytest.approx(float(total), rel=1e-8)
        power = dynamics @ power


def test_importing_theory_and_design_does_not_import_scipy() -> None:
    """Both are on start-up paths: scipy waits until a function needs it."""
    code = "import sys, evedrop.model.theory.design, evedrop.model.theory.covariances; sys.exit('scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_who_never_uses_a_state_has_no_heavy_tail() -> None:
    """p_r = 0: deaf, or never told a state, it grows alike in every trial; the largest trace is a few times the mean."""
    for outcomes in (NOBODY, Outcomes.eavesdropper(0.0, 0.6, 1.0, 0.0), Outcomes.eavesdropper(0.9, 0.6, 0.0, 0.0),
                     Outcomes.legitimate(0.6, 0.0)):  # fmt: skip
        assert math.isinf(tail_index(UNSTABLE, outcomes))
        assert not has_infinite_variance(UNSTABLE, outcomes)
        assert theoretical_traces(UNSTABLE, NOBODY, 200)[-1] < 10.0 * theoretical_traces(UNSTABLE, outcomes, 200)[-1]


@pytest.mark.parametrize("angle", [0.1, 0.7, 2.0])
def test_a_limit_that_rounding_destroys_is_infinite(angle: float) -> None:
    """Of a double eigenvalue 1 in a rotated basis, ever nearer to the bound: a covariance, or no limit at all."""
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    process = Process(turn @ np.array([[1.0, 0.1], [0.0, 1.0]]) @ turn.T, np.eye(2), np.eye(2))
    for kept in (1.0 - 10.0 ** -(e / 2) for e in range(4, 26)):
        S = lyapunov(process, kept)
        if np.isinf(S).any():
            assert kept > 1.0 - 1e-3
            assert np.isposinf(S).all()
        else:
            assert np.linalg.eigvalsh(0.5 * (S + S.T))[0] >= -1e-9 * np.abs(S).max()


@pytest.mark.parametrize("n", [1, 9, 10, 12])
def test_the_limit_of_few_states_and_of_many_solves_its_equation(n: int) -> None:
    """S = kept · A S Aᵀ + Q, however many equations that is: to 1e-12 of its largest entry."""
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n))
    process = Process(1.1 * A / np.abs(np.linalg.eigvals(A)).max(), np.eye(n), np.eye(n))
    S = lyapunov(process, 0.7)
    assert np.allclose(S, 0.7 * process.A @ S @ process.A.T + process.Q, rtol=0, atol=1e-12 * np.abs(S).max())
    assert np.isinf(lyapunov(process, 0.9)).all()
