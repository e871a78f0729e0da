"""Schemes that go by the legitimate estimator's holding time: what they send, what it costs, what an eavesdropper gets."""

from __future__ import annotations

import numpy as np
import pytest

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.number_codes import Mask
from evedrop.model.process import Process
from evedrop.model.receiver import Action
from evedrop.model.schemes import scheme_of
from evedrop.model.schemes.encrypted_schedule import EncryptedSchedule
from evedrop.model.schemes.silent import Scheduled
from evedrop.model.streams import Batch, stream_key
from evedrop.model.theory import closed_forms
from evedrop.model.theory.covariances import limit
from tests.builders import DRIFTING, UNSTABLE
from tests.model.acknowledged_runs import all_events
from tests.model.slot_loop import ROOT, STABLE, Played, coins, play

MU, MU_E, ARRIVES = 0.7, 0.6, 0.8
READERS = {"scheduled": "naive", "encrypted-schedule": "selective"}


def played_over(
    name: str, process: Process, threshold: int, events: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> Played:
    """A scheme with the eavesdropper that reads it best, over given events."""
    gamma, gamma_e, link = events
    batch = Batch(*gamma.shape)
    eve = STRATEGIES[READERS[name]](Knowledge(process, 1.0, {}, {}), batch)
    scheme = scheme_of(process, {"scheme": name, "threshold": threshold})
    links = {"legitimate": gamma, "eve": gamma_e}
    return play(scheme, batch, links, {"eve": eve}, lambda k, _, received: received["legitimate"] & link[k])


def holding_times(played: Played, link: np.ndarray, r: int) -> list[float]:
    """The holding time in every slot of a trial, told from what was received and acknowledged."""
    holding_times, last = [], -np.inf
    for k in range(len(played.x)):
        holding_times.append(k - last)
        if played.received["legitimate"][k][r] and link[k, r]:
            last = k
    return holding_times


@pytest.mark.parametrize("threshold", [1, 2, 4])
def test_packets_go_by_the_holding_time(threshold: int) -> None:
    """Sent, or encrypted, exactly from `threshold` slots after the last acknowledged one; unencrypted it is the state."""
    rng = np.random.default_rng(1)
    events = tuple(rng.random((3, 30, 60)) < 0.7)
    mask = Mask(STABLE, stream_key(ROOT, "mask"), Batch(30, 60))
    silent = played_over("scheduled", STABLE, threshold, events)
    hidden = played_over("encrypted-schedule", STABLE, threshold, events)
    for r in range(60):
        for k, held in enumerate(holding_times(silent, events[2], r)):
            sent = silent.packets[k].sent
            assert sent is not None
            assert sent[r] == (held >= threshold)
        for k, held in enumerate(holding_times(hidden, events[2], r)):
            header = hidden.packets[k].header
            assert header is not None
            assert header[0, r] == (held >= threshold)
    for x, packet, masked in zip(hidden.x, hidden.packets, map(mask.hide, range(30), hidden.x), strict=True):
        assert packet.header is not None
        assert np.array_equal(packet.z, np.where(packet.header[0] == 1, masked, x))
    for x, packet in zip(silent.x, silent.packets, strict=True):
        assert np.array_equal(packet.z, x)


@pytest.mark.parametrize("name", READERS)
def test_what_is_received_in_a_way_one_can_read_is_the_state(name: str) -> None:
    """The legitimate estimator reads every packet, the eavesdropper every unencrypted one; it leaves encrypted ones alone."""
    rng = np.random.default_rng(2)
    events = tuple(rng.random((3, 30, 60)) < 0.7)
    played = played_over(name, UNSTABLE, 3, events)
    for k, packet in enumerate(played.packets):
        encrypted = np.zeros(60, bool) if packet.header is None else packet.header[0] == 1
        for receiver, readable in (("legitimate", np.ones(60, bool)), ("eve", ~encrypted)):
            belief, received = played.beliefs[receiver][k], played.received[receiver][k]
            read = received & readable
            scale = float(np.abs(played.x[k]).max()) + 1.0
            assert np.allclose(belief.x_hat[:, read], played.x[k][:, read], rtol=0, atol=1e-13 * scale)
            assert not belief.P[:, :, read].any()
            unread = np.where(received, Action.DISCARDED, Action.LOST)
            assert np.array_equal(belief.action, np.where(read, Action.STATE, unread))


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING])
@pytest.mark.parametrize("threshold", [1, 2, 3])
def test_expectations_are_the_chains(name: str, process: Process, threshold: int) -> None:
    """E P over every course of five slots, each with its probability, is the chain's, for both receivers, exactly."""
    slots = 5
    gamma, gamma_e, link = all_events(slots)
    weights = np.where(gamma, MU, 1 - MU) * np.where(gamma_e, MU_E, 1 - MU_E) * np.where(link, ARRIVES, 1 - ARRIVES)
    chances = weights.prod(0)
    played = played_over(name, process, threshold, (gamma, gamma_e, link))
    eve = (MU_E, (MU * MU_E * ARRIVES, MU * (1 - MU_E) * ARRIVES))
    form = {"scheduled": closed_forms.scheduled, "encrypted-schedule": closed_forms.encrypted_schedule}[name]
    expected = {"eve": form(threshold, *eve).covariances(process, slots)}
    if name == "scheduled":
        legitimate = closed_forms.scheduled(threshold, MU, (MU * ARRIVES, 0.0))
        expected["legitimate"] = legitimate.covariances(process, slots)
    for receiver, covariances in expected.items():
        for k, belief in enumerate(played.beliefs[receiver]):
            assert np.allclose(belief.P @ chances, covariances[k], rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("threshold", [1, 3, 6])
def test_limits_are_where_the_expectations_go(threshold: int) -> None:
    """The limit is the expectation after many slots; unbounded is inf; a threshold of 1 is the plain scheme."""
    for form in (closed_forms.scheduled, closed_forms.encrypted_schedule):
        chain = form(threshold, 0.9, (0.5, 0.2))
        assert np.allclose((chain.reset + chain.carried).sum(1), 1.0)
        assert np.allclose(chain.stationary @ (chain.reset + chain.carried), chain.stationary)
        result = chain.limit(STABLE)
        assert np.allclose(result, chain.covariances(STABLE, 2000)[-1], rtol=1e-9)
    legitimate = closed_forms.scheduled(threshold, 0.9, (0.9, 0.0))
    assert np.isfinite(legitimate.limit(UNSTABLE)).all()
    if threshold == 1:
        assert np.allclose(legitimate.limit(UNSTABLE), limit(UNSTABLE, EncryptedSchedule(UNSTABLE, 1).outcomes(0.9)))
    assert legitimate.stationary[-1] == pytest.approx((1 / 0.9) / (threshold - 1 + 1 / 0.9))
    hidden = closed_forms.encrypted_schedule(threshold, 0.9, (0.81, 0.09))
    assert hidden.stationary[-1] == pytest.approx(0.1 ** (threshold - 1))


def test_long_silences_keep_an_eavesdropper_out_of_an_unstable_process() -> None:
    """With links as good as each other there is a threshold from which the estimator is bounded and the eavesdropper is not."""
    bounded = []
    for threshold in range(1, 12):
        eve = closed_forms.scheduled(threshold, 0.9, (0.81, 0.09)).limit(UNSTABLE)
        assert np.isfinite(closed_forms.scheduled(threshold, 0.9, (0.9, 0.0)).limit(UNSTABLE)).all()
        bounded.append(bool(np.isfinite(eve).all()))
    assert bounded[0]
    assert not bounded[-1]
    assert bounded == sorted(bounded, reverse=True)


def test_blocked_acknowledgements_mistune_one_and_open_the_other() -> None:
    """Blocked, `scheduled` sends in every slot, unencrypted; `encrypted-schedule` encrypts every packet."""
    gamma = coins(0.8, 20, 100)
    blocked = np.zeros_like(gamma)
    opened = played_over("scheduled", STABLE, 5, (gamma, gamma, blocked))
    assert all(packet.sent is not None and packet.sent.all() for packet in opened.packets)
    shut = played_over("encrypted-schedule", STABLE, 5, (gamma, gamma, blocked))
    assert all((belief.action != Action.STATE).all() for belief in shut.beliefs["eve"])
    assert all(
        np.array_equal(belief.action == Action.STATE, gamma[k]) for k, belief in enumerate(shut.beliefs["legitimate"])
    )


def test_late_acknowledgements_count_for_their_slot() -> None:
    """One of an older slot than the last known changes nothing."""
    encoder = Scheduled(STABLE, 3).encoder({}, Batch(10, 1))
    x, yes = np.ones((2, 1)), np.ones(1, bool)
    encoder.acknowledged(4, yes)
    encoder.acknowledged(2, yes)
    for k, due in ((5, False), (6, False), (7, True)):
        sent = encoder.encode(k, x, x).sent
        assert sent is not None
        assert bool(sent[0]) is due
