"""Late packets, duplicates and outages, as transit, follower and account see them, against what is obvious of them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.links.link import Fate
from evedrop.model.process import Process, Trajectory
from evedrop.model.receiver import Action, Belief, Receiver, Reception, prior
from evedrop.model.schemes.innovation import Innovation
from evedrop.model.slot.account import COUNTED_BURSTS, Accountant
from evedrop.model.slot.intermittent_receiver import Absence, Follower
from evedrop.model.slot.link import Fates, Link, LinkSchedule, streams_of
from evedrop.model.slot.transit import Arrival, Late, Transit
from evedrop.streams import Batch
from tests.builders import stream_keys

PROCESS = Process(np.array([[1.0, 0.1], [0.0, 0.9]]), np.diag([0.1, 0.2]), np.eye(2))
BATCH = Batch(40, 9)
KEYS = stream_keys(5, ("process", "schedule", "noise", "coin"))
MU_D = 0.5
FULL = {
    "loss": {"model": "bernoulli", "quality": 0.8},
    "delay": {"model": "normal", "mean": 1.5, "deviation": 1.5},
    "duplicate": 0.3,
}


def receivers() -> Mapping[str, Receiver]:
    """The estimator that holds the secret, and the paper's eavesdroppers."""
    scheme = Innovation(PROCESS, MU_D)
    made: dict[str, Receiver] = {"legitimate": scheme.estimator(KEYS, BATCH)}
    for name in ("naive", "smart", "suspicious"):
        parameters = {"use_state": 0.8, "use_innovation": 0.3} if name == "suspicious" else {}
        made[name] = STRATEGIES[name](Knowledge(PROCESS, MU_D, parameters, KEYS), BATCH)
    return made


def packets() -> list[np.ndarray]:
    """What the sensor sends."""
    encoder, trajectory = Innovation(PROCESS, MU_D).encoder(KEYS, BATCH), Trajectory(PROCESS, KEYS["process"], BATCH)
    return [encoder.encode(k, trajectory.advance(), trajectory.predicted).z.copy() for k in range(BATCH.slots)]


def fates(window: int) -> Fates:
    """Of a link that loses, delays and duplicates."""
    course = LinkSchedule(FULL, window)
    return Link(course, "it", stream_keys(6, streams_of("it", course)), BATCH).fates(range(BATCH.slots))


def same(one: Belief, other: Belief) -> bool:
    """Whether two beliefs are the same to the bit; what was done in the last slot may differ."""
    return one.x_hat.tobytes() == other.x_hat.tobytes() and one.P.tobytes() == other.P.tobytes()


@pytest.mark.parametrize("name", ["legitimate", "naive", "smart", "suspicious"])
@pytest.mark.parametrize("window", [0, 1, 4])
def test_a_late_packet_counts_as_if_it_had_been_in_time(name: str, window: int) -> None:
    """After every slot the belief is that of a receiver that was given at once all that has arrived by then."""
    one, z, course = receivers()[name], packets(), fates(window)
    follower, transit = Follower(one, window), Transit()
    assert course.delays is not None
    there = course.codes == Fate.DELIVERED
    late_seen = 0
    for k in range(BATCH.slots):
        belief = follower.take(k, transit.arrival(k, course, k, z[k]))
        expected = one.prior()
        for j in range(k + 1):
            expected = one.step(j, expected, Reception(there[j] & (j + course.delays[j] <= k), z[j]))
        assert same(belief, expected), k
        arrivals = [there[j] & (j + course.delays[j] == k) for j in range(k)]
        counts = np.sum(arrivals, axis=0) if arrivals else np.zeros(BATCH.trials)
        assert np.array_equal(follower.late, counts)
        late_seen += int(counts.sum())
    assert late_seen > 0 or window == 0


def test_duplicates_change_nothing() -> None:
    """A second copy, of this slot or an earlier one, is no news."""
    one, z = receivers()["legitimate"], packets()
    everybody = np.ones(BATCH.trials, bool)
    plain, twice = Follower(one, 3), Follower(one, 3)
    for k in range(6):
        heard = Reception(everybody, z[k])
        copies = tuple(Late(j, Reception(everybody, z[j]), copy=True) for j in range(max(0, k - 3), k + 1))
        assert same(plain.take(k, Arrival(heard)), twice.take(k, Arrival(heard, copies)))
        assert not twice.late.any()


def test_what_is_older_than_the_window_changes_nothing() -> None:
    """One slot within the window is news, one slot beyond it is not."""
    one, z = receivers()["legitimate"], packets()
    nobody, everybody = np.zeros(BATCH.trials, bool), np.ones(BATCH.trials, bool)
    for age, news in ((3, True), (4, False)):
        plain, given_ = Follower(one, 3), Follower(one, 3)
        for k in range(8):
            late = (Late(k - age, Reception(everybody, z[k - age])),) if k == 7 else ()
            before = plain.take(k, Arrival(Reception(nobody, z[k])))
            after = given_.take(k, Arrival(Reception(nobody, z[k]), late))
        assert same(before, after) is not news


def test_an_absence_is_a_receiver_that_hears_nothing() -> None:
    """Carried on from any belief, and from the prior of any slot, to the bit."""
    one = receivers()["smart"]
    nothing = Reception(np.zeros(BATCH.trials, bool), np.zeros((2, BATCH.trials)))
    for first in (0, 1, 7):
        absence, belief = Absence(PROCESS, prior(PROCESS, BATCH.trials, first)), one.prior(first)
        for k in range(first, first + 5):
            belief = one.step(k, belief, nothing)
            found = absence.next(k)
            assert same(found, belief)
            assert np.array_equal(found.action, np.full(BATCH.trials, Action.LOST))


def test_the_prior_of_a_slot_is_the_state_covariance() -> None:
    """A receiver that starts before slot k believes 0 and Σ_{k−1}."""
    sigma = PROCESS.initial_covariance
    assert np.array_equal(prior(PROCESS, 1).P[:, :, 0], sigma)
    for k in range(1, 6):
        np.testing.assert_allclose(prior(PROCESS, 2, k).P[:, :, 1], sigma, rtol=1e-14)
        sigma = PROCESS.A @ sigma @ PROCESS.A.T + PROCESS.Q


@settings(deadline=None, max_examples=40)
@given(st.lists(st.lists(st.booleans(), min_size=3, max_size=3), min_size=1, max_size=60), st.integers(1, 20))
def test_bursts_are_runs_of_losses(lost: list[list[bool]], piece: int) -> None:
    """Counted once they end, whatever the pieces; as itertools groups them."""
    rows = np.array(lost)
    accountant, found = Accountant(0, 3), np.zeros(COUNTED_BURSTS, int)
    for start in range(0, len(rows), piece):
        part = rows[start : start + piece]
        codes = np.where(part, np.uint8(Fate.LOST), np.uint8(Fate.DELIVERED))
        found += accountant.account(range(start, start + len(part)), Fates(codes)).bursts
    expected = np.zeros(COUNTED_BURSTS, int)
    for trial in rows.T:
        groups = [(value, len(list(run))) for value, run in itertools.groupby(trial)]
        for value, length in groups[:-1]:
            expected[min(length, COUNTED_BURSTS) - 1] += value
    assert np.array_equal(found, expected)


@pytest.mark.parametrize("window", [0, 2, 6])
def test_every_packet_is_accounted_for(window: int) -> None:
    """Delivered in time, delivered late or lost for one reason: they add up, and late ones arrive where they should."""
    course, transit, accountant = fates(window), Transit(), Accountant(window, BATCH.trials)
    parts = [accountant.account(range(a, b), course.part(slice(a, b))) for a, b in ((0, 7), (7, 8), (8, 40))]
    in_time = sum(int(part.delivered.sum()) for part in parts)
    lost = sum(int(counts.sum()) for part in parts for counts in part.lost.values())
    late = sum(0 if part.late is None else int(part.late.sum()) for part in parts)
    assert in_time + lost + late == BATCH.slots * BATCH.trials
    z = np.zeros((2, BATCH.trials))
    rows = np.concatenate([part.late for part in parts if part.late is not None]) if window else None
    for k in range(BATCH.slots):
        arrival = transit.arrival(k, course, k, z)
        counts = sum((one.heard.gamma.astype(int) for one in arrival.late if not one.copy), np.zeros(BATCH.trials, int))
        assert np.array_equal(counts, np.zeros(BATCH.trials) if rows is None else rows[k])
