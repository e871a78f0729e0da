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
from evedrop.model.links.loss_model import Fate
from evedrop.model.process import Process, Trajectory
from evedrop.model.receiver import Action, Belief, Receiver, Reception, prior
from evedrop.model.schemes.encrypted_schedule import EncryptedSchedule
from evedrop.model.schemes.innovation import Innovation
from evedrop.model.slot.cores import Absence, ReceiverCore
from evedrop.model.slot.link import COUNTED_BURSTS, Accountant, Fates, Link, LinkSchedule, streams_of
from evedrop.model.slot.link_core import Arrival, Arrivals, Late, Transit
from evedrop.model.streams import Batch
from tests.builders import stream_keys
from tests.examples import examples

PROCESS = Process(np.array([[1.0, 0.1], [0.0, 0.9]]), np.diag([0.1, 0.2]), np.eye(2))
BATCH = Batch(40, 9)
KEYS = stream_keys(5, ("process", "schedule", "noise", "coin"))
MU_D = 0.5
FULL = {
    "loss": {"model": "bernoulli", "quality": 0.8},
    "delay": {"model": "normal", "mean": 1.5, "standard_deviation": 1.5},
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


class OneByOne:
    """A receiver's core that is given one slot at a time."""

    def __init__(self, receiver: Receiver, window: int) -> None:
        self.core = ReceiverCore(receiver, window)
        self.late = self.used = np.zeros(receiver.trials, np.uint16)

    def take(self, k: int, arrival: Arrival) -> Belief:
        """The belief after a slot."""
        heard = arrival.heard
        header = None if heard.header is None else heard.header[None]
        taken = self.core.take_slots(
            range(k, k + 1),
            Arrivals(heard.gamma[None], heard.z[None], header, {0: arrival.late} if arrival.late else {}),
        )
        none = np.zeros(len(self.late), np.uint16)
        self.late = none if taken.late is None else taken.late[0]
        self.used = none if taken.late_used is None else taken.late_used[0]
        assert same(taken.beliefs.last, self.core.belief)
        return self.core.belief


def packets() -> list[np.ndarray]:
    """What the sensor sends."""
    encoder, trajectory = Innovation(PROCESS, MU_D).encoder(KEYS, BATCH), Trajectory(PROCESS, KEYS["process"], BATCH)
    return [encoder.encode(k, trajectory.advance(), trajectory.predicted).z.copy() for k in range(BATCH.slots)]


def fates(window: int) -> Fates:
    """Of a link that loses, delays and duplicates."""
    schedule = LinkSchedule(FULL, window)
    return Link(schedule, "it", stream_keys(6, streams_of("it", schedule)), BATCH).fates(range(BATCH.slots))


def same(belief: Belief, other: Belief) -> bool:
    """Whether two beliefs are the same to the bit; what was done in the last slot may differ."""
    return belief.x_hat.tobytes() == other.x_hat.tobytes() and belief.P.tobytes() == other.P.tobytes()


@pytest.mark.parametrize("name", ["legitimate", "naive", "smart", "suspicious"])
@pytest.mark.parametrize("window", [0, 1, 4])
def test_a_late_packet_counts_as_if_it_had_been_in_time(name: str, window: int) -> None:
    """After every slot the belief is that of a receiver that was given at once all that has arrived by then."""
    receiver, z, fate = receivers()[name], packets(), fates(window)
    follower, transit = OneByOne(receiver, window), Transit()
    assert fate.delays is not None
    there = fate.codes == Fate.DELIVERED
    late_seen = 0
    for k in range(BATCH.slots):
        belief = follower.take(k, transit.arrival(k, fate, k, z[k]))
        expected = receiver.prior()
        for j in range(k + 1):
            expected = receiver.step(j, expected, Reception(there[j] & (j + fate.delays[j] <= k), z[j]))
        assert same(belief, expected), k
        arrivals = [there[j] & (j + fate.delays[j] == k) for j in range(k)]
        counts = np.sum(arrivals, axis=0) if arrivals else np.zeros(BATCH.trials)
        assert np.array_equal(follower.late, counts)
        # The eavesdroppers that discard packets discard late ones, too; each packet counts once.
        assert (
            np.array_equal(follower.used, counts)
            if name in {"legitimate", "naive"}
            else (follower.used <= counts).all()
        )
        late_seen += int(counts.sum())
    assert late_seen > 0 or window == 0


def test_duplicates_change_nothing() -> None:
    """A second copy, of this slot or an earlier one, is not fresh."""
    legitimate, z = receivers()["legitimate"], packets()
    everybody = np.ones(BATCH.trials, bool)
    plain, twice = OneByOne(legitimate, 3), OneByOne(legitimate, 3)
    for k in range(6):
        heard = Reception(everybody, z[k])
        copies = tuple(Late(j, Reception(everybody, z[j]), copy=True) for j in range(max(0, k - 3), k + 1))
        assert same(plain.take(k, Arrival(heard)), twice.take(k, Arrival(heard, copies)))
        assert not twice.late.any()


def test_what_is_older_than_the_window_changes_nothing() -> None:
    """One slot within the window is fresh, one slot beyond it is not."""
    legitimate, z = receivers()["legitimate"], packets()
    nobody, everybody = np.zeros(BATCH.trials, bool), np.ones(BATCH.trials, bool)
    for age, fresh in ((3, True), (4, False)):
        plain, given_ = OneByOne(legitimate, 3), OneByOne(legitimate, 3)
        for k in range(8):
            late = (Late(k - age, Reception(everybody, z[k - age])),) if k == 7 else ()
            before = plain.take(k, Arrival(Reception(nobody, z[k])))
            after = given_.take(k, Arrival(Reception(nobody, z[k]), late))
        assert same(before, after) is not fresh


def test_an_absence_is_a_receiver_that_hears_nothing() -> None:
    """Carried on from any belief, and from the prior of any slot, to the bit."""
    smart = receivers()["smart"]
    nothing = Reception(np.zeros(BATCH.trials, bool), np.zeros((2, BATCH.trials)))
    for first in (0, 1, 7):
        absence, belief = Absence(PROCESS, prior(PROCESS, BATCH.trials, first)), smart.prior(first)
        for slots in (range(first, first + 1), range(first + 1, first + 5)):
            result = absence.take_slots(slots)
            for row, k in enumerate(slots):
                belief = smart.step(k, belief, nothing)
                assert same(Belief(result.x_hat[row], result.P[row], result.action[row]), belief)
                assert np.array_equal(result.action[row], np.full(BATCH.trials, Action.LOST))


@pytest.mark.parametrize("window", [0, 3])
def test_an_absent_receiver_counts_late_packets_as_it_does_when_it_is_there(window: int) -> None:
    """None arrive; a receiver without a window counts none, so that its slots can be joined with those before and after."""
    result = Absence(PROCESS, prior(PROCESS, BATCH.trials, 1), window).take_slots(range(1, 4))
    for counts in (result.late, result.late_used):
        assert (counts is None) is (window == 0)
        assert counts is None or (counts.tolist() == np.zeros((3, BATCH.trials)).tolist() and counts.dtype == np.uint16)


def test_the_prior_of_a_slot_is_the_state_covariance() -> None:
    """A receiver that starts before slot k reports 0 and Σ_{k−1}."""
    sigma = PROCESS.initial_covariance
    assert np.array_equal(prior(PROCESS, 1).P[:, :, 0], sigma)
    for k in range(1, 6):
        np.testing.assert_allclose(prior(PROCESS, 2, k).P[:, :, 1], sigma, rtol=1e-14)
        sigma = PROCESS.A @ sigma @ PROCESS.A.T + PROCESS.Q


@settings(deadline=None, max_examples=examples(40))
@given(st.lists(st.lists(st.booleans(), min_size=3, max_size=3), min_size=1, max_size=60), st.integers(1, 20))
def test_bursts_are_runs_of_losses(lost: list[list[bool]], piece: int) -> None:
    """Counted once they end, whatever the pieces; as itertools groups them."""
    rows = np.array(lost)
    accountant, bursts = Accountant(0, 3), np.zeros(COUNTED_BURSTS, int)
    for start in range(0, len(rows), piece):
        part = rows[start : start + piece]
        codes = np.where(part, np.uint8(Fate.LOST), np.uint8(Fate.DELIVERED))
        bursts += accountant.account(range(start, start + len(part)), Fates(codes)).bursts
    expected = np.zeros(COUNTED_BURSTS, int)
    for trial in rows.T:
        groups = [(value, len(list(run))) for value, run in itertools.groupby(trial)]
        for value, length in groups[:-1]:
            expected[min(length, COUNTED_BURSTS) - 1] += value
    assert np.array_equal(bursts, expected)


@pytest.mark.parametrize("window", [0, 2, 6])
def test_every_packet_is_accounted_for(window: int) -> None:
    """Delivered in time, delivered late or lost for one reason: they add up, and late ones arrive where they should."""
    fate, transit, accountant = fates(window), Transit(), Accountant(window, BATCH.trials)
    parts = [accountant.account(range(a, b), fate.part(slice(a, b))).slots for a, b in ((0, 7), (7, 8), (8, 40))]
    in_time = sum(int(part.delivered.sum()) for part in parts)
    lost = sum(int(part.lost.sum()) for part in parts)
    late = sum(0 if part.late is None else int(part.late.sum()) for part in parts)
    assert in_time + lost + late == BATCH.slots * BATCH.trials
    z = np.zeros((2, BATCH.trials))
    rows = np.concatenate([part.late for part in parts if part.late is not None]) if window else None
    for k in range(BATCH.slots):
        arrival = transit.arrival(k, fate, k, z)
        counts = sum(
            (packet.heard.gamma.astype(int) for packet in arrival.late if not packet.copy), np.zeros(BATCH.trials, int)
        )
        assert np.array_equal(counts, np.zeros(BATCH.trials) if rows is None else rows[k])


def test_slots_that_a_receiver_was_away_are_lost_and_end_its_window() -> None:
    """It predicts through them, and a packet from before them is not fresh any more."""
    legitimate, z = receivers()["legitimate"], packets()
    everybody = np.ones(BATCH.trials, bool)
    follower, expected = OneByOne(legitimate, 3), legitimate.prior()
    for k in range(2):
        follower.take(k, Arrival(Reception(~everybody, z[k])))
    follower.core.miss(range(2, 5))
    for k in range(5):
        expected = legitimate.step(k, expected, Reception(~everybody, z[k]))
    assert same(follower.core.belief, expected)
    after = follower.take(5, Arrival(Reception(~everybody, z[5]), (Late(1, Reception(everybody, z[1])),)))
    assert same(after, legitimate.step(5, expected, Reception(~everybody, z[5])))
    assert not follower.late.any()


@pytest.mark.parametrize("with_header", [True, False])
def test_a_late_packet_has_its_own_header(with_header: bool) -> None:
    """In the trials in which it is fresh, whether or not the slot had one before."""
    process, slots = Process(np.eye(2), np.eye(2), np.eye(2)), 3
    keys = stream_keys(2, ("mask",))
    scheme = EncryptedSchedule(process, 1)
    batch = Batch(slots, 2)
    encoder, states = scheme.encoder(keys, batch), np.random.default_rng(1).normal(size=(slots, 2, 2))
    sent = [encoder.encode(k, states[k], states[k]) for k in range(slots)]
    both, first = np.ones(2, bool), np.array([True, False])
    receptions = [Reception(first, slot.z, slot.header if with_header else None) for slot in sent]
    follower = OneByOne(scheme.estimator(keys, batch), 2)
    follower.take(0, Arrival(Reception(~both, sent[0].z)))
    follower.take(1, Arrival(receptions[1] if with_header else Reception(~both, sent[1].z)))
    late = Late(1, Reception(both, sent[1].z, sent[1].header))
    belief = follower.take(2, Arrival(Reception(~both, sent[2].z, sent[2].header), (late,)))
    assert np.allclose(belief.x_hat, states[1], atol=1e-9)
    assert follower.late.tolist() == ([0, 1] if with_header else [1, 1])


def test_second_copies_without_delays_arrive_in_their_slot() -> None:
    """And nothing stays under way."""
    transit, z = Transit(), np.ones((2, 3))
    delivered = Fates(np.array([[0, 1, 0]], np.uint8), None, np.array([[True, False, False]]))
    assert not transit.busy
    arrival = transit.arrival(4, delivered, 0, z)
    assert not transit.busy
    ((k, heard, copy),) = arrival.late
    assert (k, copy, heard.gamma.tolist()) == (4, True, [True, False, False])
    assert arrival.heard.gamma.tolist() == [True, False, True]


def test_packets_are_under_way_until_they_arrive() -> None:
    """With their own numbers, whatever becomes of the array that held them."""
    transit, z = Transit(), np.array([[5.0]])
    transit.arrival(0, Fates(np.zeros((1, 1), np.uint8), np.array([[2]], np.uint32)), 0, z)
    z[:] = 7.0
    assert transit.busy
    nothing = Fates(np.ones((1, 1), np.uint8))
    assert transit.arrival(1, nothing, 0, z).late == ()
    ((k, heard, copy),) = transit.arrival(2, nothing, 0, z).late
    assert (k, copy, heard.z.tolist()) == (0, False, [[5.0]])
    assert not transit.busy


def test_a_link_without_delays_has_all_its_packets_in_time() -> None:
    """Where packets could be late, none is; those that went through took no slot."""
    codes = np.array([[Fate.DELIVERED, Fate.LOST], [Fate.DELIVERED, Fate.UNSENT]], np.uint8)
    accounted = Accountant(3, 2).account(range(2), Fates(codes))
    assert accounted.slots.late is not None
    assert not accounted.slots.late.any()
    assert accounted.delays.tolist() == [2, 0, 0, 0, 0]
    assert accounted.slots.unsent.tolist() == [0, 1]
