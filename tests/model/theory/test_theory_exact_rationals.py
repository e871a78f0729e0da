"""Every closed form against exact rational arithmetic, for noise of any condition that a process may have.

The entries of A, Q and Σ0 are doubles, which are fractions, so the comparison has no error but that of the closed form.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from evedrop.model.links.chain import Chain
from evedrop.model.modulated import ModulatedCovariance
from evedrop.model.modulated import limit_trace as limit_behind
from evedrop.model.process import Process, mistakes_of
from evedrop.model.slot.link_distribution import LinkDistribution
from evedrop.model.theory.closed_forms import (
    encrypted_schedule,
    reference_covariances,
    scheduled,
    step_probabilities,
    synchronised_probability,
    twin_track_bound,
    word_probability,
)
from evedrop.model.theory.covariances import (
    Outcomes,
    limit_trace,
    misled_covariances,
    noise_covariances,
    radius,
    theoretical_traces,
)
from evedrop.model.theory.leak import RemainingCovariances, remaining_limit
from tests.examples import examples
from tests.model import rationals
from tests.model.rationals import Matrix, exact, trace

CLOSE = Fraction(1, 10**10)
SLOTS = 25
PERIODS = 6  # slots: a multiple of the period of every schedule whose packets all arrive
LARGEST_CONDITION = 14


class Model(NamedTuple):
    """A process, in doubles and in fractions."""

    process: Process
    A: Matrix
    Q: Matrix
    initial: Matrix


@st.composite
def models(draw: st.DrawFn, most_states: int = 3, lowest: float = 0.3, highest: float = 1.4) -> Model:
    """Processes whose Q has a condition number from 1 to 1e14, along the axes or rotated."""
    n, rho = draw(st.integers(1, most_states)), draw(st.floats(lowest, highest))
    condition = draw(st.floats(0.0, LARGEST_CONDITION))
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    A = random.standard_normal((n, n))
    A *= rho / np.abs(np.linalg.eigvals(A)).max()
    Q = np.diag(random.permutation(10.0 ** np.linspace(0.0, -condition, n)))
    if draw(st.booleans()):
        turned, _ = np.linalg.qr(random.standard_normal((n, n)))
        Q = turned @ Q @ turned.T
        Q = 0.5 * (Q + Q.T)
    start = random.standard_normal((n, n))
    start = start @ start.T + 0.1 * np.eye(n)
    initial = 10.0 ** draw(st.floats(-3.0, 3.0)) * 0.5 * (start + start.T)
    assume(not mistakes_of(A, Q, initial))
    return Model(Process(A, Q, initial), exact(A), exact(Q), exact(initial))


def odds_of(outcomes: Outcomes) -> Callable[[str], Fraction]:
    """The probabilities of outcomes, which are doubles, as fractions."""
    return lambda name: Fraction(float(getattr(outcomes, name)))


def close(value: float, expected: Fraction, by: Fraction = CLOSE) -> bool:
    """Whether a number is the fraction, to ten digits."""
    return abs(Fraction(float(value)) - expected) <= by * abs(expected)


probabilities = st.floats(0.0, 1.0)
receivers = st.one_of(
    st.builds(Outcomes.legitimate, probabilities, probabilities),
    st.builds(Outcomes.eavesdropper, probabilities, probabilities, probabilities, probabilities),
    st.builds(Outcomes.genie, probabilities, probabilities),
    st.builds(Outcomes.plain, probabilities),
)


def test_the_process_that_a_recursion_of_inverses_got_wrong() -> None:
    """It lost all digits here: the genie was said to be better than the legitimate estimator behind an equal link."""
    process = Process(np.array([[1.0, 0.1], [0.0, 1.0]]), np.diag([1e-12, 1.0]), np.eye(2))
    outcomes = Outcomes.genie(0.9, 0.9)
    A, Q, initial = exact(process.A), exact(process.Q), exact(process.initial_covariance)
    expected = [trace(E) for E in rationals.expectations(A, Q, initial, odds_of(outcomes), 60)]
    result = theoretical_traces(process, outcomes, 60)
    assert all(close(actual, value) for actual, value in zip(result, expected, strict=True))
    assert np.all(theoretical_traces(process, Outcomes.legitimate(0.9, 0.9), 60)[1:] < result[1:])


@pytest.mark.thorough
@settings(deadline=None, max_examples=examples(40))
@given(models(), receivers)
def test_expectations(model: Model, outcomes: Outcomes) -> None:
    """The covariances of each receiver's error and belief, in each slot."""
    for frequencies in (outcomes, outcomes.reported):
        expected = rationals.expectations(model.A, model.Q, model.initial, odds_of(frequencies), SLOTS)
        result = theoretical_traces(model.process, frequencies, SLOTS)
        assert all(close(value, trace(E)) for value, E in zip(result, expected, strict=True))


@settings(deadline=None, max_examples=examples(20))
@given(models())
def test_covariances_of_packets(model: Model) -> None:
    """The encoding noise, and the error of a receiver that takes an innovation for a state: each entry, relative to the trace."""
    sigmas = rationals.state_covariances(model.A, model.Q, model.initial)
    noise, misled = noise_covariances(model.process, 10), misled_covariances(model.process, 10)
    assert not noise[0].any()
    for k in range(1, 10):
        carried = rationals.congruent(model.A, next(sigmas))
        scale = CLOSE * trace(carried)
        for i, row in enumerate(carried):
            for j, value in enumerate(row):
                assert abs(Fraction(float(noise[k, i, j])) - value) <= scale
                assert abs(Fraction(float(misled[k, i, j])) - 2 * value) <= 2 * scale


@settings(deadline=None, max_examples=examples(40))
@given(models())
def test_what_a_leak_leaves(model: Model) -> None:
    """M_k in each slot; the trace is what theory uses of it."""
    remaining = RemainingCovariances(model.process)
    sigmas = rationals.state_covariances(model.A, model.Q, model.initial)
    next(sigmas)
    for _ in range(1, SLOTS):
        expected = rationals.remaining(model.Q, next(sigmas))
        assert close(float(np.trace(remaining.next(1)[0])), trace(expected), Fraction(1, 10**8))


def test_what_a_leak_leaves_beyond_the_largest_double() -> None:
    """The state's variance grows by twenty decades in a slot, and a slow stable direction goes on leaking."""
    A, Q = np.array([[1e10, 0.3], [0.0, 0.999]]), np.array([[1.0, 0.5], [0.5, 1.0]])
    process = Process(A, Q, np.eye(2))
    remaining = RemainingCovariances(process)
    sigmas = rationals.state_covariances(exact(A), exact(Q), exact(np.eye(2)), bits=4000)
    next(sigmas)
    for _ in range(40):
        M, expected = remaining.next(1)[0], rationals.remaining(exact(Q), next(sigmas))
        for i, row in enumerate(expected):
            assert all(close(actual, value) for actual, value in zip(M[i], row, strict=True))
    for _ in range(20_000):
        M = remaining.next(1)[0]
    assert np.allclose(M, remaining_limit(process), rtol=1e-12, atol=0.0)


@settings(deadline=None, max_examples=examples(30))
@given(models(highest=0.97))
def test_the_limit_of_what_a_leak_leaves(model: Model) -> None:
    """Q − QΣ⁻¹Q with the stationary Σ, which is rational."""
    stationary = rationals.fixed_point(model.A, Fraction(1), model.Q)
    expected = trace(rationals.remaining(model.Q, stationary))
    assert close(float(np.trace(remaining_limit(model.process))), expected, Fraction(1, 10**8))


@settings(deadline=None, max_examples=examples(40))
@given(models(highest=1.3), receivers)
def test_limits(model: Model, outcomes: Outcomes) -> None:
    """S = p A S Aᵀ + source; near the bound of stability rounding of A itself is amplified as S is."""
    rho = radius(model.process)
    assume(outcomes.propagated * rho**2 < 0.99)
    assume(outcomes.predicted + outcomes.leaked + outcomes.misled > 0.0)
    assume(rho < 0.97 or not (outcomes.misled or outcomes.leaked))
    odds = odds_of(outcomes)
    terms = [(odds("predicted"), model.Q)]
    if outcomes.leaked or outcomes.misled:
        stationary = rationals.fixed_point(model.A, Fraction(1), model.Q)
        terms.append((odds("leaked"), rationals.remaining(model.Q, stationary)))
        terms.append((2 * odds("misled"), rationals.congruent(model.A, stationary)))
    source = rationals.combined(*terms)
    kept = odds("predicted") + odds("decoded") + odds("leaked")
    expected = trace(rationals.fixed_point(model.A, kept, source))
    amplified = 1 + expected / trace(source)
    assert close(limit_trace(model.process, outcomes), expected, CLOSE * amplified)


@settings(deadline=None, max_examples=examples(25))
@given(
    models(most_states=2), st.floats(0.01, 1.0), st.floats(0.01, 1.0), probabilities, probabilities, st.integers(0, 2)
)
def test_bursts(model: Model, p: float, r: float, good: float, bad: float, kind: int) -> None:
    """Every slot behind a Gilbert–Elliott link, for the legitimate estimator, a smart and a naive eavesdropper or the genie."""
    at: Callable[[float], Outcomes] = (
        lambda q: Outcomes.legitimate(q, 0.75),
        lambda q: Outcomes.eavesdropper(q, 0.75, 1.0, 0.5),
        lambda q: Outcomes.genie(q, 0.75),
    )[kind]
    transitions = np.array([[1.0 - p, p], [r, 1.0 - r]])
    distribution = np.array([r, p]) / (p + r)
    chain = Chain(transitions, distribution, np.array([good, bad]))
    expected = rationals.behind_a_chain(
        model.A,
        model.Q,
        model.initial,
        exact(transitions),
        [Fraction(float(probability)) for probability in distribution],
        [odds_of(at(good)), odds_of(at(bad))],
        SLOTS,
    )
    traces = ModulatedCovariance(model.process, LinkDistribution.steady(chain), at).next_traces(SLOTS)
    assert all(close(actual, value) for actual, value in zip(traces, expected, strict=True))


@settings(deadline=None, max_examples=examples(20))
@given(models(most_states=2, highest=0.95), st.floats(0.01, 1.0), st.floats(0.01, 1.0), st.floats(0.1, 1.0))
def test_limits_behind_bursts(model: Model, p: float, r: float, good: float) -> None:
    """The linear equations of all states of the link at once; the second state loses everything."""
    transitions = np.array([[1.0 - p, p], [r, 1.0 - r]])
    distribution = np.array([r, p]) / (p + r)
    outcomes = [Outcomes.legitimate(good, 0.6), Outcomes.legitimate(0.0, 0.6)]
    T, weights = exact(transitions), [Fraction(float(probability)) for probability in distribution]
    n, kept = model.process.n, [Fraction(outcome.propagated) for outcome in outcomes]
    places = [(s, i, j) for s in range(2) for i in range(n) for j in range(n)]
    equations = [
        [
            Fraction(int((s, i, j) == (t, a, b))) - kept[s] * T[t][s] * model.A[i][a] * model.A[j][b]
            for t, a, b in places
        ]
        for s, i, j in places
    ]
    source = [[weights[s] * Fraction(outcomes[s].predicted) * model.Q[i][j]] for s, i, j in places]
    solution = [row[0] for row in rationals.times(rationals.inverted(equations), source)]
    expected = sum((value for value, (_, i, j) in zip(solution, places, strict=True) if i == j), Fraction(0))
    result = limit_behind(
        model.process, Chain(transitions, distribution, np.array([good, 0.0])), lambda q: Outcomes.legitimate(q, 0.6)
    )
    amplified = 1 + expected / trace(model.Q)
    assert close(result, expected, CLOSE * amplified)


@settings(deadline=None, max_examples=examples(20))
@given(models())
def test_the_bound_of_twin_tracks(model: Model) -> None:
    """Half the trace of A^k Σ0 A^kᵀ."""
    grown = model.initial
    for value in twin_track_bound(model.process, SLOTS):
        assert close(value, trace(grown) / 2)
        grown = rationals.rounded(rationals.congruent(model.A, grown))


@settings(deadline=None, max_examples=examples(20))
@given(models(), probabilities, probabilities, probabilities)
def test_readers_of_references(model: Model, received: float, heard: float, unheard: float) -> None:
    """P is a reference's or a predicted error, and the reference is the error at the last acknowledgement."""
    acknowledged = (heard * received, unheard * (1.0 - received))
    result = reference_covariances(model.process, received, acknowledged, SLOTS)
    hears, alone = Fraction(received), Fraction(acknowledged[1])
    P = R = [[Fraction(0)] * model.process.n for _ in range(model.process.n)]
    for k in range(SLOTS):
        predicted = rationals.combined((1, rationals.congruent(model.A, P)), (1, model.Q)) if k else model.initial
        carried = rationals.congruent(model.A, R)
        P = rationals.rounded(rationals.combined((hears, carried), (1 - hears, predicted)))
        R = rationals.rounded(rationals.combined((1 - alone, carried), (alone, predicted)))
        assert close(float(np.trace(result[k])), trace(P))


@settings(deadline=None, max_examples=examples(20))
@given(models(most_states=2, highest=0.9), st.integers(1, 3), st.floats(0.05, 1.0), probabilities, st.booleans())
def test_schedules_by_holding_time(
    model: Model, threshold: int, received: float, fraction: float, encrypted: bool
) -> None:
    """Every slot, and the limit: where all packets arrive, slots repeat with a period, and it is their mean."""
    acknowledged = (fraction * received, 0.5 * (1.0 - received))
    chain = (encrypted_schedule if encrypted else scheduled)(threshold, received, acknowledged)
    carried, all_ways = exact(chain.carried), exact(chain.carried + chain.reset)
    distribution = [Fraction(float(probability)) for probability in chain.start]
    n, states = model.process.n, len(distribution)
    parts = [[[Fraction(0)] * n for _ in range(n)] for _ in distribution]
    covariances = chain.covariances(model.process, SLOTS)
    for k in range(SLOTS):
        source = model.Q if k else model.initial
        grown = [
            rationals.combined((1, rationals.congruent(model.A, part)), (p, source))
            for part, p in zip(parts, distribution, strict=True)
        ]
        parts = [
            rationals.rounded(rationals.combined(*((carried[r][s], grown[r]) for r in range(states))))
            for s in range(states)
        ]
        distribution = [
            sum((distribution[r] * all_ways[r][s] for r in range(states)), Fraction(0)) for s in range(states)
        ]
        assert close(float(np.trace(covariances[k])), sum((trace(part) for part in parts), Fraction(0)))
    late = chain.covariances(model.process, 2000)[-PERIODS:].mean(axis=0)
    assert np.trace(chain.limit(model.process)) == pytest.approx(np.trace(late), rel=1e-9)


@given(
    st.floats(0.0, 1.0, exclude_min=True), st.floats(0.0, 1.0, exclude_min=True), st.integers(0, 4), st.integers(0, 4)
)
@example(1.0, 1.0, 0, 0)
def test_the_limiting_distribution(mu: float, mu_d: float, innovations: int, drops: int) -> None:
    """π_0 and the probabilities of words and steps, down to links that hardly ever lose and states that are hardly ever sent."""
    assume(mu * mu_d > 1e-300)
    p_d, p_i, p_r = 1 - Fraction(mu), Fraction(mu) * (1 - Fraction(mu_d)), Fraction(mu) * Fraction(mu_d)
    synchronised = p_r / (1 - p_i)
    assert close(synchronised_probability(mu, mu_d), synchronised)
    word = p_i**innovations * p_d ** (drops + 1) * synchronised
    assert close(word_probability(mu, mu_d, innovations, drops), word) or word < Fraction(1, 10**300)
    steps = [synchronised, *(p_d * synchronised * (p_i + p_d) ** (i - 1) for i in range(1, 6))]
    for actual, expected in zip(step_probabilities(mu, mu_d, 6), steps, strict=True):
        assert close(actual, expected) or expected < Fraction(1, 10**300)


@pytest.mark.parametrize("excess", [1e-3, 1e-5])
def test_limits_near_the_bound_of_stability(excess: float) -> None:
    """A scalar process, whose limit is p Q / (1 − p a²): as accurate as the distance to the bound that a double can hold."""
    a = 1.2
    kept = (1.0 - excess) / a**2
    outcomes = Outcomes(predicted=kept, state=1.0 - kept, misled=0.0, decoded=0.0, initial=kept)
    process = Process(np.array([[a]]), np.array([[0.3]]), np.array([[1.0]]))
    p = Fraction(kept)
    expected = p * Fraction(0.3) / (1 - p * Fraction(a) ** 2)
    assert close(limit_trace(process, outcomes), expected, Fraction(1, 10**13) / Fraction(excess))


@pytest.mark.long
@settings(deadline=None, max_examples=3000)
@given(models(most_states=4), receivers)
def test_expectations_of_many_processes(model: Model, outcomes: Outcomes) -> None:
    """As above, with more processes and states."""
    expected = rationals.expectations(model.A, model.Q, model.initial, odds_of(outcomes), SLOTS)
    result = theoretical_traces(model.process, outcomes, SLOTS)
    assert all(close(value, trace(E)) for value, E in zip(result, expected, strict=True))
