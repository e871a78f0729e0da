"""Acknowledgements on their channel, and the detection of an attack on them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.stats import binomtest

from evedrop.model.acknowledgements import ACTS, ATTACKS, AckChannel, AckChannelSpec, AckFate, rates_of
from evedrop.model.detection import Chart, CusumBatch, chart_for
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.schemes.acknowledged import Acknowledged
from evedrop.model.streams import Batch, stream_key
from evedrop.model.theory.closed_forms import reference_covariances
from tests.builders import UNSTABLE
from tests.examples import examples, mostly_long
from tests.model.slot_loop import ROOT, coins, play

KEY = stream_key(ROOT, "link/acknowledgements")


def test_attacks_are_what_their_names_say() -> None:
    """On each of the four outcomes of a slot; a flip is drawn in every second slot."""
    gamma, gamma_e = np.array([True, True, False, False]), np.array([True, False, True, False])
    flips = np.array([False, True, False, True])
    expected = {
        "none": [True, True, False, False],
        "all": [False] * 4,
        "critical": [True, False, False, False],
        "forge": [True] * 4,
        "flip": [True, False, False, True],
        "hijack": [True, True, False, False],
    }
    assert {name: attack(gamma, gamma_e, flips).tolist() for name, attack in ATTACKS.items()} == expected


@pytest.mark.parametrize("attack", ATTACKS)
def test_rates_are_those_of_the_arrivals(attack: str) -> None:
    """Counted over a million packets, each rate lies within binomial bounds at 1e-6 confidence."""
    mu, mu_e, quality, slots, trials = 0.8, 0.6, 0.7, 100, 10_000
    batch = Batch(slots, trials)
    channel = AckChannel(AckChannelSpec(quality, attack, None, None, 0.2, mu_e), KEY, batch)
    gamma, gamma_e = coins(mu, slots, trials, 1), coins(mu_e, slots, trials, 2)
    arrived = np.array([channel.arrived(k, None, gamma[k], gamma_e[k]) for k in range(slots)])
    rates = rates_of(attack, mu, mu_e, quality, 0.2)
    for flags, rate in (
        (arrived, rates.arrives),
        (arrived & gamma, rates.legitimate[0]),
        (arrived & ~gamma, rates.legitimate[1]),
        (arrived & gamma_e, rates.eavesdropper[0]),
        (arrived & ~gamma_e, rates.eavesdropper[1]),
    ):
        assert binomtest(int(flags.sum()), flags.size, rate).pvalue > 1e-6


@pytest.mark.parametrize("attack", ATTACKS)
@pytest.mark.parametrize("spans", [None, [(10, 20)]])
def test_a_fate_says_why_an_acknowledgement_came_or_not(attack: str, spans: list[tuple[int, int]] | None) -> None:
    """The sensor gets those that arrived or were forged; the attacker's acts are those of its attack, while that lasts."""
    slots, trials, quality = 40, 500, 0.7
    spec = AckChannelSpec(quality, attack, None, spans, 0.2, 0.6)
    channels = [AckChannel(spec, KEY, Batch(slots, trials)) for _ in range(2)]
    gamma, gamma_e, sent = (coins(0.7, slots, trials, seed) for seed in (1, 2, 3))
    seen = set()
    for k in range(slots):
        with_gaps = sent[k] if k % 2 else None
        arrived = channels[0].arrived(k, with_gaps, gamma[k], gamma_e[k])
        fates = channels[1].fates(k, with_gaps, gamma[k], gamma_e[k])
        np.testing.assert_array_equal(np.isin(fates, (AckFate.ARRIVED, AckFate.FORGED)), arrived)
        was_sent = np.ones(trials, bool) if with_gaps is None else with_gaps
        assert (fates[~was_sent] == AckFate.NONE).all()
        assert not gamma[k][fates == AckFate.FORGED].any()
        assert gamma[k][np.isin(fates, (AckFate.ARRIVED, AckFate.LOST, AckFate.BLOCKED, AckFate.IGNORED))].all()
        if attack == "critical":
            assert not gamma_e[k][fates == AckFate.BLOCKED].any()
        now = spans is None or 10 <= k < 20
        acts = {AckFate.BLOCKED, AckFate.FORGED, AckFate.IGNORED} & {AckFate(fate) for fate in fates.tolist()}
        assert acts <= (set(ACTS[attack]) if now else set())
        seen |= acts
    assert seen == set(ACTS[attack])


def test_what_was_not_sent_is_not_acknowledged() -> None:
    """Not even where it is forged; and a trial's channel is the same alone and among others, slots in any order."""
    gamma = np.zeros(50, bool)
    sent = np.arange(50) % 2 == 0
    spec = AckChannelSpec(0.5, "forge", None, None)
    among, alone = AckChannel(spec, KEY, Batch(20, 50, 7)), AckChannel(spec, KEY, Batch(20, 1, 7 + 12))
    for k in (3, 0, 19, 3):
        arrived = among.arrived(k, sent, gamma, gamma)
        assert not arrived[~sent].any()
        assert alone.arrived(k, None, gamma[:1], gamma[:1])[0] == arrived[12]


@pytest.mark.parametrize("attack", ATTACKS)
def test_attacks_on_state_secrecy_codes_cost_what_theory_says(attack: str) -> None:
    """Mean reported trace after a few slots, both receivers, by the recursion, at 5 standard errors."""
    mu, mu_e, slots, trials = 0.8, 0.7, 6, 20_000
    batch = Batch(slots, trials)
    quality = 0.6 if attack == "hijack" else 0.9  # above μ_e a hijacked sensor has a memory, and theory another form
    channel = AckChannel(AckChannelSpec(quality, attack, None, None, 0.0, mu_e), KEY, batch)
    eve = STRATEGIES["reference"](Knowledge(UNSTABLE, 1.0, {}, {}), batch)
    played = play(
        Acknowledged(UNSTABLE),
        batch,
        {"legitimate": coins(mu, slots, trials, 3), "eve": coins(mu_e, slots, trials, 4)},
        {"eve": eve},
        lambda k, sent, received: channel.arrived(k, sent, received["legitimate"], received["eve"]),
    )
    rates = rates_of(attack, mu, mu_e, quality)
    for name, quality, acknowledged in (("legitimate", mu, rates.legitimate), ("eve", mu_e, rates.eavesdropper)):
        expected = np.trace(reference_covariances(UNSTABLE, quality, acknowledged, slots), axis1=1, axis2=2)
        for errors in (played.trace(name), played.squared_error(name)):
            assert (np.abs(errors.mean(1) - expected) < 5.0 * errors.std(1) / np.sqrt(trials) + 1e-18).all()


def simulated(chart: Chart, rate: float, trials: int, packets: int) -> np.ndarray:
    """Packets until the alarm in each trial, by stepping the chart; `packets` if no alarm is raised."""
    S, length = chart.start(trials), np.full(trials, packets)
    rng = np.random.default_rng(9)
    for k in range(packets):
        before = chart.alarms(S)
        S = chart.step(S, rng.random(trials) < rate)
        length[chart.alarms(S) & ~before] = k + 1
    return length


@pytest.mark.parametrize(
    ("normal", "attacked"),
    mostly_long([(0.9, 0.81), (0.9, 0.0), (0.6, 0.36), (0.7, 1.0), (0.5, 0.8)], [(0.9, 0.81), (0.7, 1.0)]),
)
@pytest.mark.thorough
def test_run_lengths_are_exact(normal: float, attacked: float) -> None:
    """Before and after a change, the mean simulated run length is the chain's, at 5 standard errors."""
    chart = chart_for(normal, attacked, 200.0)
    assert chart.run_length(normal) >= 200.0
    for rate in (normal, attacked):
        expected = chart.run_length(rate)
        result = simulated(chart, rate, 3000, int(40 * min(expected, 500)))
        assert abs(result.mean() - expected) < 5.0 * result.std() / np.sqrt(3000) + 1e-9


@pytest.mark.parametrize("misses", [1, 2, 5, 9])
def test_blocking_all_is_a_run_of_misses(misses: int) -> None:
    """Against a rate of 0 an acknowledgement clears the suspicion: run length (1 − q^h) / (q^h (1 − q)), q = 1 − μ."""
    q = 0.1
    expected = (1.0 - q**misses) / (q**misses * (1.0 - q))
    chart = chart_for(1.0 - q, 0.0, 0.999 * expected)
    assert (chart.missing, chart.threshold) == (1, misses)
    assert chart.run_length(1.0 - q) == pytest.approx(expected, rel=1e-9)
    assert chart.run_length(0.0) == misses


@settings(deadline=None, max_examples=examples(60))
@given(
    normal=st.floats(0.05, 0.95),
    attacked=st.floats(0.0, 1.0),
    mean_packets=st.sampled_from([10.0, 300.0, 1e4]),
)
def test_the_threshold_is_the_least_that_keeps_its_promise(normal: float, attacked: float, mean_packets: float) -> None:
    """One less is too quick; and the run length is above e^{θh}, θ the root of E e^{θ score} = 1 (Wald, Lorden)."""
    if abs(normal - attacked) < 0.05:
        return
    chart = chart_for(normal, attacked, mean_packets)
    length = chart.run_length(normal)
    assert length >= mean_packets
    if chart.threshold > 1:
        fewer = Chart(chart.acknowledged, chart.missing, chart.threshold - 1)
        assert fewer.run_length(normal) < mean_packets

    def excess(theta: float) -> float:
        return normal * math.exp(theta * chart.acknowledged) + (1.0 - normal) * math.exp(theta * chart.missing) - 1.0

    if excess(1e-6) < 0.0:
        theta = brentq(excess, 1e-6, 700.0 / max(chart.acknowledged, chart.missing))
        assert length >= math.exp(theta * chart.threshold) * (1.0 - 1e-6)


def test_a_large_mean_is_as_exact_as_a_small_one() -> None:
    """A run of 12 misses of probability 0.1 takes 1.1e12 packets; solved by sums alone it is right to 1e-9."""
    chart = Chart(-12, 1, 12)
    assert chart.run_length(0.9) == pytest.approx((1.0 - 1e-12) / (1e-12 * 0.9), rel=1e-9)
    assert chart.run_length(1.0) == math.inf


@pytest.mark.parametrize(
    ("mu", "mu_e", "attack", "delay"),
    [
        (0.9, 0.9, "all", 4.0),
        (0.9, 0.9, "critical", 131.8),
        (0.9, 0.9, "forge", 66.0),
        (0.6, 0.6, "all", 10.0),
        (0.6, 0.6, "critical", 56.1),
        (0.9, 0.99, "critical", 2559.0),
    ],
)
def test_delays_of_the_document(mu: float, mu_e: float, attack: str, delay: float) -> None:
    """The table of docs/mathematics/attacks.md: packets until the alarm, with false alarms 10 000 packets apart."""
    normal = rates_of("none", mu, mu_e).arrives
    attacked = rates_of(attack, mu, mu_e).arrives
    assert chart_for(normal, attacked, 1e4).run_length(attacked) == pytest.approx(delay, rel=1e-3)


def test_slots_without_a_packet_tell_nothing() -> None:
    """And an alarm stays raised."""
    chart = Chart(-1, 2, 4)
    S = chart.start(3)
    no = np.zeros(3, bool)
    S = chart.step(S, no, np.array([True, False, True]))
    assert S.tolist() == [2, 0, 2]
    S = chart.step(S, np.array([False, False, True]))
    assert S.tolist() == [4, 2, 1]
    assert chart.alarms(S).tolist() == [True, False, False]
    assert chart.step(S, ~no).tolist() == [4, 1, 0]


@pytest.mark.parametrize(("normal", "attacked"), [(1.0, 0.5), (0.0, 0.5), (0.5, 0.5), (0.5, -0.1), (0.5, math.nan)])
def test_rates_that_are_none_are_refused(normal: float, attacked: float) -> None:
    """Equal ones, certain ones and numbers that are not probabilities."""
    with pytest.raises(ValueError, match="expected two different ones"):
        chart_for(normal, attacked, 100.0)


def test_a_promise_that_no_chart_keeps_is_refused() -> None:
    """Rates too close for so few states."""
    with pytest.raises(ValueError, match="no chart of 1024 states"):
        chart_for(0.5, 0.4999, 1e9)


def test_a_chart_over_a_batch_alarms_once_in_each_trial() -> None:
    """In the slot in which its sum reaches the threshold, counted by hand; slots without a packet do not count."""
    watch = CusumBatch(Chart(-1, 2, 4), 3)
    acknowledged = np.array([[0, 1, 0], [0, 0, 1], [0, 0, 0], [1, 0, 0]], bool)
    sent = np.array([[1, 1, 1], [1, 1, 1], [1, 1, 0], [1, 1, 1]], bool)
    # S: 2 4 | 0 2 4 | 2 1 1 3, with an alarm at 4.
    alarms = [watch.take(*pair).tolist() for pair in zip(acknowledged, sent, strict=True)]
    assert alarms == [[False, False, False], [True, False, False], [False, True, False], [False, False, False]]
    always = CusumBatch(Chart(-1, 2, 4), 1)
    assert [always.take(np.zeros(1, bool)).tolist() for _ in range(3)] == [[False], [True], [False]]


def test_a_chart_that_can_never_alarm_takes_for_ever() -> None:
    """Where no packet is evidence, or evidence never comes."""
    assert Chart(-1, 1, 3).run_length(1.0) == math.inf
    assert Chart(0, 1, 3).run_length(1.0) == math.inf
    assert Chart(-1, 1, 3).run_length(0.0) == 3.0
