"""A hijacked sensor: nobody can tell it from the honest one, and the eavesdropper that it serves gains."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evedrop.expected.expectations import expectations_of
from evedrop.loading import checked
from evedrop.memory.simulation import Simulation
from evedrop.model.acknowledgements import ATTACKS, AckChannel, heeded_shares, rates_of
from evedrop.model.theory.closed_forms import scheduled
from evedrop.score.acknowledging import chart_of
from evedrop.streams import Batch, stream_key
from tests.builders import UNSTABLE
from tests.model.slot_loop import ROOT, coins

KEY = stream_key(ROOT, "link/acknowledgements")
MU, MU_E, THETA = 0.9, 0.9, 4

shares = st.floats(0.0, 1.0)


def limits(alpha: float, attack: str) -> tuple[float, float]:
    """The traces of user's and eavesdropper's limit under `scheduled`."""
    rates = rates_of(attack, MU, MU_E, alpha)
    user, eve = (scheduled(THETA, 0.9, split).limit(UNSTABLE) for split in (rates.user, rates.eavesdropper))
    return float(np.trace(user)), float(np.trace(eve))


@given(alpha=shares, overheard=shares)
def test_as_many_are_heeded_as_before(alpha: float, overheard: float) -> None:
    """Both are shares, they add up to α, and of packets that the jammer missed as few are heeded as that allows."""
    heard, missed = heeded_shares("hijack", alpha, overheard)
    assert 0.0 <= missed <= 1.0
    assert 0.0 <= heard <= 1.0
    if overheard > 0.0:
        assert overheard * heard + (1.0 - overheard) * missed == pytest.approx(alpha, abs=1e-12)
    assert missed == 0.0 or heard == 1.0
    for attack in set(ATTACKS) - {"hijack"}:
        assert heeded_shares(attack, alpha, overheard) == (alpha, alpha)


@given(mu=shares, mu_e=st.floats(0.01, 1.0), alpha=shares)
def test_the_user_sees_the_law_of_the_honest_sensor(mu: float, mu_e: float, alpha: float) -> None:
    """The rates of acknowledgements with γ and without are the same, so the law of what is sent next is, too."""
    honest, hijacked = (rates_of(attack, mu, mu_e, alpha) for attack in ("none", "hijack"))
    assert hijacked.arrives == pytest.approx(honest.arrives, abs=1e-12)
    assert hijacked.user == pytest.approx(honest.user, abs=1e-12)
    assert hijacked.eavesdropper[1] <= honest.eavesdropper[1] + 1e-12


def test_without_lost_acknowledgements_it_is_the_honest_sensor() -> None:
    """To the bit, whatever the jammer hears; and outside of the attack's slots in any case."""
    gamma, gamma_e = coins(0.8, 30, 200, 1), coins(0.6, 30, 200, 2)
    for alpha, spans in ((1.0, None), (0.7, [(0, 10)])):
        honest = AckChannel("none", alpha, KEY, Batch(30, 200))
        hijacked = AckChannel("hijack", alpha, KEY, Batch(30, 200), spans, overheard=0.6)
        same = [
            np.array_equal(
                honest.arrived(k, None, gamma[k], gamma_e[k]), hijacked.arrived(k, None, gamma[k], gamma_e[k])
            )
            for k in range(30)
        ]
        assert all(same if spans is None else same[10:])
        assert all(same[:10]) is (spans is None)


@pytest.mark.parametrize(
    ("alpha", "honest", "hijacked"),
    [(1.0, math.inf, math.inf), (0.95, math.inf, 0.01232), (0.9, math.inf, 0.003943), (0.6, 0.01817, 0.003470)],
)
def test_perfect_secrecy_needs_a_way_back_that_loses_nothing(alpha: float, honest: float, hijacked: float) -> None:
    """Of `scheduled`: the table of docs/schemes.md. The user's error stays what it was."""
    (user, eve), (same, gained) = limits(alpha, "none"), limits(alpha, "hijack")
    assert same == pytest.approx(user)
    assert eve == pytest.approx(honest, rel=1e-3)
    assert gained == pytest.approx(hijacked, rel=1e-3)
    if alpha <= MU_E:
        assert gained == pytest.approx(user)


def scenario_of(attack: str) -> dict[str, Any]:
    """`scheduled` on a stable process, whose means are estimated well."""
    jammer = {"jammer": "eve"} if attack == "hijack" else {}
    return {
        "title": attack,
        "slots": 100,
        "trials": 400,
        "process": {
            "A": [[0.95, 0.3], [0.0, 0.9]],
            "Q": [[1e-3, 0.0], [0.0, 1e-3]],
            "initial_covariance": [[1e-3, 0.0], [0.0, 1e-3]],
        },
        "encoding": {"scheme": "scheduled", "threshold": 4},
        "legitimate": {"link": {"quality": 0.8}},
        "eavesdroppers": {"eve": {"strategy": "naive", "link": {"quality": 0.7}}},
        "acknowledgements": {"link": {"quality": 0.75}, "attack": attack, **jammer},
    }


def test_it_sends_as_often_and_the_eavesdropper_gains() -> None:
    """In 400 trials of 100 slots: equal rates and user's errors within five standard errors, an error below by more."""
    sent, errors = {}, {}
    for attack in ("none", "hijack"):
        scenario = checked(scenario_of(attack), attack)
        simulation = Simulation(scenario, range(400))
        chunks = list(simulation.chunks())
        sent[attack] = simulation.packets.sent / 100.0
        for name in ("legitimate", "eve"):
            one = np.concatenate([chunk.receivers[name].error for chunk in chunks]).mean(axis=0)
            expected = expectations_of(scenario)[name].traces(100).mean()
            assert abs(one.mean() - expected) < 5.0 * one.std() / 20.0
            errors[attack, name] = one
        assert (chart_of(scenario) is None) is (attack == "hijack")

    def apart(one: np.ndarray, other: np.ndarray) -> float:
        return float((one.mean() - other.mean()) / np.hypot(one.std() / 20.0, other.std() / 20.0))

    assert abs(apart(sent["none"], sent["hijack"])) < 5.0
    assert abs(apart(errors["none", "legitimate"], errors["hijack", "legitimate"])) < 5.0
    assert apart(errors["none", "eve"], errors["hijack", "eve"]) > 5.0
