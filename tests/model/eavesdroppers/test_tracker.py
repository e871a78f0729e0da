"""The tracker: half-way between twin tracks until a state is betrayed to it, on the right one from then on."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
import pytest

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper, Knowledge
from evedrop.model.eavesdroppers.tracker import CAPACITY, Tracker
from evedrop.model.process import Process, Trajectory
from evedrop.model.receiver import Action, Belief, Reception
from evedrop.model.schemes.twin_track import TwinTrack, TwinTracks
from evedrop.model.streams import Batch, stream_key
from evedrop.model.theory.closed_forms import twin_track_bound
from tests.builders import DRIFTING, UNSTABLE
from tests.examples import mostly_long
from tests.model.slot_loop import ROOT, STABLE, coins, keys_of

KEYS = keys_of(("start", "track"))
CLOSE = Process(UNSTABLE.A, UNSTABLE.Q, UNSTABLE.Q)
"""TwinTracks that begin no further apart than a slot's noise."""
RESTLESS = Process(np.eye(2), np.eye(2), np.eye(2))
"""TwinTracks that stay so."""


class Slot(NamedTuple):
    """What happens in a slot, for R trials."""

    k: int
    x: np.ndarray
    z: np.ndarray
    gamma: np.ndarray


def slots(process: Process, batch: Batch, gamma: np.ndarray) -> Iterator[Slot]:
    """All slots of twin tracks; gamma (slots, R)."""
    scheme = TwinTrack(process)
    trajectory = Trajectory(process, stream_key(ROOT, "process"), batch, scheme.initial_state(KEYS, batch))
    encoder = scheme.encoder(KEYS, batch)
    for k in range(batch.slots):
        x = trajectory.advance().copy()
        z = encoder.encode(k, x, trajectory.predicted).z
        yield Slot(k, x, np.where(gamma[k], z, np.nan), gamma[k])


def spy(process: Process, batch: Batch, learns_at: int) -> Eavesdropper:
    """The replay-informed one that reads as the tracker."""
    parameters = {"reads_as": "tracker", "learns_at": learns_at}
    return STRATEGIES["replay-informed"](Knowledge(process, 1.0, parameters, {}), batch)


def reported(process: Process, batch: Batch, gamma: np.ndarray, learns_at: int) -> list[tuple[Slot, Belief]]:
    """Every slot with the spy's belief after it."""
    eavesdropper, rows = spy(process, batch, learns_at), []
    belief = eavesdropper.prior()
    for slot in slots(process, batch, gamma):
        truth = slot.x if slot.k == learns_at else None
        belief = eavesdropper.step(slot.k, belief, Reception(slot.gamma, slot.z, truth=truth))
        rows.append((slot, belief))
    return rows


def errors(pairs: list[tuple[Slot, Belief]]) -> np.ndarray:
    """|x − x̂|², (slots, R)."""
    return np.array([((slot.x - belief.x_hat) ** 2).sum(axis=0) for slot, belief in pairs])


class Words:
    """The exact posterior of one trial by enumeration of all coins, with dense matrices of all starts and noises."""

    def __init__(self, process: Process, count: int) -> None:
        n = process.n
        blocks = [process.initial_covariance] * 2 + [process.Q] * (count - 1)
        self.prior = np.zeros((n * len(blocks), n * len(blocks)))
        for i, block in enumerate(blocks):
            self.prior[n * i : n * (i + 1), n * i : n * (i + 1)] = block
        self.tracks = np.zeros((2, count, n, len(self.prior)))
        for track in range(2):
            row = self.tracks[track, 0]
            row[:, n * track : n * (track + 1)] = np.eye(n)
            for k in range(1, count):
                row = process.A @ row
                row[:, n * (k + 1) : n * (k + 2)] = np.eye(n)
                self.tracks[track, k] = row

    def posterior(
        self, k: int, heard: dict[int, np.ndarray], leak: tuple[int, np.ndarray] | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of x_k from the packets heard, slot → z, and a betrayed state."""
        weights, means, covariances = [], [], []
        for word in product((0, 1), repeat=len(heard)):
            rows = [self.tracks[coin, slot] for coin, slot in zip(word, heard, strict=True)]
            values = list(heard.values())
            if leak is not None:
                if leak[0] not in heard:
                    rows, values = [*rows, self.tracks[0, leak[0]]], [*values, leak[1]]
                elif np.array_equal(heard[leak[0]], leak[1]) == bool(word[list(heard).index(leak[0])]):
                    continue
                elif not np.array_equal(heard[leak[0]], leak[1]):
                    rows, values = [*rows, self.tracks[0, leak[0]]], [*values, leak[1]]
            at = self.tracks[0, k]
            if not rows:
                return np.zeros(len(at)), at @ self.prior @ at.T
            H, z = np.concatenate(rows), np.concatenate(values)
            S = H @ self.prior @ H.T
            gain = np.linalg.solve(S, H @ self.prior @ at.T).T
            means.append(gain @ z)
            covariances.append(at @ self.prior @ at.T - gain @ H @ self.prior @ at.T)
            weights.append(-0.5 * (z @ np.linalg.solve(S, z) + np.linalg.slogdet(S)[1]))
        weight = np.exp(np.array(weights) - max(weights))
        weight /= weight.sum()
        mean = sum(w * m for w, m in zip(weight, means, strict=True))
        away = [m - mean for m in means]
        return mean, sum(w * (P + np.outer(d, d)) for w, P, d in zip(weight, covariances, away, strict=True))


@pytest.mark.parametrize("learns_at", [0, 3])
@pytest.mark.parametrize("process", [CLOSE, RESTLESS, STABLE], ids=["close", "restless", "stable"])
def test_it_is_the_exact_posterior(process: Process, learns_at: int) -> None:
    """Against all words of coins over six slots, with losses, and a state betrayed in one, with a packet or without."""
    words, gamma = Words(process, 6), coins(0.7, 6, 40)
    scale = float(np.sqrt(np.trace(process.initial_covariance + process.Q)))
    heard: list[dict[int, np.ndarray]] = [{} for _ in range(40)]
    states: dict[int, np.ndarray] = {}
    for slot, belief in reported(process, Batch(6, 40), gamma, learns_at):
        states[slot.k] = slot.x
        for r in range(40):
            if slot.gamma[r]:
                heard[r][slot.k] = slot.z[:, r]
            leak = (learns_at, states[learns_at][:, r]) if slot.k >= learns_at else None
            mean, P = words.posterior(slot.k, heard[r], leak)
            assert np.allclose(belief.x_hat[:, r], mean, rtol=1e-7, atol=1e-7 * scale)
            assert np.allclose(belief.P[:, :, r], P, rtol=1e-6, atol=1e-7 * scale**2)
    assert len(states) == 6


@pytest.mark.parametrize("lossless", mostly_long([True, False], [True]))
@pytest.mark.parametrize("process", [CLOSE, RESTLESS, STABLE], ids=["close", "restless", "stable"])
def test_its_room_is_enough_for_as_many_packets_as_the_documents_say(process: Process, lossless: bool) -> None:
    """Exact up to the fifth packet by default, and up to the sixth with room for 16; beyond that 2 % off at most.

    40 trials without a leak; distances from the exact mean are fractions of the start's size.
    """
    gamma, words = np.ones((6, 40), bool) if lossless else coins(0.7, 6, 40), Words(process, 6)
    scale = float(np.sqrt(np.trace(process.initial_covariance + process.Q)))
    capacities = CAPACITY, 16
    trackers = [Tracker(Knowledge(process, 1.0, {}, {}), Batch(6, 40), capacity) for capacity in capacities]
    beliefs, heard = [tracker.prior() for tracker in trackers], [dict[int, np.ndarray]() for _ in range(40)]
    differences = np.zeros((len(capacities), *gamma.shape))
    for slot in slots(process, Batch(6, 40), gamma):
        reception = Reception(slot.gamma, slot.z)
        beliefs = [tracker.step(slot.k, belief, reception) for tracker, belief in zip(trackers, beliefs, strict=True)]
        for r in range(40):
            if slot.gamma[r]:
                heard[r][slot.k] = slot.z[:, r]
            mean = words.posterior(slot.k, heard[r], None)[0]
            differences[:, slot.k, r] = [np.abs(belief.x_hat[:, r] - mean).max() / scale for belief in beliefs]
    usual, roomy = differences
    packets = gamma.cumsum(axis=0)
    assert usual[packets <= 5].max() < 1e-7
    assert usual.max() < 0.02
    if lossless:
        assert usual[packets == 6].max() > 1e-4
    assert roomy.max() < 1e-7


@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING], ids=["unstable", "drifting"])
@pytest.mark.long
def test_before_the_leak_it_is_half_way_between_the_tracks(process: Process) -> None:
    """At least ½ tr A^k Σ0 A^kᵀ in the mean and, as soon as it has heard both tracks, no more; at five standard errors."""
    batch = Batch(15, 4000)
    result, bound = errors(reported(process, batch, coins(0.9, 15, 4000), 14)), twin_track_bound(process, 15)
    mean, error = result.mean(axis=1), result.std(axis=1) / np.sqrt(4000)
    assert np.all(mean[:14] + 5.0 * error[:14] > bound[:14])
    assert np.all(mean[8:14] - 5.0 * error[8:14] < 1.01 * bound[8:14])
    assert not result[14].any()


@pytest.mark.long
def test_one_betrayed_state_breaks_twin_tracks() -> None:
    """With a drifting process its mean error is below 1.5 times the estimator's after the leak, at five standard errors.

    Behind a link as good as the legitimate estimator's; before the leak it is a thousand times as large.
    """
    batch, learns_at = Batch(60, 2000), 20
    gamma = coins(0.9, 60, 2000)
    result = errors(reported(DRIFTING, batch, gamma, learns_at))
    estimator = TwinTrack(DRIFTING).estimator(KEYS, batch)
    followed, belief = [], estimator.prior()
    for slot in slots(DRIFTING, batch, gamma):
        belief = estimator.step(slot.k, belief, Reception(slot.gamma, slot.z))
        followed.append((slot, belief))
    legitimate = errors(followed)
    assert np.all(result[learns_at] == 0.0)
    excess = (result - 1.5 * legitimate)[learns_at + 1 :].mean(axis=0)
    assert excess.mean() + 5.0 * excess.std() / np.sqrt(2000) < 0.0
    assert np.all(result[1:learns_at].mean(axis=1) > 1000.0 * legitimate[1:learns_at].mean(axis=1))


def test_a_leak_beside_the_twins_packet_opens_everything() -> None:
    """Then the distance is known, and its estimate is the estimator's, to rounding, also where the process is unstable.

    Not of the trials whose tracks are close by chance: fewer than 1 % in any slot. Of those that heard no twin in that
    slot, and find it by later packets, 99 % end with an error below 1e-9 of the bound.
    """
    batch, learns_at = Batch(40, 1000), 10
    gamma = coins(0.9, 40, 1000)
    gamma[learns_at] = True
    pairs = reported(UNSTABLE, batch, gamma, learns_at)
    tracks, estimator = TwinTracks(UNSTABLE, KEYS, batch), TwinTrack(UNSTABLE).estimator(KEYS, batch)
    on_twin, legitimate = tracks.on_twin(learns_at), estimator.prior()
    for slot, belief in pairs:
        legitimate = estimator.step(slot.k, legitimate, Reception(slot.gamma, slot.z))
        if slot.k > learns_at:
            scale = float(np.abs(slot.x).max())
            away = np.abs(belief.x_hat - legitimate.x_hat).max(axis=0)
            assert (away[on_twin] < 1e-12 * scale).mean() > 0.99
    late = errors(pairs)[-1] < 1e-9 * twin_track_bound(UNSTABLE, 40)[-1]
    assert late[on_twin].all()
    assert late[~on_twin].mean() > 0.99


@pytest.mark.thorough
def test_what_it_reports_is_true() -> None:
    """Before and after the leak tr P is its squared error in the mean, at five standard errors, where nothing is plain."""
    batch = Batch(30, 3000)
    pairs = reported(RESTLESS, batch, coins(0.8, 30, 3000), 12)
    for slot, (reference, belief) in enumerate(pairs):
        error = ((reference.x - belief.x_hat) ** 2).sum(axis=0) - np.trace(belief.P)
        assert abs(error.mean()) < 5.0 * error.std() / np.sqrt(3000) + 1e-12, slot


def test_it_does_not_say_that_it_knows_before_it_does() -> None:
    """Up to the leak a packet is read for what it tells of both tracks; from then on it is a state."""
    for slot, belief in reported(UNSTABLE, Batch(12, 50), coins(0.8, 12, 50), 6):
        read = Action.INNOVATION if slot.k <= 6 else Action.STATE
        assert np.array_equal(belief.action, np.where(slot.gamma, np.uint8(read), np.uint8(Action.LOST)))


@pytest.mark.parametrize(
    "process",
    [
        pytest.param(UNSTABLE, id="unstable", marks=pytest.mark.long),
        pytest.param(CLOSE, id="close"),
        pytest.param(RESTLESS, id="restless", marks=pytest.mark.long),
    ],
)
def test_a_trial_alone_and_a_shorter_run_are_the_same(process: Process) -> None:
    """The same bits among 300 trials, among 6 and alone, and in a run that ends earlier, also where histories are merged."""
    gamma = coins(0.8, 40, 300)
    among = reported(process, Batch(40, 300), gamma, 9)
    for first, count, length in ((77, 1, 40), (200, 6, 25)):
        part = slice(first, first + count)
        some = reported(process, Batch(length, count, first), gamma[:length, part], 9)
        for (_, own), (_, other) in zip(some, among[:length], strict=True):
            assert own.x_hat.tobytes() == other.x_hat[:, part].tobytes()
            assert own.P.tobytes() == other.P[:, :, part].tobytes()
            assert np.array_equal(own.action, other.action[part])


@pytest.mark.long
def test_more_room_changes_little() -> None:
    """Where the tracks stay within a slot's noise, 16 times the room changes its mean error by less than 2 %."""
    batch, gamma, means = Batch(40, 30), coins(0.9, 40, 30), []
    for capacity in (CAPACITY, 128):
        tracker, total = Tracker(Knowledge(RESTLESS, 1.0, {}, {}), batch, capacity), 0.0
        belief = tracker.prior()
        for slot in slots(RESTLESS, batch, gamma):
            belief = tracker.step(slot.k, belief, Reception(slot.gamma, slot.z))
            if slot.k == 15:
                belief = tracker.knowing(slot.k, slot.x, belief)
            total += float(((slot.x - belief.x_hat) ** 2).sum())
            assert len(belief.memory[0]) <= capacity
        means.append(total)
    assert means[0] == pytest.approx(means[1], rel=0.02)


def test_a_tracker_that_begins_later_has_the_same_prior() -> None:
    """A belief from slot 4 on is that of one that heard nothing before: after the next packets, too."""
    batch, first = Batch(8, 3), 4
    first_tracker, other = (Tracker(Knowledge(UNSTABLE, 1.0, {}, {}), batch) for _ in range(2))
    gamma = np.zeros((8, 3), bool)
    gamma[first:] = [[True, False, True], [True, True, False], [False, True, True], [True, True, True]]
    waiting, late = first_tracker.prior(), other.prior(first)
    for slot in slots(UNSTABLE, batch, gamma):
        heard = Reception(slot.gamma, slot.z)
        waiting = first_tracker.step(slot.k, waiting, heard)
        if slot.k >= first:
            late = other.step(slot.k, late, heard)
            assert np.allclose(late.x_hat, waiting.x_hat, rtol=1e-9)
            assert np.allclose(late.P, waiting.P, rtol=1e-9)
