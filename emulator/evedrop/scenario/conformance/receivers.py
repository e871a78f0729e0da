"""Rules for every receiver, the legitimate estimator and eavesdroppers alike, and the rule for many slots at once.

Blocks of slots give the same bits as single slots, wherever the blocks begin; a scheme's encoder keeps this rule, too.

Source: docs/your-own/rules.md, many slots at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, cycle, pairwise, takewhile
from typing import Any, ClassVar

import numpy as np

from evedrop.model import update
from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.packet_user import PacketUser
from evedrop.model.receiver import Action, Belief, Beliefs, Receiver
from evedrop.model.schemes.scheme import Encoder, PacketBlock, Scheme
from evedrop.model.theory.covariances import OutcomesAt, TheoreticalCovariance
from evedrop.scenario.conformance.problems import (
    QUALITY,
    Problem,
    Slot,
    expect_belief,
    expect_beliefs,
    expect_packets,
    frozen_belief,
    row_of,
    sent_of,
    sides,
    slots_text,
)
from evedrop.scenario.conformance.rules import Broken, Row, calling, expect_array, expect_same, frozen

SIGMAS = 6.0
"""Standard deviations allowed for chance."""
_SLACK = 0.02
_COLUMN = (
    "compute each trial from its own column alone: no sum over trials, no `@` or other BLAS, random numbers by the "
    "batch's trials"
)


class ReceiverChecks(ABC):
    """The rules that schemes and eavesdroppers share, each checked on one problem. kind: the class that is checked."""

    state: ClassVar[str]
    """What to do if another one of its kind makes a difference."""
    actions_remedy: ClassVar[str]
    """What to do if actions depend on more than γ."""
    theory_remedy = "correct them, or return None: no closed form"
    """What to do if its errors contradict the outcomes that it states."""

    def __init__(self, kind: type) -> None:
        self._kind = kind
        self._slots: dict[int, tuple[Problem, list[Slot]]] = {}
        """The slots of a problem, by its id."""

    @abstractmethod
    def played(self, problem: Problem, *, rubbish: float = 0.0) -> Iterator[Slot]:
        """Every slot of a problem, with the receiver's beliefs; rubbish: the value that it finds in place of a lost packet."""

    @abstractmethod
    def row(self, slot: Slot) -> Row:
        """Everything in a slot that is compared."""

    @abstractmethod
    def receiver(self, problem: Problem) -> Receiver:
        """A new receiver for a problem."""

    @abstractmethod
    def follows_gamma(self, problem: Problem) -> bool:
        """Whether γ alone determines the receiver's actions, as the class states."""

    @abstractmethod
    def outcomes_at(self, problem: Problem) -> OutcomesAt | None:
        """The outcomes that the class states; None if it states none."""

    @abstractmethod
    def shapes(self, problem: Problem) -> None:
        """All results have the right shapes and types, and no input is changed."""

    def blocks(self, problem: Problem) -> None:
        """Blocks of slots give the same results as single slots."""
        BlockChecks(self.slots(problem), problem, self._kind).expect_same_beliefs(lambda: self.receiver(problem))

    def slots(self, problem: Problem) -> list[Slot]:
        """The slots of `played`, computed once for all rules that compare something with them."""
        if id(problem) not in self._slots:
            self._slots[id(problem)] = (problem, list(self.played(problem)))
        return self._slots[id(problem)][1]

    def at_first(self, problem: Problem) -> None:
        """The rules that a dry run checks: shapes, types and blocks of slots."""
        self.shapes(problem)
        self.blocks(problem)

    def twice(self, problem: Problem) -> None:
        """Two that take turns do the same as one alone."""
        words = "{0!r} by itself and {1!r} with another one of its kind"
        for slots in zip(*zip(self.played(problem), self.played(problem), strict=True), strict=True):
            self._expect_same(problem, slots, words, self.state)

    def alone(self, problem: Problem) -> None:
        """A trial alone gives the same bits as among others."""
        words = f"{{0!r}} among {problem.batch.trials} trials and {{1!r}} alone"
        for trial in (0, problem.batch.trials - 1):
            by_itself = self.played(problem.part(trial, 1))
            self._expect_same(problem, by_itself, words, _COLUMN, slice(trial, trial + 1))

    def lost(self, problem: Problem) -> None:
        """The value in place of a lost packet changes nothing."""
        words = "{0!r} or {1!r}, depending on z where nothing was received"
        remedy = "look at z where gamma is true alone, such as by np.where(heard.gamma, …)"
        self._expect_same(problem, self.played(problem, rubbish=1e30), words, remedy)

    def _expect_same(
        self, problem: Problem, slots: Iterable[Slot], words: str, remedy: str, trials: slice = slice(0, None)
    ) -> None:
        """Raise Broken unless these slots are those of `played`; the rest as for `expect_same`."""
        once, again = ([self.row(slot) for slot in some] for some in (self.slots(problem), slots))
        expect_same(once, again, trials, problem.batch.first_trial + trials.start, words, remedy)

    def again(self, problem: Problem) -> None:
        """The receiver, asked for slots backwards, answers as before, and has a prior for every slot."""
        receiver, slots, rows = self.receiver(problem), self.slots(problem), []
        for slot in reversed(slots):
            with calling(f"slot {slot.k}: step(), asked for again after later slots,", self._kind):
                belief = receiver.step(slot.k, slot.before, slot.heard)
            expect_belief(f"slot {slot.k}: Belief", belief, problem)
            rows.append(row_of(belief))
        words = "{0!r} at first and {1!r} when the slot is asked for again"
        remedy = "keep what a receiver remembers in Belief.memory, and nothing in itself"
        once = [row_of(slot.after) for slot in slots]
        expect_same(once, rows[::-1], slice(None), problem.batch.first_trial, words, remedy)
        with calling("prior(first=3)", self._kind):
            expect_belief("prior(first=3): Belief", receiver.prior(3), problem)

    def actions(self, problem: Problem) -> None:
        """If γ alone determines actions, `act` predicts from it what `step` does, and the covariance follows from that."""
        if not self.follows_gamma(problem):
            return
        receiver = self.receiver(problem)
        for slot in self.slots(problem):
            k, gamma, after = slot.k, slot.heard.gamma, slot.after
            with calling(f"slot {k}: act()", self._kind):
                action = receiver.act(k, gamma)
            expect_array(f"slot {k}: act()", action, np.uint8, gamma.shape, "an `Action` for each of the R trials")
            other = action != after.action
            if other.any():
                at = int(np.argmax(other))
                contradiction = f"act() says {_action_name(action[at])} and step() did {_action_name(after.action[at])}"
                raise Broken(
                    f"slot {k}, trial {problem.batch.first_trial + at}: {contradiction}; make them agree, or "
                    f"{self.actions_remedy}"
                )
            P = update.reported_covariance(problem.process, k, slot.before.P, action)
            unlike = (P != after.P).any(axis=(0, 1))
            if unlike.any():
                at = int(np.argmax(unlike))
                raise Broken(
                    f"slot {k}, trial {problem.batch.first_trial + at}: Belief.P after {_action_name(action[at])} is not that "
                    f"of update.reported_covariance; use that function, or {self.actions_remedy}"
                )

    def theory(self, problem: Problem) -> None:
        """The outcomes that the class states are the observed ones, if it states any: errors contradict them only by chance."""
        outcomes_at = self.outcomes_at(problem)
        if outcomes_at is None:
            return
        slots = self.slots(problem)
        outcomes = outcomes_at(QUALITY)
        parts = (outcomes.predicted, outcomes.decoded, outcomes.leaked, outcomes.state, outcomes.misled)
        if abs(sum_in_order(parts) - 1.0) > 1e-9 or min(parts) < 0.0:
            raise Broken(
                f"outcomes sum to {sum_in_order(parts):.6g}, the least is {min(parts):.3g}; expected probabilities that sum "
                "to 1"
            )
        expected = TheoreticalCovariance(problem.process, outcomes).next_traces(len(slots))
        for slot, trace in zip(slots, expected.tolist(), strict=True):
            error = slot.squared_error
            chance = SIGMAS * float(error.std()) / float(np.sqrt(len(error))) + _SLACK * trace + 1e-9
            if abs(float(error.mean()) - trace) > chance:
                raise Broken(
                    f"slot {slot.k}: the mean squared error is {error.mean():.4g}, and outcomes say {trace:.4g}; "
                    f"{self.theory_remedy}"
                )


def _action_name(action: int) -> str:
    return Action(action).name if int(action) in set(Action) else str(int(action))


_LENGTHS = (1, 3, 2, 7, 70)
_REMEDY = "let a slot's numbers depend neither on its block nor on what was asked for before"

_Followed = tuple[range, Beliefs, Belief]
"""Consecutive slots, the beliefs after each of them, and the belief after the last."""


def divisions(slots: int) -> list[list[range]]:
    """Divisions of slots 0 … slots − 1 into blocks: one block, single slots, and blocks of different lengths."""
    edges = [0, *takewhile(lambda edge: edge < slots, accumulate(cycle(_LENGTHS))), slots]
    return [
        [range(slots)],
        [range(k, k + 1) for k in range(slots)],
        [range(start, stop) for start, stop in pairwise(edges)],
    ]


@dataclass(frozen=True)
class BlockChecks:
    """The rule for many slots at once on one problem. kind: the class that is checked."""

    slots: Sequence[Slot]
    """What single slots give."""
    problem: Problem
    kind: type

    def expect_same_sides(self, scheme: Scheme) -> None:
        """Raise Broken unless both sides of a scheme do in blocks what they do in single slots, made together and apart."""
        for apart in (False, True):
            for blocks in divisions(self.problem.slots):
                encoder, estimator = sides(scheme, self.problem, self.kind, apart)
                if apart and type(encoder).encode_block is Encoder.encode_block:
                    continue  # it cannot know of blocks, and the estimator alone is next
                packets: list[tuple[range, PacketBlock]] = []
                followed: list[_Followed] = []
                belief = self.slots[0].before
                for block in blocks:
                    # The next packet may depend on the acknowledgements of this one.
                    for some in [range(k, k + 1) for k in block] if scheme.needs_acknowledgements else [block]:
                        packets.append((some, self._encoded(encoder, some, scheme)))
                    if self._plain(block):
                        followed.append(self._followed(estimator, block, belief))
                        belief = frozen_belief(followed[-1][2])
                self._expect_same_packets(encoder, packets)
                self._expect_same_beliefs(estimator, followed)

    def expect_same_beliefs(self, make: Callable[[], Receiver]) -> None:
        """Raise Broken unless receivers, made by `make` for each division into blocks, have the same beliefs in all."""
        whole, single, uneven = divisions(self.problem.slots)
        for blocks, every in ((whole, 1), (single, 1), (uneven, 1), (uneven, 2)):
            receiver = make()
            if type(receiver).follow is Receiver.follow:
                return  # which takes slot by slot
            self._expect_same_beliefs(receiver, list(self._in_order(receiver, blocks, every)))
            self._expect_same_uses(receiver, blocks)
        receiver = make()
        plain = [block for block in reversed(uneven) if self._plain(block)]
        again = [self._followed(receiver, block, self.slots[block.start].before) for block in plain]
        self._expect_same_beliefs(receiver, again)

    def _plain(self, block: range) -> bool:
        """Whether nothing but packets is heard in a block, as where a run takes its slots at once."""
        return all(self.slots[k].heard.header is None and self.slots[k].heard.truth is None for k in block)

    def _in_order(self, receiver: Receiver, blocks: list[range], every: int) -> Iterator[_Followed]:
        """The beliefs of a receiver after blocks, one after the other; only one block in `every` is taken at once."""
        belief = self.slots[0].before
        for number, block in enumerate(blocks):
            if number % every == 0 and self._plain(block):
                yield (followed := self._followed(receiver, block, belief))
                belief = frozen_belief(followed[2])
            else:
                for k in block:
                    with calling(f"slot {k}: {_method_name(receiver, 'step')} after a block of slots", self.kind):
                        belief = frozen_belief(receiver.step(k, belief, self.slots[k].heard))

    def _encoded(self, encoder: Encoder, some: range, scheme: Scheme) -> PacketBlock:
        x, predicted = (frozen(np.array([getattr(self.slots[k], name) for k in some])) for name in ("x", "predicted"))
        with calling(f"{slots_text(some)}: {_method_name(encoder, 'encode_block')}", self.kind):
            packets = encoder.encode_block(some, x, predicted)
        expect_packets(some, packets, scheme, self.problem)
        if scheme.needs_acknowledgements:
            for k in some:
                with calling(f"slot {k}: {_method_name(encoder, 'acknowledged')}", self.kind):
                    encoder.acknowledged(k, frozen(self.slots[k].acknowledged))
        return packets

    def _followed(self, receiver: Receiver, some: range, belief: Belief) -> _Followed:
        gamma, z = (frozen(np.array([getattr(self.slots[k].heard, name) for k in some])) for name in ("gamma", "z"))
        with calling(f"{slots_text(some)}: {_method_name(receiver, 'follow')}", self.kind):
            result: Any = receiver.follow(some, belief, gamma, z)
        expect_beliefs(some, result, gamma, self.problem)
        return some, *result

    def _expect_same_packets(self, encoder: Encoder, coded: Sequence[tuple[range, PacketBlock]]) -> None:
        for some, packets in coded:
            rows = [sent_of(packets.at(row)) for row in range(len(some))]
            once = [sent_of(self.slots[k].packet) for k in some]
            self._expect_same(once, rows, some, _method_name(encoder, "encode_block"))

    def _expect_same_beliefs(self, receiver: Receiver, followed: Sequence[_Followed]) -> None:
        name = _method_name(receiver, "follow")
        for some, beliefs, after in followed:
            rows = [row_of(Belief(*(column[row] for column in beliefs))) for row in range(len(some))]
            once = [row_of(self.slots[k].after) for k in some]
            self._expect_same(once, rows, some, name)
            self._expect_same(once[-1:], [row_of(after)], some[-1:], f"the last Belief of {name}")

    def _expect_same_uses(self, receiver: Receiver, blocks: list[range]) -> None:
        """Raise Broken unless `uses_block` is `uses`, slot by slot, also where nothing arrives."""
        if not isinstance(receiver, PacketUser) or type(receiver).uses_block is PacketUser.uses_block:
            return
        every = np.ones(self.problem.batch.trials, np.bool_)
        for some in blocks:
            name = _method_name(receiver, "uses_block")
            with calling(f"{slots_text(some)}: {name}", self.kind):
                uses, single = receiver.uses_block(some), [receiver.uses(k) for k in some]
            if uses is not None:
                shape = (len(some), self.problem.batch.trials)
                expect_array(f"{slots_text(some)}: {name}", uses, np.bool_, shape, "slots, R trials; or None: always")
            rows = [{"whether a packet is used": every if uses is None else uses[row]} for row in range(len(some))]
            once = [{"whether a packet is used": every if use is None else use} for use in single]
            self._expect_same(once, rows, some, name)

    def _expect_same(self, once: Sequence[Row], rows: Sequence[Row], some: range, name: str) -> None:
        message = f"{{0!r}} in a single slot and {{1!r}} by {name} of {slots_text(some)}"
        expect_same(once, rows, slice(None), self.problem.batch.first_trial, message, _REMEDY, some.start)


def _method_name(instance: object, method: str) -> str:
    """A method of a class that takes many slots at once; if the class has only the inherited one, its method for one slot."""
    for base, block, single in ((Encoder, "encode_block", "encode"), (Receiver, "follow", "step")):
        if method == block and getattr(type(instance), block) is getattr(base, block):
            return f"{type(instance).__name__}.{single}()"
    return f"{type(instance).__name__}.{method}()"
