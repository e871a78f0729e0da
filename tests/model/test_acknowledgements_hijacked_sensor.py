"""A hijacked sensor: it looks like the honest one, and the eavesdropper that it serves gains."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evedrop.model.acknowledgements import AckChannel, AckChannelSpec, HeedRule, heed_rule_of, rates_of
from evedrop.model.process import Process
from evedrop.model.streams import Batch, stream_key
from evedrop.model.theory.closed_forms import Hears, hijacked_schedule, scheduled
from evedrop.scenario.loading import checked
from evedrop.scenario.theory import expectations_of
from evedrop.score.links import chart_of
from evedrop.simulate.simulation import Simulation
from tests.builders import UNSTABLE, listener, tables_of
from tests.model.slot_loop import ROOT, coins

KEY = stream_key(ROOT, "link/acknowledgements")
MU, MU_E = 0.9, 0.9


def hears(whose: str) -> Hears:
    """The legitimate estimator hears what it hears, and the eavesdropper what that hears."""
    return lambda legitimate, served: float(legitimate if whose == "legitimate" else served)


def limits(alpha: float, attack: str, threshold: int = 4) -> dict[str, float]:
    """The traces of legitimate estimator's and eavesdropper's limit under `scheduled`."""
    rates, heed_rule = rates_of(attack, MU, MU_E, alpha), heed_rule_of(attack, alpha, MU_E)
    limits = {}
    for whose, split in (("legitimate", rates.legitimate), ("eve", rates.eavesdropper)):
        chain = scheduled(threshold, 0.9, split)
        if heed_rule is not None:
            chain = hijacked_schedule(threshold, MU, MU_E, heed_rule, hears(whose))
        limits[whose] = float(np.trace(chain.limit(UNSTABLE)))
    return limits


@given(alpha=st.floats(0.0, 1.0), overheard=st.one_of(st.just(0.0), st.floats(0.01, 1.0)))
def test_as_many_are_heeded_as_before(alpha: float, overheard: float) -> None:
    """Of all packets, those after n misses in a row being (1−μ_e)^n μ_e of them: α, and never more after more misses."""
    heed_rule = HeedRule.of(alpha, overheard)
    if heed_rule is None:
        assert alpha == 1.0 or overheard == 0.0
        return
    fractions = [heed_rule.fraction_of(missed) for missed in (0, heed_rule.patience, heed_rule.patience + 1)]
    assert fractions == sorted(fractions, reverse=True)
    assert 0.0 <= heed_rule.fraction <= 1.0
    assert fractions[2] == 0.0
    left = (1.0 - overheard) ** heed_rule.patience
    if left > 1e-9:
        assert 1.0 - left + heed_rule.fraction * overheard * left == pytest.approx(alpha, abs=1e-9)


def test_what_it_heeds_of_some_links() -> None:
    """α ≤ μ_e: a fraction of what was heard. Else all after few misses; with a deaf eavesdropper or without losses, no choice."""
    cases = {(0.6, 0.9): (0, 0.6 / 0.9), (0.6, 1.0): (0, 0.6), (0.95, 0.9): (1, 0.05 / 0.09), (0.9, 0.5): (3, 0.4)}
    for (alpha, overheard), (patience, fraction) in cases.items():
        heed_rule = HeedRule.of(alpha, overheard)
        assert heed_rule is not None
        assert heed_rule.patience == patience
        assert heed_rule.fraction == pytest.approx(fraction)
    assert HeedRule.of(0.0, 0.5) == HeedRule(0, 0.0)
    assert HeedRule.of(1.0, 0.5) is HeedRule.of(0.5, 0.0) is None
    assert heed_rule_of("critical", 0.5, 0.5) is None


@given(mu=st.floats(0.0, 1.0), mu_e=st.floats(0.01, 1.0), alpha=st.floats(0.0, 1.0))
def test_the_rates_are_those_of_the_honest_sensor(mu: float, mu_e: float, alpha: float) -> None:
    """With γ and without; and no more packets are critical."""
    honest, hijacked = (rates_of(attack, mu, mu_e, alpha) for attack in ("none", "hijack"))
    assert hijacked.arrives == pytest.approx(honest.arrives, abs=1e-9)
    assert hijacked.legitimate == pytest.approx(honest.legitimate, abs=1e-9)
    assert hijacked.eavesdropper[1] <= honest.eavesdropper[1] + 1e-9


@pytest.mark.parametrize(("alpha", "overheard"), [(0.9, 0.5), (0.5, 0.7)])
def test_acknowledgements_are_heeded_by_misses(alpha: float, overheard: float) -> None:
    """Trial by trial: after few misses all, after many none; silent slots do not count, and asking twice counts once."""
    gamma, gamma_e, sent = (coins(quality, 60, 300, seed) for seed, quality in ((1, 0.8), (2, overheard), (3, 0.6)))
    channel, heed_rule = (
        AckChannel(AckChannelSpec(alpha, "hijack", None, None, 0.0, overheard), KEY, Batch(60, 300)),
        HeedRule.of(alpha, overheard),
    )
    assert heed_rule is not None
    missed, at_fraction = np.zeros(300, int), []
    for k in range(60):
        arrived = channel.arrived(k, sent[k], gamma[k] & sent[k], gamma_e[k] & sent[k])
        assert np.array_equal(arrived, channel.arrived(k, sent[k], gamma[k] & sent[k], gamma_e[k] & sent[k]))
        missed = np.where(sent[k], np.where(gamma_e[k], 0, missed + 1), missed)
        due = gamma[k] & sent[k]
        assert arrived[due & (missed < heed_rule.patience)].all()
        assert not arrived[~due | (missed > heed_rule.patience)].any()
        at_fraction += arrived[due & (missed == heed_rule.patience)].tolist()
    assert abs(np.mean(at_fraction) - heed_rule.fraction) < 5.0 * np.sqrt(0.25 / len(at_fraction))


def test_without_lost_acknowledgements_it_is_the_honest_sensor() -> None:
    """To the bit, whatever the jammer hears; and outside of the attack's slots in any case."""
    gamma, gamma_e = coins(0.8, 30, 200, 1), coins(0.6, 30, 200, 2)
    for alpha, spans in ((1.0, None), (0.7, [(0, 10)])):
        honest = AckChannel(AckChannelSpec(alpha, "none", None, None), KEY, Batch(30, 200))
        hijacked = AckChannel(AckChannelSpec(alpha, "hijack", None, spans, 0.0, 0.6), KEY, Batch(30, 200))
        same = [
            np.array_equal(
                honest.arrived(k, None, gamma[k], gamma_e[k]), hijacked.arrived(k, None, gamma[k], gamma_e[k])
            )
            for k in range(30)
        ]
        assert all(same if spans is None else same[10:])
        assert all(same[:10]) is (spans is None)


@pytest.mark.parametrize(
    ("threshold", "alpha", "honest", "hijacked"),
    [
        (4, 1.0, math.inf, math.inf),
        (4, 0.999, math.inf, 0.01386),
        (4, 0.99, math.inf, 0.008233),
        (4, 0.95, math.inf, 0.006399),
        (4, 0.9, math.inf, 0.003943),
        (4, 0.6, 0.01817, 0.003470),
        (6, 0.99, math.inf, 0.05682),
    ],
)
def test_perfect_secrecy_needs_an_acknowledgement_channel_that_loses_nothing(
    threshold: int, alpha: float, honest: float, hijacked: float
) -> None:
    """Of `scheduled`: the table of docs/schemes/with-acknowledgements.md. The legitimate error and the rate of packets stay."""
    before, after = limits(alpha, "none", threshold), limits(alpha, "hijack", threshold)
    assert after["legitimate"] == pytest.approx(before["legitimate"])
    assert before["eve"] == pytest.approx(honest, rel=1e-3)
    assert after["eve"] == pytest.approx(hijacked, rel=1e-3)
    if alpha <= MU_E:
        assert after["eve"] == pytest.approx(after["legitimate"])
    heed_rule = HeedRule.of(alpha, MU_E)
    if heed_rule is not None:
        chain = hijacked_schedule(threshold, MU, MU_E, heed_rule, hears("legitimate"))
        assert np.allclose((chain.reset + chain.carried).sum(axis=1), 1.0)
        in_last = chain.stationary[(threshold - 1) * (heed_rule.patience + 2) :].sum()
        assert in_last == pytest.approx(1.0 / (MU * alpha) / (threshold - 1 + 1.0 / (MU * alpha)))


def test_where_few_are_lost_only_the_schedule_has_a_closed_form() -> None:
    """Of α > μ_e: for other schemes the sensor's memory is in no theory; nor is a chain that is too long."""
    tables = attacked("hijack")
    theoretical = {name: expectation.known for name, expectation in expectations_of(checked(tables, "it")).items()}
    assert theoretical == {"legitimate": True, "eve": True}
    tables["encoding"] = {"scheme": "scheduled", "threshold": 60}
    assert not expectations_of(checked(tables, "it"))["eve"].known
    tables["encoding"] = {"scheme": "encrypted-schedule", "threshold": 2}
    tables["eavesdroppers"]["eve"]["strategy"] = "selective"
    assert not expectations_of(checked(tables, "it"))["eve"].known
    tables["acknowledgements"]["link"]["quality"] = 0.7
    assert expectations_of(checked(tables, "it"))["eve"].known


def attacked(attack: str) -> dict[str, Any]:
    """`scheduled` on a stable process, whose means are estimated well."""
    jammer = {"jammer": "eve"} if attack == "hijack" else {}
    return tables_of(
        Process(np.array([[0.95, 0.3], [0.0, 0.9]]), 1e-3 * np.eye(2), 1e-3 * np.eye(2)),
        slots=100,
        trials=400,
        encoding={"scheme": "scheduled", "threshold": 4},
        legitimate={"link": {"quality": 0.8}},
        eavesdroppers={"eve": listener("naive", 0.7)},
        acknowledgements={"link": {"quality": 0.75}, "attack": attack, **jammer},
    )


def test_it_sends_as_often_and_the_eavesdropper_gains() -> None:
    """In 400 trials of 100 slots: equal rates and legitimate errors within five standard errors, an error below by more."""
    sent, errors = {}, {}
    for attack in ("none", "hijack"):
        scenario = checked(attacked(attack), attack)
        simulation = Simulation(scenario, range(400))
        chunks = list(simulation.chunks())
        sent[attack] = simulation.packets.sent / 100.0
        for name in ("legitimate", "eve"):
            mean_error = np.concatenate([chunk.receivers[name].error for chunk in chunks]).mean(axis=0)
            expected = expectations_of(scenario)[name].traces(100).mean()
            assert abs(mean_error.mean() - expected) < 5.0 * mean_error.std() / 20.0
            errors[attack, name] = mean_error
        assert (chart_of(scenario) is None) is (attack == "hijack")

    def apart(errors: np.ndarray, other: np.ndarray) -> float:
        return float((errors.mean() - other.mean()) / np.hypot(errors.std() / 20.0, other.std() / 20.0))

    assert abs(apart(sent["none"], sent["hijack"])) < 5.0
    assert abs(apart(errors["none", "legitimate"], errors["hijack", "legitimate"])) < 5.0
    assert apart(errors["none", "eve"], errors["hijack", "eve"]) > 5.0
