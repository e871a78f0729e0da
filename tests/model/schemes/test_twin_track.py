"""Twin track: which of two tracks is the process's own, only the secret tells."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from evedrop.model.eavesdroppers import READERS
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.process import Floats, Process
from evedrop.model.schemes.twin_track import TwinTrack, TwinTracks
from evedrop.model.streams import Batch
from evedrop.model.theory.closed_forms import twin_track_bound
from evedrop.model.theory.covariances import theoretical_covariances
from tests.builders import DRIFTING, UNSTABLE
from tests.model.slot_loop import STABLE, coins, keys_of, play

KEYS = keys_of(("start", "track"))


def spread(process: Process, k: int) -> Floats:
    """A^k Σ0 A^kᵀ."""
    power: Floats = np.linalg.matrix_power(process.A, k)
    return power @ process.initial_covariance @ power.T


@pytest.mark.parametrize("process", [STABLE, UNSTABLE])
def test_packets_are_on_one_track_or_the_other(process: Process) -> None:
    """z_k is x_k or x_k + A^k (y_0 − x_0), by a fair coin from slot 0 on; the twin's distance has covariance 2 A^k Σ0 A^kᵀ."""
    slots, trials = 20, 5000
    batch = Batch(slots, trials)
    played = play(TwinTrack(process), batch, {"legitimate": np.ones((slots, trials), bool)})
    tracks = TwinTracks(process, KEYS, batch)
    assert np.array_equal(played.x[0], tracks.initial)
    apart = played.packets[0].z - played.x[0]
    twins = 0
    start = np.where(tracks.on_twin(0), apart, tracks.distance(0))
    for k, (x, packet) in enumerate(zip(played.x, played.packets, strict=True)):
        twin = tracks.on_twin(k)
        twins += int(twin.sum())
        distance = np.linalg.matrix_power(process.A, k) @ start
        scale = float(np.abs(x).max() + np.abs(distance).max())
        assert np.allclose(packet.z, np.where(twin, x + distance, x), rtol=0, atol=1e-12 * scale)
    assert stats.binomtest(twins, slots * trials).pvalue > 1e-6
    white = np.linalg.solve(np.linalg.cholesky(2.0 * process.initial_covariance), tracks.distance(0))
    assert 1e-6 < stats.chi2.cdf((white * white).sum(), white.size) < 1.0 - 1e-6
    for i in range(2):
        for j in range(2):
            ours = np.linalg.solve(np.linalg.cholesky(process.initial_covariance), tracks.initial)
            theirs = ours + np.sqrt(2.0) * white
            assert abs(np.mean(ours[i] * theirs[j])) < 6.0 / np.sqrt(trials)


def test_errors_are_the_closed_form() -> None:
    """Legitimate mean squared error and mean P: (1−μ) Σ_{j<k} (1−μ)^j A^j Q A^jᵀ, at 5 standard errors, exactly 0 at k = 0."""
    slots, trials, mu = 20, 20_000, 0.7
    played = play(TwinTrack(DRIFTING), Batch(slots, trials), {"legitimate": coins(mu, slots, trials)})
    powers = [np.linalg.matrix_power(DRIFTING.A, j) for j in range(slots)]
    terms = [(1.0 - mu) ** (j + 1) * np.trace(power @ DRIFTING.Q @ power.T) for j, power in enumerate(powers)]
    expected = np.array([sum(terms[:k]) for k in range(slots)])
    theory = theoretical_covariances(DRIFTING, TwinTrack(DRIFTING).outcomes(mu), slots)
    assert np.allclose(np.trace(theory, axis1=1, axis2=2), expected, rtol=1e-12)
    for errors in (played.squared_error("legitimate"), played.trace("legitimate")):
        assert (np.abs(errors.mean(1) - expected) <= 5.0 * errors.std(1) / np.sqrt(trials) + 1e-25).all()


@pytest.mark.parametrize("process", [pytest.param(STABLE, marks=pytest.mark.long), UNSTABLE])
@pytest.mark.parametrize("quality", [1.0, 0.8])
def test_no_strategy_is_below_the_bound(process: Process, quality: float) -> None:
    """Every strategy but the slow learners, even with a schedule's key, has a mean squared error of at least ½ tr A^k Σ0 A^kᵀ."""
    slots, trials = 15, 4000
    batch = Batch(slots, trials)
    eavesdroppers = {
        name: strategy(
            Knowledge(process, 1.0, dict.fromkeys(strategy.parameters, 0.5), keys_of(strategy.streams({}))),
            batch,
        )
        for name, strategy in READERS.items()
        if not strategy.costly
    }
    gamma = {
        "legitimate": coins(0.7, slots, trials),
        **{name: coins(quality, slots, trials, 3) for name in eavesdroppers},
    }
    played = play(TwinTrack(process), batch, gamma, eavesdroppers)
    bound = twin_track_bound(process, slots)
    assert np.allclose(bound, [0.5 * np.trace(spread(process, k)) for k in range(slots)], rtol=1e-12)
    for name in eavesdroppers:
        squared_error = played.squared_error(name)
        assert (squared_error.mean(1) + 5.0 * squared_error.std(1) / np.sqrt(trials) > bound).all()
        if name == "naive" and quality == 1.0:
            assert (np.abs(squared_error.mean(1) - 2.0 * bound) < 5.0 * squared_error.std(1) / np.sqrt(trials)).all()


def test_exchanging_the_tracks_changes_no_packet() -> None:
    """The argument of the bound: from y_0, with all coins turned over and the same noise, the packets are the same."""
    rng = np.random.default_rng(3)
    x_0, y_0 = rng.standard_normal((2, 2))
    w, coin = rng.standard_normal((12, 2)), rng.random(12) < 0.5

    def packets(start: np.ndarray, other: np.ndarray, on_twin: np.ndarray) -> list[np.ndarray]:
        sent, x, apart = [], start, other - start
        for k in range(12):
            if k:
                x, apart = UNSTABLE.A @ x + w[k], UNSTABLE.A @ apart
            sent.append(x + apart if on_twin[k] else x)
        return sent

    assert np.allclose(packets(x_0, y_0, coin), packets(y_0, x_0, ~coin), rtol=1e-9)


def test_the_bound_is_met_by_who_sees_both_tracks() -> None:
    """Half-way between the tracks the mean squared error is the bound itself: there is no better one."""
    slots, trials = 10, 20_000
    batch = Batch(slots, trials)
    tracks = TwinTracks(UNSTABLE, KEYS, batch)
    bound = twin_track_bound(UNSTABLE, slots)
    for k in range(slots):
        error = ((tracks.distance(k) / 2.0) ** 2).sum(0)
        assert abs(error.mean() - bound[k]) < 5.0 * error.std() / np.sqrt(trials)


def test_one_state_that_leaks_breaks_it() -> None:
    """An eavesdropper that learns a single x_k tells the tracks apart in that slot, and by their distance in every other."""
    batch = Batch(10, 500)
    played = play(TwinTrack(UNSTABLE), batch, {"legitimate": np.ones((10, 500), bool)})
    on_twin = TwinTracks(UNSTABLE, KEYS, batch).on_twin(4)
    guessed = ((played.packets[4].z - played.x[4]) ** 2).sum(0) > 1e-12
    assert np.array_equal(guessed, on_twin)
    back = np.linalg.matrix_power(np.linalg.inv(UNSTABLE.A), 4) @ (played.packets[4].z - played.x[4])
    assert np.allclose(back[:, guessed], TwinTracks(UNSTABLE, KEYS, batch).distance(0)[:, guessed], atol=1e-6)


def test_slots_may_be_asked_for_in_any_order() -> None:
    """Distance and coin are those of tracks that were asked in order."""
    batch = Batch(30, 4)
    tracks, ordered = (TwinTracks(UNSTABLE, KEYS, batch) for _ in range(2))
    expected = [(ordered.distance(k).copy(), ordered.on_twin(k).copy()) for k in range(30)]
    for k in (29, 3, 0, 17, 17):
        assert np.array_equal(tracks.distance(k), expected[k][0])
        assert np.array_equal(tracks.on_twin(k), expected[k][1])


def test_an_estimator_that_begins_later_knows_the_start() -> None:
    """Before slot k, x̂ = A^{k−1} x_0 with the error of k − 1 slots of noise."""
    batch = Batch(9, 3)
    estimator = TwinTrack(DRIFTING).estimator(KEYS, batch)
    x_0 = TwinTracks(DRIFTING, KEYS, batch).initial
    for first, moves in ((0, 0), (1, 0), (2, 1), (6, 5)):
        belief = estimator.prior(first)
        power = np.linalg.matrix_power
        spread = sum(power(DRIFTING.A, j) @ DRIFTING.Q @ power(DRIFTING.A, j).T for j in range(moves)) + np.zeros(
            (3, 3)
        )
        assert np.allclose(belief.x_hat, power(DRIFTING.A, moves) @ x_0, rtol=1e-12)
        assert np.allclose(belief.P, spread[:, :, None], rtol=1e-12)


def test_the_floor_grows_where_the_powers_of_the_process_do() -> None:
    """Half of the uncertainty of x_0; for an unstable or drifting process it has no bound."""
    for process, grows in ((UNSTABLE, True), (STABLE, False), (Process(np.eye(2), np.eye(2), np.eye(2)), False)):
        floor, without_bound = TwinTrack(process).error_floor(5)
        assert np.allclose(floor, [0.5 * np.trace(spread(process, k)) for k in range(5)], rtol=1e-12)
        assert without_bound is grows
    drifting = Process(np.array([[1.0, 1.0], [0.0, 1.0]]), np.eye(2), np.eye(2))
    assert TwinTrack(drifting).error_floor(2)[1]
    for A in ([[2.5]], [[1.5, 1.0], [1.0, 1.5]]):  # their powers leave double precision before slot 1024
        assert TwinTrack(Process(np.array(A), np.eye(len(A)), np.eye(len(A)))).error_floor(2)[1]
