"""The rule for many slots at once, broken by encoders: each way is found, with class, method, slots and what to do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Reception
from evedrop.model.schemes.acknowledged import Acknowledged
from evedrop.model.schemes.plain import Plain, PlainEncoder, PlainEstimator
from evedrop.model.schemes.scheme import Encoder, NoInnovations, Packet, PacketBlock
from evedrop.scenario.conformance.schemes import SchemeChecks
from tests.scenario.conformance.breaking import blocks_of_scheme, broken, plain_with


class Blocks(PlainEncoder):
    """Takes blocks of slots, and may spoil those of more than one slot."""

    spoil = staticmethod(lambda packets: packets)

    def encode_block(self, slots: range, x: Floats, predicted: Floats) -> Any:  # noqa: ARG002 - the state alone is sent
        """The packets of consecutive slots."""
        packets = PacketBlock(x, np.zeros(x[:, 0].shape, np.bool_))
        return packets if len(slots) == 1 else self.spoil(packets)


def added(z: Floats, row: int, number: float) -> Floats:
    """A copy with a number added in one row."""
    z = z.copy()
    z[row] += number
    return z


_ROOM = np.empty((300, 3, 5))


def into_room(packets: PacketBlock) -> PacketBlock:
    """The packets, in an array that is used again for the next block."""
    z = _ROOM[tuple(slice(length) for length in packets.z.shape)]
    z[:] = packets.z
    return packets._replace(z=z)


BLOCKS: dict[str, tuple[Callable[[PacketBlock], Any], tuple[str, ...]]] = {
    "Raises": (
        lambda packets: packets.z[len(packets.z)],
        (
            "slots 0 to 8: Raises.encode_block() raised IndexError: index 9 is out of bounds for axis 0 with size 9, test_",
        ),
    ),
    "Other": (
        lambda packets: packets._replace(z=added(packets.z, -1, 1.0)),
        (
            "slot 8, trial 0: Packet.z is ",
            " by Other.encode_block() of slots 0 to 8; let a slot's numbers depend neither on its block nor on what was asked",
        ),
    ),
    "Short": (
        lambda packets: packets.rows(slice(0, -1)),
        ("slots 0 to 8: PacketBlock.z has shape (8, 1, 4); expected (9, 1, 4): slots, n states, R trials",),
    ),
    "Listed": (lambda packets: [*packets], ("slots 0 to 8: encode_block() returned list; expected a PacketBlock",)),
    "Single": (
        lambda packets: packets._replace(z=packets.z.astype(np.float32)),
        ("slots 0 to 8: PacketBlock.z has type float32; expected float64, such as by .astype(np.float64)",),
    ),
    "Infinite": (
        lambda packets: packets._replace(z=added(packets.z, 1, np.inf)),
        ("slot 1: Packet.z, trial 0, is inf; expected finite numbers",),
    ),
    "Headed": (
        lambda packets: packets._replace(header=np.zeros((len(packets.z), 1, 4), np.int64)),
        ("slots 0 to 8: the packets have a header, and the scheme's `header` names 0 numbers",),
    ),
    "Silent": (
        lambda packets: packets._replace(sent=~packets.nu),
        ("slots 0 to 8: PacketBlock.sent and `may_be_silent` = False do not agree; expected both or none",),
    ),
    "Types": (
        lambda packets: packets._replace(nu=~packets.nu),
        ("slot 0, trial 0: Packet.nu is False in a single slot and True by Types.encode_block() of slots 0 to 8; ",),
    ),
    "InPlace": (
        lambda packets: np.negative(packets.z, out=packets.z),
        ("slots 0 to 8: InPlace.encode_block() changes in place what it is given",),
    ),
    "Reuses": (into_room, ("Packet.z is ", " by Reuses.encode_block() of slots ")),
}
"""The name of a class, how it changes the packets of several slots, and the expected report."""


@pytest.mark.parametrize("name", BLOCKS)
def test_an_encoder_whose_blocks_are_wrong_is_told_how(name: str) -> None:
    """Errors, shapes, types and numbers; single slots are right, so that no other rule finds it."""
    spoil, parts = BLOCKS[name]
    text = str(blocks_of_scheme(plain_with(type(name, (Blocks,), {"spoil": staticmethod(spoil)}))))
    assert all(part in text for part in parts), text


class ByRow(Blocks):
    """Counts from the beginning of a block where it should count slots."""

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """A hundredth of k more."""
        packet = super().encode(k, x, predicted)
        return packet._replace(z=packet.z + 0.01 * k)

    def encode_block(self, slots: range, x: Floats, predicted: Floats) -> Any:
        """A hundredth of the row more."""
        return super().encode_block(slots, x + 0.01 * np.arange(len(slots))[:, None, None], predicted)


def test_a_block_that_begins_in_a_later_slot_is_no_other() -> None:
    """One block of all slots would be right, and so would the first of many."""
    text = str(blocks_of_scheme(plain_with(ByRow)))
    assert "slot 1, trial 0: Packet.z is " in text
    assert " by ByRow.encode_block() of slot 1; let a slot's numbers depend neither on its block" in text


def test_the_rule_is_one_of_those_that_are_checked() -> None:
    """A scheme whose blocks are right keeps every rule; one whose blocks are wrong breaks this rule alone."""
    right, wrong = (SchemeChecks(plain_with(kind), {}).verdicts() for kind in (Blocks, ByRow))
    assert "many slots at once" in [verdict.rule for verdict in right]
    assert broken(right) == {}
    assert list(broken(wrong)) == ["many slots at once"]
    assert (
        "1 state, spectral radius 0.8, 4 trials: slot 1, trial 0: Packet.z is " in broken(wrong)["many slots at once"]
    )


class Ratchet:
    """A secret that forgets earlier slots."""

    def __init__(self) -> None:
        self._k, self._sign = 0, 1.0

    def sign(self, k: int) -> float:
        """The sign of slot k, from the last slot that was asked for."""
        if k > self._k:
            self._k, self._sign = k, -self._sign
        return self._sign


class TurnedEncoder(PlainEncoder):
    """Multiplies with the sign."""

    def __init__(self, secret: Ratchet) -> None:
        self._secret = secret

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """The state or its negative."""
        packet = super().encode(k, x, predicted)
        return packet._replace(z=self._secret.sign(k) * packet.z)


class TurnedEstimator(PlainEstimator):
    """Takes the sign away."""

    def __init__(self, process: Any, trials: int, secret: Ratchet) -> None:
        super().__init__(process, trials)
        self._secret = secret

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """The state or its negative, turned back."""
        return super().step(k, belief, heard._replace(z=self._secret.sign(k) * heard.z))


class Turned(Plain):
    """Both sides share the secret, and neither takes blocks."""

    def shared(self, keys: Any, batch: Any) -> NoInnovations:
        """One secret for both."""
        del keys
        secret, trials = Ratchet(), batch.trials
        return NoInnovations(
            self.process,
            trials,
            lambda: TurnedEncoder(secret),
            lambda: TurnedEstimator(self.process, trials, secret),
        )


def test_sides_that_must_take_turns_are_found() -> None:
    """In memory the sensor encodes many slots before the estimator reads them, though both take slots one by one."""
    text = str(blocks_of_scheme(Turned))
    assert "Belief.x_hat is " in text
    assert " by TurnedEstimator.step() of slots 0 to 8; let a slot's numbers depend neither on its block nor" in text


class Waits(Acknowledged):
    """The scheme with acknowledgements, whose packets of a block of one slot are not those of the slot."""

    def shared(self, keys: Any, batch: Any) -> Any:
        """With an encoder that takes blocks."""
        shared = super().shared(keys, batch)
        made = shared.encoder

        def encode_block(encoder: Encoder, slots: range, x: Floats, predicted: Floats) -> PacketBlock:
            assert len(slots) == 1, "where packets depend on acknowledgements, blocks have one slot"
            packet = encoder.encode(slots.start, x[0], predicted[0])
            return PacketBlock.of([packet._replace(z=packet.z + (slots.start == 5))])

        def encoder() -> Encoder:
            encoder = made()
            encoder.__class__ = type("Waiting", (type(encoder),), {"encode_block": encode_block})
            return encoder

        return NoInnovations(self.process, batch.trials, encoder, shared.estimator)


def test_blocks_have_one_slot_where_acknowledgements_decide() -> None:
    """Each slot's acknowledgements arrive before the next slot is encoded."""
    text = str(blocks_of_scheme(Waits))
    assert "slot 5, trial 0: Packet.z is " in text
    assert " by Waiting.encode_block() of slot 5; " in text
