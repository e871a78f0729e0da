"""The best policy of sending, if both holding times were known, and the metrics of policies."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.process import Process
from evedrop.model.theory.policies import (
    LinkProbabilities,
    PolicyMetrics,
    best_policy,
    front,
    held_traces,
    least_weight,
    policy_metrics,
    scheduled_metrics,
)
from tests.builders import DRIFTING, MICROGRID, UNSTABLE
from tests.examples import examples
from tests.model.schemes.test_schemes_by_holding_time import played_over
from tests.model.slot_loop import STABLE, coins

MU, MU_E = 0.8, 0.6
SIGMAS = 4.5


def links_of(mu: float, mu_e: float) -> LinkProbabilities:
    """Links whose acknowledgements all arrive."""
    return LinkProbabilities(mu, mu_e, (mu, 0.0), (mu * mu_e, mu * (1.0 - mu_e)))


@settings(deadline=None, max_examples=examples(25))
@given(
    mu=st.sampled_from([0.5, 0.8, 0.95, 1.0]),
    mu_e=st.sampled_from([0.0, 0.3, 0.6, 0.9, 1.0]),
    weight=st.sampled_from([0.0, 0.4, 0.5, 0.6, 0.7, 0.9, 1.0]),
    price=st.sampled_from([0.0, 1e-3, 1e-1]),
    process=st.sampled_from([STABLE, DRIFTING, UNSTABLE]),
)
def test_the_best_policy_is_a_threshold(mu: float, mu_e: float, weight: float, price: float, process: Process) -> None:
    """It sends from some holding time of the legitimate estimator on, the later the longer the eavesdropper's."""
    policy = best_policy(process, mu, mu_e, weight, 9, price)
    assert (np.diff(policy.send.astype(int), axis=0) >= 0).all()
    assert policy.thresholds == tuple(1 + int((~policy.send[:, j]).sum()) for j in range(9))
    assert list(policy.thresholds) == sorted(policy.thresholds)


def average_cost(send: np.ndarray, weight: float, price: float) -> float:
    """The average cost of a rule from the holding times S and S on, by its joint chain, with cut-off holding times."""
    states = len(send)
    traces = [sum(float(np.trace(power @ STABLE.Q @ power.T)) for power in powers(i)) for i in range(states)]
    T, stage = np.zeros((states,) * 4), np.zeros((states, states))
    for i, j in itertools.product(range(states), repeat=2):
        for heard, heard_e in itertools.product((True, False), repeat=2):
            chance = (MU if heard else 1 - MU) * (MU_E if heard_e else 1 - MU_E)
            to = (
                0 if heard and send[i, j] else min(i + 1, states - 1),
                0 if heard_e and send[i, j] else min(j + 1, states - 1),
            )
            T[i, j][to] += chance
            stage[i, j] += chance * (weight * traces[to[0]] - (1 - weight) * traces[to[1]] + price * send[i, j])
    many = np.linalg.matrix_power(T.reshape(states**2, -1), 4000)
    return float(many[-1] @ stage.reshape(-1))


def powers(count: int) -> list[np.ndarray]:
    """A^0 … A^{count−1}."""
    return [np.linalg.matrix_power(STABLE.A, power) for power in range(count)]


@pytest.mark.parametrize(("weight", "price"), [(0.6, 0.0), (0.7, 0.0), (0.55, 2e-3), (0.45, 0.0)])
def test_the_best_policy_is_no_worse_than_others(weight: float, price: float) -> None:
    """Its gain is the average cost of following it, and no rule that differs in one state, or at random, costs less."""
    states = 5
    policy = best_policy(STABLE, MU, MU_E, weight, states, price)
    assert average_cost(policy.send, weight, price) == pytest.approx(policy.gain, abs=1e-9)
    rng = np.random.default_rng(0)
    for i, j in itertools.product(range(states), repeat=2):
        other = policy.send.copy()
        other[i, j] ^= True
        assert average_cost(other, weight, price) >= policy.gain - 1e-9
    for _ in range(100):
        other = rng.random((states, states)) < rng.random()
        assert average_cost(other, weight, price) >= policy.gain - 1e-9


def test_the_best_of_all_rules() -> None:
    """With three holding times no rule of all 512 costs less."""
    for weight in (0.45, 0.55, 0.65):
        best = min(
            average_cost(np.array(rule).reshape(3, 3), weight, 1e-3)
            for rule in itertools.product((False, True), repeat=9)
        )
        assert best_policy(STABLE, MU, MU_E, weight, 3, 1e-3).gain == pytest.approx(best, abs=1e-10)


@pytest.mark.parametrize("process", [STABLE, DRIFTING, UNSTABLE, MICROGRID])
@pytest.mark.parametrize("threshold", [1, 2, 4])
def test_a_rule_that_ignores_the_eavesdropper_is_scheduled(process: Process, threshold: int) -> None:
    """The metrics by both holding times are those of the chain of `scheduled`, unbounded errors as well."""
    for mu, mu_e in ((0.8, 0.6), (0.95, 0.2), (1.0, 0.5), (0.9, 1.0), (0.7, 0.0)):
        send = np.broadcast_to(np.arange(1, 6)[:, None] >= threshold, (5, 5))
        result = policy_metrics(process, send, mu, mu_e)
        expected = scheduled_metrics(process, links_of(mu, mu_e), threshold)
        assert result.legitimate == pytest.approx(expected.legitimate, rel=1e-9, abs=1e-13)
        assert result.eavesdropper == pytest.approx(expected.eavesdropper, rel=1e-9, abs=1e-13)
        assert result.transmissions == pytest.approx(expected.transmissions, rel=1e-9)
        assert result.transmissions == pytest.approx((1 / mu) / (threshold - 1 + 1 / mu))


def test_held_traces_are_the_errors_after_a_state() -> None:
    """Trace of W_i for i = 0 … 4."""
    expected = [sum(np.trace(power @ STABLE.Q @ power.T) for power in powers(i)) for i in range(5)]
    assert np.allclose(held_traces(STABLE, 4), expected)


@pytest.mark.parametrize("weight", [0.5, 0.55, 0.7])
def test_the_metrics_of_a_policy_are_those_of_following_it(weight: float) -> None:
    """Both holding times played for many trials, with the errors that go with them: within 4.5 standard errors."""
    states, trials, slots = 6, 4000, 400
    policy = best_policy(MICROGRID, MU, MU_E, weight, states)
    assert len(set(policy.thresholds)) > 1
    metrics = policy_metrics(MICROGRID, policy.send, MU, MU_E)
    traces = held_traces(MICROGRID, slots + states)
    rng = np.random.default_rng(3)
    i = j = np.full(trials, states)
    sums = np.zeros((3, trials))
    for k in range(slots):
        sent = policy.send[np.minimum(i, states) - 1, np.minimum(j, states) - 1]
        i = np.where(sent & (rng.random(trials) < MU), 1, i + 1)
        j = np.where(sent & (rng.random(trials) < MU_E), 1, j + 1)
        if k >= 100:
            sums += np.stack([traces[i - 1], traces[j - 1], sent])
    means = sums / (slots - 100)
    for mean, expected in zip(means, (metrics.legitimate, metrics.eavesdropper, metrics.transmissions), strict=True):
        assert abs(mean.mean() - expected) <= SIGMAS * mean.std(ddof=1) / math.sqrt(trials)


def test_a_point_of_the_front_is_what_the_scheme_does() -> None:
    """`scheduled` simulated with the best threshold of a point: squared errors and packets within 4.5 standard errors."""
    result = front(STABLE, LinkProbabilities(0.7, 0.5, (0.56, 0.0), (0.28, 0.28)), (0.45, 0.5), (0.0,), 4)
    threshold = result.points[-1].scheduled
    assert threshold > 1
    metrics = result.thresholds[threshold - 1]
    slots, trials, first = 160, 3000, 60
    events = (coins(0.7, slots, trials, 1), coins(0.5, slots, trials, 2), coins(0.8, slots, trials, 3))
    played = played_over("scheduled", STABLE, threshold, events)
    sent = np.stack([np.ones(trials) * np.asarray(packet.sent) for packet in played.packets[first:]])
    errors = {
        name: np.stack(
            [((x - b.x_hat) ** 2).sum(0) for x, b in zip(played.x[first:], played.beliefs[name][first:], strict=True)]
        )
        for name in ("legitimate", "eve")
    }
    for series, expected in (
        (errors["legitimate"], metrics.legitimate),
        (errors["eve"], metrics.eavesdropper),
        (sent, metrics.transmissions),
    ):
        means = series.mean(axis=0)
        assert abs(means.mean() - expected) <= SIGMAS * means.std(ddof=1) / math.sqrt(trials)


def test_the_front_is_a_front() -> None:
    """Along the weights the legitimate error falls; no point dominates another; weights with the same policy are one point."""
    weights = [i / 10 for i in range(11)]
    result = front(MICROGRID, links_of(MU, MU_E), weights, (0.0, 1e-6), 6)
    for price in (0.0, 1e-6):
        ours = [point for point in result.points if point.price == price]
        assert [point.weights for point in ours] == sorted(point.weights for point in ours)
        legitimate = [point.metrics.legitimate for point in ours]
        eavesdroppers = [point.metrics.eavesdropper for point in ours]
        assert legitimate == sorted(legitimate, reverse=True)
        assert eavesdroppers == sorted(eavesdroppers, reverse=True)
        asked = {weight for weight, priced in result.never if priced == price}
        asked |= {w for point in ours for w in weights if point.weights[0] <= w <= point.weights[1]}
        assert result.dominated or asked == set(weights)
    for mine, other in itertools.permutations(result.points, 2):
        assert not mine.metrics.dominates(other.metrics)
    assert len(result.thresholds) == 6
    assert result.points[-1].weights[1] == 1.0


def test_a_dominated_policy_is_left_out() -> None:
    """Against an eavesdropper whose error is unbounded, the policy with the least error of the estimator dominates others."""
    result = front(UNSTABLE, links_of(0.9, 0.5), [i / 20 for i in range(21)], (0.0, 1e-3), 4)
    assert result.dominated == 1
    assert all(math.isinf(point.metrics.eavesdropper) for point in result.points if point.weights[1] < 0.8)
    assert result.as_dict()["dominated"] == 1


def test_knowing_the_eavesdropper_helps() -> None:
    """At each weight the best policy costs no more than `scheduled` with any threshold, and sometimes less."""
    gains = []
    for weight in (0.5, 0.55, 0.6, 0.7, 0.8):
        result = front(STABLE, links_of(0.9, 0.9), (weight,), (0.0,), 8)
        (point,) = result.points
        best = result.thresholds[point.scheduled - 1].cost(weight, 0.0)
        assert best == min(threshold.cost(weight, 0.0) for threshold in result.thresholds)
        gains.append(best - point.metrics.cost(weight, 0.0))
    assert min(gains) >= -1e-9
    assert max(gains) > 1e-4


@pytest.mark.parametrize("process", [STABLE, DRIFTING, UNSTABLE], ids=["stable", "drifting", "unstable"])
def test_where_silence_is_as_good_as_a_packet_it_is_silent(process: Process) -> None:
    """An eavesdropper that hears nothing, and an error that does not count: both choices cost the same, but for rounding."""
    assert not best_policy(process, 0.3, 0.0, 0.0, 9).send.any()


@pytest.mark.parametrize("price", [0.0, 5e-3])
def test_the_least_weight_separates_silence_from_sending(price: float) -> None:
    """Below it the best policy never sends, from it on it does."""
    least = least_weight(STABLE, MU, MU_E, price, 8)
    assert least is not None
    assert not best_policy(STABLE, MU, MU_E, least - 2e-4, 8, price).ever_sends
    assert best_policy(STABLE, MU, MU_E, least, 8, price).ever_sends


def test_there_may_be_no_weight_at_which_it_sends() -> None:
    """A transmission may cost more than it is worth."""
    assert least_weight(STABLE, MU, MU_E, 10.0, 8) is None


def test_costs_of_unbounded_errors() -> None:
    """An unbounded error of the estimator costs infinitely much, one of the eavesdropper alone is worth infinitely much."""
    plain, good = PolicyMetrics(1.0, 3.0, 0.5), PolicyMetrics(1.0, math.inf, 0.5)
    bad = PolicyMetrics(math.inf, math.inf, 0.1)
    assert plain.cost(0.25, 2.0) == pytest.approx(0.25 - 2.25 + 1.0)
    assert (good.cost(0.5, 0.0), good.cost(1.0, 0.0)) == (-math.inf, 1.0)
    assert (bad.cost(0.5, 0.0), bad.cost(0.0, 0.0)) == (math.inf, -math.inf)
    assert good.dominates(plain)
    assert not plain.dominates(good)
    assert not plain.dominates(plain)
    assert bad.as_dict() == {"legitimate": None, "eavesdropper": None, "transmissions": 0.1}
