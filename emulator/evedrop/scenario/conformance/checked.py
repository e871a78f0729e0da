"""Checks the results of classes that are not built in while a run is in progress, live and in memory.

A dry run calls these classes for the first slots only (`evedrop.scenario.dry_run`). An error or a wrong result in any later slot
ends the run, and the message names class, slots and trials.

Source: docs/your-own/rules.md, mistakes.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping
from typing import Any, final

import numpy as np

from evedrop.errors import ClassFailed
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.links import LOSS_MODELS, single_specs
from evedrop.model.links.loss_model import Fate
from evedrop.model.packet_user import PacketUser
from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Beliefs, Codes, Flags, Receiver, Reception
from evedrop.model.registry import CLASS_ERRORS, place_of
from evedrop.model.schemes import SCHEMES
from evedrop.model.schemes.scheme import Encoder, Packet, PacketBlock, Scheme
from evedrop.model.slot.link import LinkSchedule
from evedrop.model.slot.link_core import LinkCore
from evedrop.model.streams import Batch
from evedrop.scenario.conformance.problems import (
    Problem,
    expect_actions,
    expect_belief,
    expect_beliefs,
    expect_packet,
    expect_packets,
    slots_text,
)
from evedrop.scenario.conformance.rules import (
    Broken,
    changes_in_place,
    expect_array,
    is_about_read_only,
    read_only,
)


def failed(subject: str, slots: range, batch: Batch, how: str) -> ClassFailed:
    """The error of a class that failed in consecutive slots; what: such as `the scheme mine:Mine`."""
    first = batch.first_trial
    trials = f"trial {first}" if batch.trials == 1 else f"trials {first} to {first + batch.trials - 1}"
    reason = how.removeprefix(f"{slots_text(slots)}: ")
    return ClassFailed(f"{subject} failed in {slots_text(slots)}, {trials}: {reason}; run `evedrop check` on the class")


@contextlib.contextmanager
def asking(subject: str, slots: range, batch: Batch, instance: object = None) -> Iterator[None]:
    """Turn an error in consecutive slots into a RunError that names the class, the slots and the trials.

    what: as for `failed`; one: the object that is called, whose module the message quotes a line of.
    """
    try:
        yield
    except ClassFailed:  # named already
        raise
    except Broken as error:
        raise failed(subject, slots, batch, str(error)) from error
    except CLASS_ERRORS as error:
        reason = place_of(error, _file_of(type(instance)))
        how = f"it {changes_in_place(reason)}" if is_about_read_only(error) else reason
        raise failed(subject, slots, batch, how) from error


def _file_of(kind: type) -> str | None:
    """The file of a class that is not built in; None for any other."""
    if kind.__module__.partition(".")[0] in {"evedrop", "builtins"}:
        return None
    return getattr(sys.modules.get(kind.__module__), "__file__", None)


@final
class CheckedEncoder(Encoder):
    """An encoder whose packets are all checked. Raises RunError for a wrong one, and for any error of the encoder's class."""

    def __init__(self, encoder: Encoder, subject: str, scheme: Scheme, problem: Problem) -> None:
        self._encoder, self._what, self._scheme, self._problem = encoder, subject, scheme, problem

    def _asking(self, slots: range) -> contextlib.AbstractContextManager[None]:
        return asking(self._what, slots, self._problem.batch, self._encoder)

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """The encoder's packet."""
        with self._asking(range(k, k + 1)):
            packet = self._encoder.encode(k, read_only(x), read_only(predicted))
            expect_packet(k, packet, self._scheme, self._problem)
        return packet

    def encode_block(self, slots: range, x: Floats, predicted: Floats) -> PacketBlock:
        """The encoder's packets; those of a class that makes one at a time are checked one at a time."""
        if type(self._encoder).encode_block is Encoder.encode_block:
            return super().encode_block(slots, x, predicted)
        with self._asking(slots):
            packets = self._encoder.encode_block(slots, read_only(x), read_only(predicted))
            expect_packets(slots, packets, self._scheme, self._problem)
        return packets

    def acknowledged(self, k: int, acknowledged: Flags) -> None:
        """Pass the acknowledgements on to the encoder."""
        with self._asking(range(k, k + 1)):
            self._encoder.acknowledged(k, read_only(acknowledged))


@final
class CheckedLink:
    """Plans a link. Raises ClassFailed for any error, wrong fate or wrong delay of a model that is not built in."""

    def __init__(self, receiver: str, core: LinkCore, schedule: LinkSchedule, batch: Batch) -> None:
        self._core, self._batch = core, batch
        self._models = list(_foreign_models_of(schedule))
        self._what = f"{receiver}'s link ({', '.join(self._models)})"

    def plan(self, slots: range) -> None:
        """Decide the fates of the packets of the next slots."""
        if not self._models:
            self._core.plan(slots)
            return
        with asking(self._what, slots, self._batch):
            self._core.plan(slots)
            codes = self._core.fates.codes
            expect_array("fates()", codes, np.uint8, (len(slots), self._batch.trials), "slots, R trials")
            if codes.size and int(codes.max()) > max(Fate):
                raise Broken(f"fates(): one is {int(codes.max())}; expected Fate.DELIVERED or Fate.LOST")


def _foreign_models_of(schedule: LinkSchedule) -> Iterator[str]:
    """The names of a link's models that are not built in, at first and after changes."""
    for settings in (schedule.settings, *(change.settings or {} for change in schedule.changes)):
        loss, delay = settings.get("loss"), settings.get("delay")
        losses = [spec["model"] for spec in single_specs(loss)] if loss else []
        yield from filter(LOSS_MODELS.foreign, losses)
        if delay and DELAY_MODELS.foreign(delay["model"]):
            yield delay["model"]


@final
class CheckedReceiver(Receiver):
    """A receiver whose beliefs are all checked. Raises RunError for a wrong one, and for any error of the receiver's class."""

    def __init__(self, receiver: Receiver, subject: str, problem: Problem) -> None:
        super().__init__(problem.process, problem.batch.trials)
        self._receiver, self._what, self._problem = receiver, subject, problem

    def _asking(self, slots: range) -> contextlib.AbstractContextManager[None]:
        return asking(self._what, slots, self._problem.batch, self._receiver)

    def prior(self, first: int = 0) -> Belief:
        """The receiver's prior."""
        with self._asking(range(first, first + 1)):
            belief = self._receiver.prior(first)
            expect_belief("prior(): Belief", belief, self._problem)
        return belief

    def act(self, k: int, gamma: Flags) -> Codes:
        """The receiver's action."""
        return self._receiver.act(k, gamma)

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """The receiver's belief."""
        with self._asking(range(k, k + 1)):
            after = self._receiver.step(k, _read_only_belief(belief), _read_only_reception(heard))
            expect_belief(f"slot {k}: Belief", after, self._problem)
            expect_actions(range(k, k + 1), after.action[None], heard.gamma[None], self._problem)
        return after

    def follow(self, slots: range, belief: Belief, gamma: Flags, z: Floats) -> tuple[Beliefs, Belief]:
        """The receiver's beliefs; those of a class that is written for one slot at a time are checked one at a time."""
        if _takes_single_slots(type(self._receiver)):
            return super().follow(slots, belief, gamma, z)
        with self._asking(slots):
            followed = self._receiver.follow(slots, _read_only_belief(belief), read_only(gamma), read_only(z))
            expect_beliefs(slots, followed, gamma, self._problem)
        return followed


def _read_only_reception(heard: Reception) -> Reception:
    """The same packets: what a receiver changed in place would be changed for others, too."""
    header, truth = (None if array is None else read_only(array) for array in (heard.header, heard.truth))
    return Reception(read_only(heard.gamma), read_only(heard.z), header, truth)


def _read_only_belief(belief: Belief) -> Belief:
    """The same belief, for the same reason."""
    x_hat, P, action, memory = belief
    return Belief(read_only(x_hat), read_only(P), read_only(action), tuple(map(read_only, memory)))


def _takes_single_slots(kind: type[Receiver]) -> bool:
    """Whether a class inherits everything that takes many slots at once, so that an error in it belongs to one slot."""
    if issubclass(kind, PacketUser) and kind.follow is PacketUser.follow:
        return kind.uses_block is PacketUser.uses_block
    return kind.follow is Receiver.follow


def scheme_in_words(name: str) -> str:
    """A scheme's class, as messages name it."""
    return f"the scheme {name}"


def eavesdropper_in_words(eavesdropper: str, strategy: str, parameters: Mapping[str, Any]) -> str:
    """An eavesdropper's class, as messages name it: its strategy's, or that of the strategy that it reads as."""
    used = parameters.get("reads_as", strategy)
    return f"{eavesdropper}'s strategy {strategy if STRATEGIES.foreign(strategy) else used}"


def checked_encoder(encoder: Encoder, name: str, scheme: Scheme, problem: Problem) -> Encoder:
    """The encoder of the scheme of a name, with checks if its class is not built in."""
    return CheckedEncoder(encoder, scheme_in_words(name), scheme, problem) if SCHEMES.foreign(name) else encoder


def checked_estimator(estimator: Receiver, name: str, problem: Problem) -> Receiver:
    """The estimator of the scheme of a name, with checks if its class is not built in."""
    return CheckedReceiver(estimator, scheme_in_words(name), problem) if SCHEMES.foreign(name) else estimator


def checked_eavesdropper(
    receiver: Receiver, eavesdropper: str, strategy: str, parameters: Mapping[str, Any], problem: Problem
) -> Receiver:
    """An eavesdropper, with checks if its class, or that of the strategy that it reads as, is not built in."""
    if not is_foreign(strategy, parameters):
        return receiver
    return CheckedReceiver(receiver, eavesdropper_in_words(eavesdropper, strategy, parameters), problem)


def is_foreign(strategy: str, parameters: Mapping[str, Any]) -> bool:
    """Whether a strategy's class, or that of the strategy that it reads as, is not built in."""
    used = parameters.get("reads_as")
    return STRATEGIES.foreign(strategy) or (used is not None and STRATEGIES.foreign(str(used)))
