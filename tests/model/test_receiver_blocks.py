"""Slots in blocks and slots one by one are the same numbers, wherever the blocks begin."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from evedrop.model import update
from evedrop.model.digest import BlockDigests
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.eavesdroppers.fixed_rules import Naive, Suspicious
from evedrop.model.packet_user import PacketUser
from evedrop.model.process import Floats, Process, Trajectory
from evedrop.model.receiver import Action, Belief, Beliefs, Flags, Receiver, Reception
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.innovation import InnovationEncoder, InnovationEstimator, SharedSecret
from evedrop.model.schemes.scheme import Packet, Scheme
from evedrop.model.streams import Batch, stream_key
from tests.builders import DRIFTING, MARGINAL, one_slot
from tests.model.slot_loop import ROOT, coins, keys_of, play

BATCH = Batch(24, 5, 3)
EDGES = (0, 1, 2, 9, 10, 24)
PLAIN_CASE = [
    name for name, kind in SCHEMES.items() if not (kind.header or kind.may_be_silent or kind.needs_acknowledgements)
]
"""The schemes whose slots can be played in blocks."""


class Sleepy(Suspicious):
    """A subclass that changes a slot, and says nothing of blocks."""

    def uses(self, k: int) -> Flags | None:
        """Nothing in every third slot."""
        used = super().uses(k)
        return used if k % 3 else np.zeros(BATCH.trials, bool) & used


class Late(InnovationEstimator):
    """A subclass that changes a slot of the scheme's estimator, and says nothing of blocks."""

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Does not hear the first slots."""
        return super().step(k, belief, heard._replace(gamma=heard.gamma & (k > 3)))


def blocks() -> Iterator[range]:
    """Blocks of different lengths that cover all slots."""
    return (range(first, stop) for first, stop in pairwise(EDGES))


def eavesdroppers(process: Process) -> dict[str, Receiver]:
    """One of each class that takes or leaves packets, and those that weigh them, alone and as the reader of another."""
    given: dict[str, Mapping[str, Any]] = {
        "naive": {}, "smart": {}, "suspicious": {"use_state": 0.7, "use_innovation": 0.2}, "bayesian": {},
        "colluding": {"reads_as": "bayesian"},
    }  # fmt: skip
    keys = keys_of(("schedule", "coin", "coin/suspicious"))
    made: dict[str, Receiver] = {
        name: STRATEGIES[name](Knowledge(process, 0.4, parameters, keys), BATCH) for name, parameters in given.items()
    }
    made["sleepy"] = Sleepy(Knowledge(process, 0.4, given["suspicious"], keys), BATCH)
    return made


def gamma_of(names: Mapping[str, Receiver]) -> dict[str, Flags]:
    """Receiver → what its link lets through, (slots, R)."""
    return {name: coins(0.7, BATCH.slots, BATCH.trials, seed) for seed, name in enumerate(["legitimate", *names])}


@pytest.mark.parametrize("process", [MARGINAL, DRIFTING], ids=["two states", "three states"])
@pytest.mark.parametrize("name", PLAIN_CASE)
def test_blocks_and_single_slots_give_the_same_bits(name: str, process: Process) -> None:
    """States, packets, beliefs and digests, of the scheme's own estimator and of eavesdroppers."""
    scheme: Scheme = scheme_of(process, {"scheme": name, **SCHEMES[name].parameters})
    gamma = gamma_of(eavesdroppers(process))
    once = play(scheme, BATCH, gamma, eavesdroppers(process))
    keys = keys_of(scheme.secret_streams)
    trajectory = Trajectory(process, stream_key(ROOT, "process"), BATCH, scheme.initial_state(keys, BATCH))
    encoder = scheme.encoder(keys, BATCH)
    receivers = {
        "legitimate": scheme.estimator(keys_of(scheme.estimator_streams), BATCH), **eavesdroppers(process),
    }  # fmt: skip
    beliefs = {who: receiver.prior() for who, receiver in receivers.items()}
    logs = {who: BlockDigests(BATCH.trials, BATCH.slots) for who in receivers}
    digests: dict[str, dict[int, Any]] = {who: {} for who in receivers}
    for slots in blocks():
        x, predicted = trajectory.advance_block(len(slots))
        z, nu, *_ = encoder.encode_block(slots, x, predicted)
        for row, k in enumerate(slots):
            assert np.array_equal(x[row], once.x[k])
            assert np.array_equal(z[row], once.packets[k].z)
            assert np.array_equal(nu[row], once.packets[k].nu)
        for who, receiver in receivers.items():
            block, beliefs[who] = receiver.follow(slots, beliefs[who], gamma[who][slots.start : slots.stop], z)
            digests[who].update(logs[who].add(slots, block))
            for row, k in enumerate(slots):
                expected = once.beliefs[who][k]
                assert np.array_equal(block.x_hat[row], expected.x_hat), (who, k)
                assert np.array_equal(block.P[row], expected.P), (who, k)
                assert np.array_equal(block.action[row], expected.action), (who, k)
            assert np.array_equal(beliefs[who].P, once.beliefs[who][slots[-1]].P)
    for who in receivers:
        log = BlockDigests(BATCH.trials, BATCH.slots)
        ends = [log.add(range(k, k + 1), one_slot(belief)) for k, belief in enumerate(once.beliefs[who])]
        assert list(digests[who]) == list(ends[-1]) == [0]
        assert np.array_equal(digests[who][0], ends[-1][0])


def test_a_secret_that_both_sides_share_is_drawn_once() -> None:
    """Sensor and estimator of one process ask it for the same block, and get what each would have drawn."""
    scheme = scheme_of(MARGINAL, {"scheme": "innovation", "state_probability": 0.4})
    keys = keys_of(scheme.secret_streams)
    shared, apart = scheme.shared(keys, BATCH), scheme.shared(keys, BATCH)
    trajectory = Trajectory(MARGINAL, stream_key(ROOT, "process"), BATCH)
    encoder, estimator, other = shared.encoder(), shared.estimator(), apart.estimator()
    gamma = coins(0.7, BATCH.slots, BATCH.trials)
    for slots in blocks():
        z = encoder.encode_block(slots, *trajectory.advance_block(len(slots))).z
        heard = gamma[slots.start : slots.stop]
        first, two = (receiver.follow(slots, receiver.prior(), heard, z)[0] for receiver in (estimator, other))
        assert np.array_equal(first.x_hat, two.x_hat)
        assert np.array_equal(first.P, two.P)


def test_a_subclass_that_changes_a_slot_changes_blocks_too() -> None:
    """Of an estimator that takes blocks at once: the subclass's slots count, not the block of the class below."""
    secret = SharedSecret(MARGINAL, 0.4, keys_of(("schedule", "noise")), BATCH)
    late, slots = Late(MARGINAL, BATCH.trials, secret), range(BATCH.slots)
    gamma, z = coins(0.7, BATCH.slots, BATCH.trials), np.ones((BATCH.slots, MARGINAL.n, BATCH.trials))
    beliefs, _ = late.follow(slots, late.prior(), gamma, z)
    assert not beliefs.action[:4].any()
    assert beliefs.action[4:].any()


class Always(PacketUser):
    """Says slot by slot that every packet is used."""

    def uses(self, k: int) -> Flags | None:  # noqa: ARG002 - every slot alike
        """Always."""
        return None


def test_a_class_that_always_uses_packets_may_say_so_slot_by_slot() -> None:
    """A block of such slots has no flags, either."""
    assert Always(MARGINAL, BATCH.trials).uses_block(range(3)) is None


def test_the_secret_slot_by_slot_is_that_of_a_block() -> None:
    """ν and χ, and with them what the estimator does with a packet."""
    secret = SharedSecret(MARGINAL, 0.4, keys_of(("schedule", "noise")), BATCH)
    slots, gamma = range(BATCH.slots), coins(0.7, BATCH.slots, BATCH.trials)
    nu, chi = secret.nu_block(slots), secret.chi_block(slots)
    assert np.array_equal(nu, [secret.nu(k) for k in slots])
    assert np.array_equal(chi, [secret.chi(k) for k in slots])
    estimator = InnovationEstimator(MARGINAL, BATCH.trials, secret)
    actions = np.array([estimator.act(k, gamma[k]) for k in slots])
    assert np.array_equal(actions, np.select([~gamma, nu], [Action.LOST, Action.INNOVATION], Action.STATE))


class Deaf:
    """A step to mix in, of no receiver itself: nothing is heard."""

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """As if nothing had arrived."""
        after: Belief = super().step(k, belief, heard._replace(gamma=np.zeros_like(heard.gamma)))  # type: ignore[misc]
        return after


class Picky:
    """Packets to use, to mix in."""

    def uses(self, k: int) -> Flags | None:  # noqa: ARG002 - every slot alike
        """None."""
        return np.zeros(BATCH.trials, bool)


class DeafNaive(Deaf, Naive):
    """A naive eavesdropper that hears nothing."""


class PickyNaive(Picky, Naive):
    """A naive eavesdropper that uses nothing."""


class Quick(Naive):
    """Takes blocks by a method of its own that relies on a property of the class: every packet is used."""

    def follow(self, slots: range, belief: Belief, gamma: Flags, z: Floats) -> tuple[Beliefs, Belief]:
        """The state from every packet."""
        beliefs = update.beliefs(self.process, slots.start, belief, gamma.astype(np.uint8), z)
        return beliefs, beliefs.last


class PickyQuick(Quick):
    """Uses no packet, and says nothing of blocks."""

    def uses(self, k: int) -> Flags | None:  # noqa: ARG002 - every slot alike
        """None."""
        return np.zeros(BATCH.trials, bool)


class Half(Naive):
    """Uses the packets of every second slot."""

    def uses(self, k: int) -> Flags | None:
        """Always, or none."""
        return None if k % 2 else np.zeros(BATCH.trials, bool)


@pytest.mark.parametrize("kind", [DeafNaive, PickyNaive, Quick, PickyQuick, Half])
def test_blocks_are_of_the_class_that_slots_are_of(kind: type[Naive]) -> None:
    """The blocks of a class equal its slots, no matter what it overrides and where it inherits from."""
    receiver, slots = kind(Knowledge(MARGINAL, 0.4, {}, {}), BATCH), range(BATCH.slots)
    gamma, z = coins(0.7, BATCH.slots, BATCH.trials), np.ones((BATCH.slots, MARGINAL.n, BATCH.trials))
    beliefs, _ = receiver.follow(slots, receiver.prior(), gamma, z)
    belief = receiver.prior()
    for k in slots:
        belief = receiver.step(k, belief, Reception(gamma[k], z[k]))
        assert np.array_equal(beliefs.action[k], belief.action), k
        assert np.array_equal(beliefs.x_hat[k], belief.x_hat), k
    assert kind in {Quick, Half} or not (beliefs.action == int(Action.STATE)).any()


class Loud:
    """A packet to mix in."""

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """Twice what it was."""
        packet: Packet = super().encode(k, x, predicted)  # type: ignore[misc]
        return packet._replace(z=2.0 * packet.z)


class LoudEncoder(Loud, InnovationEncoder):
    """The paper's scheme, twice as loud."""


def test_an_encoder_may_change_a_packet_by_a_class_that_it_mixes_in() -> None:
    """Its blocks change, too."""
    secret = SharedSecret(MARGINAL, 0.4, keys_of(("schedule", "noise")), BATCH)
    x = np.ones((3, MARGINAL.n, BATCH.trials))
    once, twice = (kind(secret).encode_block(range(3), x, x) for kind in (InnovationEncoder, LoudEncoder))
    assert np.array_equal(twice.z, 2.0 * once.z)
