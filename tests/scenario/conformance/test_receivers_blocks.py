"""The rule for many slots at once, broken by receivers: each way is found, with class, method, slots and what to do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from evedrop.model import update
from evedrop.model.eavesdroppers.eavesdropper import PacketReader, PacketTaker
from evedrop.model.eavesdroppers.fixed_rules import Naive
from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Beliefs, Codes, Flags, Reception
from evedrop.model.schemes.plain import Plain, PlainEstimator
from evedrop.scenario.conformance.receivers import divisions
from tests.scenario.conformance.breaking import blocks_of_eavesdropper, blocks_of_scheme, broken, checks_of, plain_with


class Follows(PlainEstimator):
    """Takes blocks of slots, and may spoil those of more than one slot."""

    spoil = staticmethod(lambda pair: pair)

    def follow(self, slots: range, belief: Belief, gamma: Flags, z: Floats) -> Any:
        """The beliefs after consecutive slots."""
        beliefs, last = super().follow(slots, belief, gamma, z)
        return (beliefs, last) if len(slots) == 1 else self.spoil((beliefs, last))


def times(array: Floats, row: int, factor: float) -> Floats:
    """A copy with one row multiplied."""
    array = array.copy()
    array[row] *= factor
    return array


FOLLOWS: dict[str, tuple[Callable[[tuple[Beliefs, Belief]], Any], tuple[str, ...]]] = {
    "Raises": (
        lambda pair: pair[2],  # type: ignore[misc]  # there are two
        ("slots 0 to 8: Raises.follow() raised IndexError: tuple index out of range, test_receivers_blocks.py line ",),
    ),
    "Lastless": (
        lambda pair: pair[0],
        (
            "slots 0 to 8: follow() returned Beliefs; expected the Beliefs after each slot, and the Belief after the last",
        ),
    ),
    "Triple": (
        lambda pair: (*pair, 9),
        ("slots 0 to 8: follow() returned a tuple of Beliefs, Belief, int; expected the Beliefs after each slot",),
    ),
    "Short": (
        lambda pair: (pair[0].rows(slice(0, -1)), pair[1]),
        ("slots 0 to 8: Beliefs.x_hat has shape (8, 1, 4); expected (9, 1, 4): slots, n states, R trials",),
    ),
    "Signed": (
        lambda pair: (pair[0]._replace(action=pair[0].action.astype(np.int8)), pair[1]),
        ("slots 0 to 8: Beliefs.action has type int8; expected uint8",),
    ),
    "Undefined": (
        lambda pair: (pair[0]._replace(x_hat=times(pair[0].x_hat, 2, np.nan)), pair[1]),
        ("slot 2: Belief.x_hat, trial 0, is nan; expected finite numbers",),
    ),
    "Early": (
        lambda pair: (pair[0], pair[0].rows(slice(0, 1)).last),
        ("slot 8, trial ", " by the last Belief of Early.follow() of slot 8; "),
    ),
    "Wrong": (lambda pair: (pair[0], pair[1][:2]), ("slot 8: the last Belief is tuple; expected a Belief",)),
    "Sure": (
        lambda pair: (pair[0]._replace(P=times(pair[0].P, 4, 0.5)), pair[1]),
        (
            "slot 4, trial ",
            ": Belief.P is ",
            " by Sure.follow() of slots 0 to 8; let a slot's numbers depend neither on",
        ),
    ),
}
"""The name of a class, how it changes the beliefs and the last belief of several slots, and the expected report."""


@pytest.mark.parametrize("name", FOLLOWS)
def test_an_estimator_whose_blocks_are_wrong_is_told_how(name: str) -> None:
    """As an encoder is; the belief after the last slot is checked, too."""
    spoil, parts = FOLLOWS[name]
    text = str(blocks_of_scheme(plain_with(estimator=type(name, (Follows,), {"spoil": staticmethod(spoil)}))))
    assert all(part in text for part in parts), text


class Consumes(PlainEstimator):
    """Works on the packets that it is given."""

    def follow(self, slots: range, belief: Belief, gamma: Flags, z: Floats) -> Any:
        """Nothing new, but done in place."""
        z *= 1.0
        return super().follow(slots, belief, gamma, z)


class Continues(PlainEstimator):
    """Goes on from where its last block ended, whatever belief it is given."""

    last: Belief | None = None

    def follow(self, slots: range, belief: Belief, gamma: Flags, z: Floats) -> Any:
        """From the belief before, if it has one."""
        beliefs, self.last = super().follow(slots, self.last or belief, gamma, z)
        return beliefs, self.last


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (Consumes, "slots 0 to 8: Consumes.follow() changes in place what it is given"),
        (Continues, " by Continues.follow() of slot"),
    ],
)
def test_an_estimator_leaves_nothing_behind_in_what_it_is_given_or_in_itself(kind: Any, message: str) -> None:
    """Blocks may be asked for again, as slots may."""
    assert message in str(blocks_of_scheme(plain_with(estimator=kind)))


class Forgetful(Plain):
    """A scheme whose third estimator is off by one where it takes blocks."""

    made = 0

    def estimator(self, keys: Any, batch: Any) -> Any:
        """The next one."""
        del keys
        self.made += 1
        kind = Follows if self.made < 3 else type("Sure", (Follows,), {"spoil": staticmethod(FOLLOWS["Sure"][0])})
        return kind(self.process, batch.trials)


def test_a_scheme_keeps_nothing_from_one_estimator_to_the_next() -> None:
    """All that are asked for blocks are of one scheme."""
    assert " by Sure.follow() of slot" in str(blocks_of_scheme(Forgetful))


class Counts(PacketReader):
    """Uses a packet after two lost ones, and forgets between blocks how many were lost."""

    keeps = True

    @classmethod
    def follows_gamma(cls, parameters: Any) -> bool:
        """Its actions depend on earlier slots."""
        del parameters
        return False

    def prior(self, first: int = 0) -> Belief:
        """None are lost."""
        return super().prior(first)._replace(memory=(np.zeros(self.trials, np.int64),))

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """With the count in its memory."""
        (lost,) = belief.memory
        action = heard.gamma.astype(np.uint8) * np.where(lost >= 2, 1, 3).astype(np.uint8)
        after = update.belief(self.process, k, belief, action, heard.z)
        return after._replace(memory=(np.where(heard.gamma, 0, lost + 1),))

    def follow(self, slots: range, belief: Belief, gamma: Flags, z: Floats) -> tuple[Beliefs, Belief]:
        """The same, with a memory after the last slot or a new one."""
        beliefs = Beliefs.empty(z.shape)
        for row, k in enumerate(slots):
            belief = self.step(k, belief, Reception(gamma[row], z[row]))
            beliefs.put(row, belief)
        return beliefs, belief if self.keeps else belief._replace(memory=self.prior().memory)


class Forgets(Counts):
    """Forgets between blocks."""

    keeps = False


def test_the_memory_after_a_block_is_that_of_its_last_slot() -> None:
    """An eavesdropper may take blocks as it may take slots; what it remembers must outlive a block."""
    assert blocks_of_eavesdropper(Counts) is None
    text = str(blocks_of_eavesdropper(Forgets))
    assert ": Belief." in text
    assert " by Forgets.follow() of slot" in text


class Even(PacketTaker):
    """Uses the packets of even slots."""

    @classmethod
    def use_probabilities(cls, parameters: Any) -> tuple[float, float]:
        """Half of them."""
        del parameters
        return 0.5, 0.5

    @classmethod
    def outcomes(cls, parameters: Any, mu_d: float) -> None:
        """No closed form, because slots differ."""

    def uses(self, k: int) -> Flags | None:
        """In even slots, always."""
        return None if k % 2 == 0 else np.zeros(self.trials, np.bool_)


class EvenBlocks(Even):
    """The same in blocks."""

    def uses_block(self, slots: range) -> Any:
        """Every second row."""
        even = np.arange(slots.start, slots.stop) % 2 == 0
        return np.repeat(even[:, None], self.trials, axis=1)


class Odd(EvenBlocks):
    """Others in blocks."""

    def uses_block(self, slots: range) -> Any:
        """Every other row."""
        return ~super().uses_block(slots)


class Broad(EvenBlocks):
    """One flag for all trials of a slot."""

    def uses_block(self, slots: range) -> Any:
        """A column."""
        return super().uses_block(slots)[:, :1]


class Numbered(EvenBlocks):
    """Numbers in place of flags."""

    def uses_block(self, slots: range) -> Any:
        """0 and 1."""
        return super().uses_block(slots).astype(np.uint8)


class Always(EvenBlocks):
    """In blocks, every packet."""

    def uses_block(self, slots: range) -> Any:
        """Always."""
        del slots


class Refuses(EvenBlocks):
    """No blocks."""

    def uses_block(self, slots: range) -> Any:
        """An error."""
        raise NotImplementedError(slots)


USES: dict[type[PacketTaker], str] = {
    Odd: "by Odd.follow() of slots 0 to 8; ",
    Broad: "slots 0 to 8: Broad.uses_block() has shape (9, 1); expected (9, 4): slots, R trials; or None: always",
    Numbered: "slots 0 to 8: Numbered.uses_block() has type uint8; expected bool",
    Always: "slot 1, trial ",
    Refuses: "Refuses.follow() raised NotImplementedError: range(0, 9)",
}


@pytest.mark.parametrize("kind", USES)
def test_a_taker_whose_blocks_are_wrong_is_told_how(kind: type[PacketTaker]) -> None:
    """The flags of a block are compared with those of single slots."""
    assert USES[kind] in str(blocks_of_eavesdropper(kind))


@pytest.mark.parametrize("kind", [Even, EvenBlocks])
def test_a_taker_may_use_every_packet_of_some_slots(kind: type[PacketTaker]) -> None:
    """`None` means always in its slot, and says nothing of the other slots of a block."""
    assert blocks_of_eavesdropper(kind) is None


class Told(Naive):
    """Learns a state in one slot, and takes blocks that do not contain this slot."""

    @classmethod
    def betrayed(cls, parameters: Any) -> int | None:
        """Slot 6."""
        del parameters
        return 6

    @classmethod
    def follows_gamma(cls, parameters: Any) -> bool:
        """It knows more in that slot."""
        del parameters
        return False

    @classmethod
    def outcomes(cls, parameters: Any, mu_d: float) -> None:
        """No closed form."""

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """The state itself where it is told."""
        after = super().step(k, belief, heard)
        return after if heard.truth is None else self.knowing(k, heard.truth, after)

    def follow(self, slots: range, belief: Belief, gamma: Flags, z: Floats) -> tuple[Beliefs, Belief]:
        """Without what it is told."""
        assert 6 not in slots
        action: Codes = gamma.astype(np.uint8)
        beliefs = update.beliefs(self.process, slots.start, belief, action, z)
        return beliefs, beliefs.last


def test_a_block_with_a_betrayed_state_is_taken_slot_by_slot() -> None:
    """As in a run."""
    assert blocks_of_eavesdropper(Told) is None


def test_the_rule_is_one_of_those_that_are_checked() -> None:
    """An eavesdropper whose blocks are right keeps it; one whose blocks are wrong breaks this rule alone."""
    right, wrong = (checks_of(kind).verdicts() for kind in (EvenBlocks, Odd))
    assert "many slots at once" in [verdict.rule for verdict in right]
    assert "many slots at once" not in broken(right)
    assert broken(wrong).keys() - broken(right).keys() == {"many slots at once"}


def test_divisions_cover_all_slots_and_cross_the_blocks_in_which_streams_are_read() -> None:
    """One block, single slots, and lengths of which some end beyond slot 256."""

    def slots_of(blocks: list[range]) -> Iterator[int]:
        return (k for block in blocks for k in block)

    for slots in (1, 4, 9, 300):
        assert all(list(slots_of(blocks)) == list(range(slots)) for blocks in divisions(slots))
        assert all(all(blocks) for blocks in divisions(slots))
    whole, single, uneven = divisions(300)
    assert (len(whole), len(single)) == (1, 300)
    assert {len(block) for block in uneven} > {1, 2, 3, 70}
    assert any(block.start < 256 < block.stop - 1 for block in uneven)
