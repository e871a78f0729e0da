"""Theoretical covariances behind links that remember: against the independent recursion, enumeration, limits and tails."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.links import loss_of
from evedrop.model.links.chain import Chain
from evedrop.model.modulated import ModulatedCovariance, limit_of, limit_trace, tail_outcomes
from evedrop.model.process import Floats, Process
from evedrop.model.slot.link_distribution import LinkDistribution, Segment
from evedrop.model.theory.covariances import (
    Outcomes,
    has_infinite_variance,
    misled_covariances,
    tail_index,
    theoretical_traces,
)
from evedrop.model.theory.covariances import limit_trace as independent_limit
from tests.builders import MARGINAL, UNSTABLE
from tests.examples import examples

STABLE = Process(np.array([[0.9, 0.1], [0.0, 0.7]]), np.eye(2) * 1e-2, np.eye(2))
MU_D = 0.6


def bursts(p: float, r: float, good: float = 0.0, bad: float = 1.0) -> Chain:
    """A Gilbert–Elliott link's chain."""
    chain = loss_of({"model": "gilbert-elliott", "p": p, "r": r, "good": good, "bad": bad}).chain
    assert chain is not None
    return chain


def legitimate(quality: float) -> Outcomes:
    """What the estimator does with a slot."""
    return Outcomes.legitimate(quality, MU_D)


def eavesdropper(use_state: float, use_innovation: float) -> Callable[[float], Outcomes]:
    """What an eavesdropper does with a slot."""
    return lambda quality: Outcomes.eavesdropper(quality, MU_D, use_state, use_innovation)


RECEIVERS = {
    "legitimate": legitimate,
    "plain": Outcomes.plain,
    "smart": eavesdropper(1.0, 0.0),
    "suspicious": eavesdropper(0.8, 0.1),
    "naive": eavesdropper(1.0, 1.0),
}
every_receiver = pytest.mark.parametrize("outcomes_at", RECEIVERS.values(), ids=RECEIVERS)
every_process = pytest.mark.parametrize("process", [MARGINAL, UNSTABLE, STABLE], ids=["marginal", "unstable", "stable"])


@every_receiver
@every_process
def test_a_link_whose_states_are_alike_is_the_papers(
    process: Process, outcomes_at: Callable[[float], Outcomes]
) -> None:
    """One state, or several of one quality, give the independent recursion, to 1e-12, and its limit."""
    expected = theoretical_traces(process, outcomes_at(0.7), 60)
    for chain in (Chain(np.ones((1, 1)), np.ones(1), np.array([0.7])), bursts(0.1, 0.3, 0.3, 0.3)):
        np.testing.assert_allclose(
            ModulatedCovariance(process, LinkDistribution.steady(chain), outcomes_at).next_traces(60),
            expected,
            rtol=1e-12,
        )
        assert limit_trace(process, chain, outcomes_at) == pytest.approx(
            independent_limit(process, outcomes_at(0.7)), rel=1e-9
        )
        tail = tail_index(process, tail_outcomes(chain, outcomes_at))
        assert tail == pytest.approx(tail_index(process, outcomes_at(0.7)), rel=1e-9)


@settings(deadline=None, max_examples=examples(20))
@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.01, 1.0), st.integers(1, 40))
def test_slots_may_be_asked_for_in_any_pieces(good: float, bad: float, p: float, first: int) -> None:
    """The same numbers, whatever the pieces."""
    chain = bursts(p, 0.3, good, bad)
    whole = ModulatedCovariance(MARGINAL, LinkDistribution.steady(chain), RECEIVERS["suspicious"]).next_traces(50)
    stream = ModulatedCovariance(MARGINAL, LinkDistribution.steady(chain), RECEIVERS["suspicious"])
    assert np.array_equal(np.concatenate([stream.next_traces(first), stream.next_traces(50 - first)]), whole)


def enumerated(process: Process, chain: Chain, use: tuple[float, float] | None, slots: int) -> Floats:
    """The trace of E P_k, (slots,), as a sum over all words of link states, losses, packet types and guesses.

    use: P(b | state), P(b | innovation) of an eavesdropper; None: the estimator that holds the secret.
    """
    A, Q, f = process.A, process.Q, misled_covariances(process, slots)
    traces = np.zeros(slots)
    for states in itertools.product(range(len(chain.stationary)), repeat=slots):
        path = chain.stationary[states[0]] * math.prod(chain.transitions[a, b] for a, b in itertools.pairwise(states))
        for events in itertools.product(itertools.product((False, True), repeat=3), repeat=slots):
            weight, P = path, process.initial_covariance
            for k, (received, innovation, used) in enumerate(events):
                q, p_innovation = chain.quality[states[k]], (1.0 - MU_D) if k else 0.0
                p_used = 1.0 if use is None else use[innovation]
                weight *= (q if received else 1.0 - q) * (p_innovation if innovation else 1.0 - p_innovation)
                weight *= p_used if used else 1.0 - p_used
                if weight == 0.0:
                    break
                if received and used and not innovation:
                    P = np.zeros_like(Q)
                elif received and used:
                    P = A @ P @ A.T if use is None else f[k]
                elif k:
                    P = A @ P @ A.T + Q
            traces[-1] += weight * np.trace(P)
    return traces


@pytest.mark.parametrize("use", [None, (1.0, 0.0), (0.8, 0.1), (1.0, 1.0)], ids=["legitimate", "smart", "sus", "naive"])
@pytest.mark.parametrize("slots", [1, 2, 3])
def test_the_recursion_is_the_sum_over_all_words(use: tuple[float, float] | None, slots: int) -> None:
    """Every word of link states and packets, weighed and added up by hand, gives the recursion's last value."""
    chain = bursts(0.2, 0.4, 0.1, 0.9)
    outcomes_at = legitimate if use is None else eavesdropper(*use)
    next_traces = ModulatedCovariance(UNSTABLE, LinkDistribution.steady(chain), outcomes_at).next_traces(slots)
    assert next_traces[-1] == pytest.approx(enumerated(UNSTABLE, chain, use, slots)[-1], rel=1e-12)


def chain_of(spec: dict[str, Any]) -> Chain:
    """The chain of a loss model that has one."""
    chain = loss_of(spec).chain
    assert chain is not None
    return chain


THREE = chain_of(
    {
        "model": "markov",
        "transitions": [[0.8, 0.15, 0.05], [0.3, 0.5, 0.2], [0.0, 0.6, 0.4]],
        "loss": [0.01, 0.4, 1.0],
    }
)


@every_receiver
@every_process
@pytest.mark.parametrize(
    "chain",
    [
        bursts(0.05, 0.7),
        pytest.param(bursts(0.3, 0.5, 0.1, 0.6), marks=pytest.mark.long),
        pytest.param(bursts(0.02, 0.05), marks=pytest.mark.long),
        pytest.param(THREE, marks=pytest.mark.long),
    ],
)
def test_the_limit_is_that_of_the_recursion(
    process: Process, chain: Chain, outcomes_at: Callable[[float], Outcomes]
) -> None:
    """A finite limit is what the recursion comes to; where it is inf, the recursion grows on and on."""
    limit = limit_trace(process, chain, outcomes_at)
    traces = ModulatedCovariance(process, LinkDistribution.steady(chain), outcomes_at).next_traces(6000)
    if math.isfinite(limit):
        assert traces[-1] == pytest.approx(limit, rel=1e-6)
    else:
        assert traces[-1] > 1.5 * traces[3000] or math.isinf(traces[3000])


@pytest.mark.parametrize("r", [0.35, 0.45, 0.479, 0.4815, 0.5, 0.7])
def test_bursts_that_last_too_long_have_no_limit(r: float) -> None:
    """Behind a link that loses all or nothing, and μ_d = 1, the error is bounded exactly while (1 − r) ρ² < 1."""
    chain, rho = bursts(0.05, r), UNSTABLE.spectral_radius
    bounded = (1.0 - r) * rho**2 < 1.0
    assert math.isfinite(limit_trace(UNSTABLE, chain, Outcomes.plain)) is bounded
    traces = ModulatedCovariance(UNSTABLE, LinkDistribution.steady(chain), Outcomes.plain).next_traces(4000)
    assert bool(traces[-1] < 1.001 * traces[2000]) is bounded


def test_a_perfect_link_has_no_error() -> None:
    """A receiver of every packet is exact forever, however unstable the process is, and has no tail."""
    chain = bursts(0.1, 0.3, 0.0, 0.0)

    def rarely(quality: float) -> Outcomes:
        return Outcomes.legitimate(quality, 0.1)

    assert limit_trace(UNSTABLE, chain, rarely) == 0.0
    assert not ModulatedCovariance(UNSTABLE, LinkDistribution.steady(chain), rarely).next_traces(100).any()
    assert math.isinf(tail_index(UNSTABLE, tail_outcomes(chain, rarely)))


def test_a_bounded_expectation_stays_so_beyond_double_precision() -> None:
    """The state's covariance leaves double precision after some thousand slots; a smart eavesdropper's does not."""
    chain = bursts(0.05, 0.7)
    traces = ModulatedCovariance(UNSTABLE, LinkDistribution.steady(chain), eavesdropper(1.0, 0.0)).next_traces(3000)
    assert traces[-1] == pytest.approx(limit_trace(UNSTABLE, chain, eavesdropper(1.0, 0.0)), rel=1e-9)
    misled = ModulatedCovariance(UNSTABLE, LinkDistribution.steady(chain), eavesdropper(1.0, 1.0)).next_traces(3000)
    beyond = int(np.flatnonzero(np.isinf(misled))[0])
    assert np.isfinite(misled[:beyond]).all()
    assert np.isinf(misled[beyond:]).all()


def test_tails_are_those_of_the_chain() -> None:
    """All or nothing and μ_d = 1: a loss lasts on with 1 − r, whatever p; infinite variance exactly if (1 − r) ρ⁴ ≥ 1."""
    rho = UNSTABLE.spectral_radius
    for r in (0.5, 0.72, 0.74, 0.9):
        for p in (0.01, 0.2):
            outcomes = tail_outcomes(bursts(p, r), Outcomes.plain)
            assert outcomes.propagated == pytest.approx(1.0 - r, abs=1e-12)
            assert tail_index(UNSTABLE, outcomes) == pytest.approx(-math.log(1.0 - r) / (2.0 * math.log(rho)))
            assert has_infinite_variance(UNSTABLE, outcomes) is ((1.0 - r) * rho**4 >= 1.0)
    assert math.isinf(tail_index(MARGINAL, tail_outcomes(bursts(0.1, 0.2), legitimate)))
    assert math.isinf(tail_index(UNSTABLE, tail_outcomes(bursts(0.1, 0.2), RECEIVERS["naive"])))


def test_the_rate_of_the_tail_is_how_long_a_word_lasts() -> None:
    """P(no state packet in k slots), summed slot by slot over the chain, falls by the factor `kept` a slot."""
    chain = THREE
    kept = np.array([legitimate(q).propagated for q in chain.quality])
    alive = chain.stationary * kept
    for _ in range(200):
        before, alive = alive.sum(), (alive @ chain.transitions) * kept
    assert alive.sum() / before == pytest.approx(tail_outcomes(chain, legitimate).propagated, rel=1e-9)


def recursion(process: Process, chain: Chain, outcomes_at: Callable[[float], Outcomes], slots: int) -> Floats:
    """Trace of E P_k as the module's docstring has it, slot by slot and state by state, (slots,)."""
    odds = [outcomes_at(float(quality)) for quality in chain.quality]
    f = misled_covariances(process, slots)
    states = [
        weight * odd.initial * process.initial_covariance for weight, odd in zip(chain.stationary, odds, strict=True)
    ]
    traces = [float(np.trace(sum(states)))]
    for k in range(1, slots):
        states = [
            odd.propagated
            * process.A
            @ sum(T * E for T, E in zip(chain.transitions[:, s], states, strict=True))
            @ process.A.T
            + chain.stationary[s] * (odd.predicted * process.Q + odd.misled * f[k])
            for s, odd in enumerate(odds)
        ]
        traces.append(float(np.trace(sum(states))))
    return np.array(traces)


@every_receiver
@every_process
def test_blocks_of_slots_are_what_slot_by_slot_gives(
    process: Process, outcomes_at: Callable[[float], Outcomes]
) -> None:
    """Over several blocks, to 1e-12; and to the bit the same however many slots are asked for at a time."""
    chain, slots = bursts(0.05, 0.3, 0.02, 0.7), 450
    link = LinkDistribution.steady(chain)
    expected = recursion(process, chain, outcomes_at, slots)
    whole = ModulatedCovariance(process, link, outcomes_at).next_traces(slots)
    np.testing.assert_allclose(whole, expected, rtol=1e-12)
    stream = ModulatedCovariance(process, link, outcomes_at)
    parts = [stream.next_traces(count) for count in (0, 1, 2, 130, 17, 300)]
    assert np.array_equal(np.concatenate(parts), whole)


def late(process: Process, link: LinkDistribution, outcomes_at: Callable[[float], Outcomes], slots: int) -> Floats:
    """The same with late packets, several segments and an outage: each slot from what is settled, (slots,).

    A packet of slot j counts in slot k with the probability that it has arrived by then.
    """
    window, f, starts = link.window, misled_covariances(process, slots), [segment.start for segment in link.segments]
    traces: list[float] = []

    def after(states: list[Floats] | None, j: int, k: int) -> list[Floats]:
        segment = [segment for segment in link.segments if segment.start <= j][-1]
        away = any(start <= j < stop for start, stop, _ in link.outages)
        reached = 0.0 if away else segment.passes * float(segment.arrived[k - j])
        odds = [outcomes_at(reached * float(quality)) for quality in segment.chain.quality]
        pi = segment.chain.stationary
        if states is None:
            return [p * odd.initial * process.initial_covariance for p, odd in zip(pi, odds, strict=True)]
        fresh = j in starts and not segment.continues
        weights = [pi[s] * np.ones(len(states)) if fresh else segment.chain.transitions[:, s] for s in range(len(pi))]
        return [
            odd.propagated * process.A @ sum(T * E for T, E in zip(weights[s], states, strict=True)) @ process.A.T
            + pi[s] * (odd.predicted * process.Q + odd.misled * f[j])
            for s, odd in enumerate(odds)
        ]

    settled: list[Floats] | None = None
    for k in range(slots):
        if k >= window:
            settled = after(settled, k - window, k)
        states = settled
        for j in range(max(0, k - window + 1), k + 1):
            states = after(states, j, k)
        traces.append(float(np.trace(sum(states or []))))
    return np.array(traces)


@pytest.mark.parametrize(
    ("process", "receiver"),
    [
        *(pytest.param(MARGINAL, name, marks=[] if name == "smart" else pytest.mark.long) for name in RECEIVERS),
        (UNSTABLE, "naive"),
        pytest.param(STABLE, "legitimate", marks=pytest.mark.long),
    ],
)
def test_blocks_of_slots_with_late_packets_are_what_slot_by_slot_gives(process: Process, receiver: str) -> None:
    """Over several blocks, around a change of the link and before an outage, to 1e-12; in any pieces to the bit."""
    slots, arrived, outcomes_at = 540, np.array([0.3, 0.6, 0.8, 0.9]), RECEIVERS[receiver]
    segments = (
        Segment(0, bursts(0.05, 0.3, 0.02, 0.7), 0.9, arrived),
        Segment(270, bursts(0.2, 0.4), 1.0, np.array([0.5, 0.5, 1.0, 1.0])),
        Segment(290, bursts(0.2, 0.4), 0.5, arrived, continues=True),
    )
    link = LinkDistribution(segments, ((530, 532, True),))
    whole = ModulatedCovariance(process, link, outcomes_at).next_traces(slots)
    expected = late(process, link, outcomes_at, slots)
    finite = np.isfinite(expected)
    np.testing.assert_allclose(whole[finite], expected[finite], rtol=1e-12)
    stream = ModulatedCovariance(process, link, outcomes_at)
    assert np.array_equal(np.concatenate([stream.next_traces(count) for count in (1, 2, 130, 17, 390)]), whole)


def test_errors_beyond_double_precision_are_infinite_from_there_on() -> None:
    """Within a block that overflows slots are taken one by one: up to there the traces are those of the recursion."""
    process = Process(np.diag([1.5, 0.5]), np.eye(2), np.eye(2))
    chain = bursts(0.1, 0.4)
    covariance = ModulatedCovariance(process, LinkDistribution.steady(chain), Outcomes.plain)
    traces = covariance.next_traces(3000)
    first = int(np.argmax(np.isinf(traces)))
    assert np.isinf(traces[first:]).all()
    assert np.isfinite(traces[:first]).all()
    assert traces[first - 1] > 1e306
    growth = traces[first - 10 : first] / traces[first - 11 : first - 1]
    slow = ModulatedCovariance(process, LinkDistribution.steady(chain), Outcomes.plain)
    assert np.array_equal(np.concatenate([slow.next_traces(7) for _ in range(400)])[:first], traces[:first])
    assert np.allclose(growth, growth[0], rtol=1e-6)
    assert growth[0] > 1.0


def test_limits_that_are_too_large_to_compute_are_not_a_number() -> None:
    """And a receiver without a limit has an infinite one."""
    many = Process(0.5 * np.eye(17), np.eye(17), np.eye(17))
    assert math.isnan(limit_of(many, LinkDistribution.steady(bursts(0.1, 0.4)), Outcomes.plain))
    assert math.isinf(limit_of(UNSTABLE, LinkDistribution.steady(bursts(0.9, 0.1)), Outcomes.plain))
    assert limit_of(STABLE, LinkDistribution.steady(bursts(0.1, 0.4)), Outcomes.plain) == pytest.approx(
        limit_trace(STABLE, bursts(0.1, 0.4), Outcomes.plain)
    )


def test_many_states_are_followed_slot_by_slot() -> None:
    """Where an operator of whole blocks would be too large: nine states without any coupling are nine processes of one."""
    rates = np.linspace(0.5, 1.05, 9)
    chain = bursts(0.2, 0.5)
    many = Process(np.diag(rates), np.eye(9), 2.0 * np.eye(9))
    next_traces = ModulatedCovariance(many, LinkDistribution.steady(chain), Outcomes.plain).next_traces(400)
    one_by_one = [
        ModulatedCovariance(
            Process(np.array([[a]]), np.eye(1), 2.0 * np.eye(1)), LinkDistribution.steady(chain), Outcomes.plain
        )
        for a in rates
    ]
    assert np.allclose(next_traces, sum(chain.next_traces(400) for chain in one_by_one), rtol=1e-10)


def test_a_known_start_is_known_again_after_a_restart() -> None:
    """While the receiver is down nobody predicts from x_0, in slot 0 too; restarted, it does so as if it had heard nothing."""
    a, q, p0 = 1.1, 0.5, 2.0
    process = Process(np.array([[a]]), np.array([[q]]), np.array([[p0]]))

    def twin_tracks(quality: float) -> Outcomes:
        return Outcomes(1.0 - quality, 0.4 * quality, misled=0.0, decoded=0.6 * quality, initial=0.0)

    chain, slots, down = Chain(np.ones((1, 1)), np.ones(1), np.array([0.7])), 10, [*range(2), *range(5, 8)]
    link = LinkDistribution(LinkDistribution.steady(chain).segments, ((0, 2, False), (5, 8, False)))
    known, sigma, E, expected = 0.0, p0, 0.0, []
    for k in range(slots):
        if k:
            before = known if k - 1 in down else E  # x_0 is the only state that it can predict from when it is back
            E = 0.72 * a * a * before + 0.3 * q
            known, sigma = a * a * known + q, a * a * sigma + q
        expected.append(sigma if k in down else E)
    traces = ModulatedCovariance(process, link, twin_tracks).next_traces(slots)
    assert traces == pytest.approx(expected, rel=1e-12)
