"""Small problems on which classes are checked, and a scheme's run on one of them.

A problem has a process, slots, trials, and the packets that are heard. A run has the packets of the scheme and the beliefs of its
estimator, slot by slot.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from evedrop.counting import counted
from evedrop.model.process import Floats, Process, Trajectory
from evedrop.model.receiver import Action, Belief, Beliefs, Codes, Flags, Receiver, Reception, asymmetry
from evedrop.model.schemes.scheme import Encoder, Packet, PacketBlock, Scheme
from evedrop.model.streams import Batch, BlockReader
from evedrop.scenario.conformance.rules import Broken, NamedKeys, calling, expect_array, expect_finite, frozen, key

QUALITY = 0.7
"""The link quality of every problem."""


@dataclass(frozen=True)
class Problem:
    """One small problem."""

    process: Process
    batch: Batch

    def __str__(self) -> str:
        return (
            f"{counted(self.process.n, 'state')}, spectral radius {self.process.spectral_radius:.2g}, "
            f"{counted(self.batch.trials, 'trial')}"
        )

    def part(self, first: int, trials: int) -> Problem:
        """The problem with only some of its trials; first: counted from the problem's own first trial."""
        return replace(self, batch=Batch(self.batch.slots, trials, self.batch.first_trial + first))

    @property
    def slots(self) -> int:
        """The number of slots."""
        return self.batch.slots

    def coins(self, name: str, quality: float = QUALITY) -> Flags:
        """True with this probability in every slot and trial, (slots, R), independently of which other trials there are."""
        reader = BlockReader(key(f"coins/{name}"), self.batch, 1)
        return np.asarray(reader.uniforms(range(self.slots))[:, 0, :] < quality)

    @cached_property
    def gamma(self) -> Flags:
        """Whether the receiver hears the packet of each slot, (slots, R)."""
        return self.coins("gamma")


def _process(number: int, n: int, radius: float) -> Process:
    """A random process of n states whose A has this spectral radius."""
    random = np.random.default_rng(number)
    A = random.normal(size=(n, n))
    A *= radius / np.max(np.abs(np.linalg.eigvals(A)))
    root, start = random.normal(size=(2, n, n))
    return Process(A, 0.1 * (root @ root.T) + 0.05 * np.eye(n), start @ start.T + 0.2 * np.eye(n))


def small(slots: int = 0) -> list[Problem]:
    """Problems of 1 to 3 states with decaying, constant and growing processes, with at least `slots` slots.

    The last one crosses the ends of blocks in which streams are read ahead, and its trials have large numbers.
    """
    shapes = ((1, 0.8, 9, 4, 0), (2, 1.0, 12, 5, 3), (3, 1.1, 10, 3, 1000), (1, 0.95, 260, 2, 2**40))
    return [
        Problem(_process(number, n, radius), Batch(max(least, slots), trials, first))
        for number, (n, radius, least, trials, first) in enumerate(shapes)
    ]


def large() -> list[Problem]:
    """Problems with many trials, for statements about means."""
    return [Problem(_process(number, n, 0.9), Batch(10, 600)) for number, n in ((10, 1), (11, 2))]


_TRIALS = "one for each of the R trials"


@dataclass(frozen=True)
class Slot:
    """One slot."""

    k: int
    x: Any
    """The state, (n, R)."""
    predicted: Any
    """A x of the slot before, (n, R)."""
    packet: Packet
    heard: Reception
    acknowledged: Any
    """The acknowledgements that reach the sensor, (R,)."""
    before: Belief
    after: Belief

    @property
    def squared_error(self) -> Floats:
        """The squared error of the belief after it, (R,)."""
        return np.asarray(((self.x - self.after.x_hat) ** 2).sum(axis=0))


def sent_of(packet: Packet) -> dict[str, Any]:
    """The parts of a packet that are compared."""
    columns = {f"Packet.{name}": column for name, column in zip(Packet._fields, packet, strict=True)}
    return {name: column for name, column in columns.items() if column is not None}


def frozen_belief(belief: Belief) -> Belief:
    """A read-only copy."""
    memory = tuple(frozen(part) for part in belief.memory)
    return Belief(frozen(belief.x_hat), frozen(belief.P), frozen(belief.action), memory)


def row_of(belief: Belief) -> dict[str, Any]:
    """The parts of a belief that are compared. Its memory may depend on other trials."""
    return {"Belief.x_hat": belief.x_hat, "Belief.P": belief.P, "Belief.action": belief.action}


def made(kind: type[Scheme], parameters: Mapping[str, Any], problem: Problem) -> Scheme:
    """The scheme of a class for a problem's process."""
    with calling(f"{kind.__name__}(process, …)", kind):
        return kind(problem.process, **parameters)


def played(
    kind: type[Scheme],
    parameters: Mapping[str, Any],
    problem: Problem,
    *,
    apart: bool = False,
    rubbish: float = 0.0,
) -> Iterator[Slot]:
    """Every slot of a problem.

    apart: sensor and estimator are made separately, as in processes of their own; rubbish: the value that a receiver finds in
    place of a lost packet. Everything passed in is read-only; everything returned is checked.
    """
    scheme, batch, n = made(kind, parameters, problem), problem.batch, problem.process.n
    encoder, estimator = sides(scheme, problem, kind, apart)
    with calling("initial_state()", kind):
        initial = scheme.initial_state(NamedKeys.of(scheme.secret_streams), batch)
    if initial is not None:
        expect_array("initial_state()", initial, np.float64, (n, batch.trials), "n states, R trials")
    trajectory = Trajectory(problem.process, key("process"), batch, initial)
    back = problem.coins("acknowledgements")
    with calling("Receiver.prior()", kind):
        belief = estimator.prior()
    expect_belief("prior(): Belief", belief, problem)
    for k in range(batch.slots):
        x, predicted = frozen(trajectory.advance()), frozen(trajectory.predicted)
        with calling(f"slot {k}: encode()", kind):
            packet = encoder.encode(k, x, predicted)
        expect_packet(k, packet, scheme, problem)
        heard = heard_of(packet, problem.gamma[k], rubbish)
        acknowledged = frozen(heard.gamma & back[k])
        if scheme.needs_acknowledgements:
            with calling(f"slot {k}: acknowledged()", kind):
                encoder.acknowledged(k, acknowledged)
        with calling(f"slot {k}: step()", kind):
            after = estimator.step(k, belief, heard)
        expect_belief(f"slot {k}: Belief", after, problem)
        expect_actions(range(k, k + 1), after.action[None], heard.gamma[None], problem)
        after = frozen_belief(after)
        yield Slot(k, x, predicted, packet, heard, acknowledged, belief, after)
        belief = after


def sides(scheme: Scheme, problem: Problem, kind: type[Scheme], apart: bool) -> tuple[Encoder, Receiver]:
    """A scheme's encoder and estimator, made separately or from what they share. Raises Broken if they are neither."""
    secret, held = NamedKeys.of(scheme.secret_streams), NamedKeys.of(scheme.estimator_streams)
    if apart:
        with calling("encoder()", kind):
            encoder = scheme.encoder(secret, problem.batch)
        with calling("estimator(), given the keys of estimator_streams alone,", kind):
            estimator = scheme.estimator(held, problem.batch)
    else:
        with calling("shared()", kind):
            shared = scheme.shared(secret, problem.batch)
        with calling("encoder() of what is shared", kind):
            encoder = shared.encoder()
        with calling("estimator() of what is shared", kind):
            estimator = shared.estimator()
    if not isinstance(encoder, Encoder) or not isinstance(estimator, Receiver):
        classes = f"{type(encoder).__name__} and {type(estimator).__name__}"
        raise Broken(f"the two sides are {classes}; expected an Encoder and a Receiver")
    return encoder, estimator


def heard_of(packet: Packet, gamma: Any, rubbish: float) -> Reception:
    """A receiver's reception of a packet, read-only."""
    gamma = gamma if packet.sent is None else gamma & packet.sent
    header = None if packet.header is None else frozen(np.where(gamma, packet.header, np.int64(min(rubbish, 2.0**40))))
    return Reception(frozen(gamma), frozen(np.where(gamma, packet.z, rubbish)), header)


def expect_packet(k: int, packet: Any, scheme: Scheme, problem: Problem) -> None:
    """Raise Broken unless this is a valid packet of a scheme."""
    if not isinstance(packet, Packet):
        raise Broken(f"slot {k}: encode() returned {type(packet).__name__}; expected a Packet")
    _expect_columns(range(k, k + 1), packet, scheme, problem)


def expect_packets(slots: range, packets: Any, scheme: Scheme, problem: Problem) -> None:
    """Raise Broken unless these are valid packets of a scheme for consecutive slots."""
    if not isinstance(packets, PacketBlock):
        raise Broken(f"{slots_text(slots)}: encode_block() returned {type(packets).__name__}; expected a PacketBlock")
    _expect_columns(slots, packets, scheme, problem)


def _expect_columns(slots: range, packet: Packet | PacketBlock, scheme: Scheme, problem: Problem) -> None:
    """Raise Broken unless the columns of a packet, or of the packets of consecutive slots, are valid."""
    n, trials = problem.process.n, problem.batch.trials
    several = isinstance(packet, PacketBlock)
    rows, axes = ((len(slots),), "slots, ") if several else ((), "")
    where, name = slots_text(slots), type(packet).__name__
    subject = "the packets have" if several else "the packet has"
    expect_array(f"{where}: {name}.z", packet.z, np.float64, (*rows, n, trials), f"{axes}n states, R trials")
    expect_array(f"{where}: {name}.nu", packet.nu, np.bool_, (*rows, trials), f"{axes}{_TRIALS}")
    if (packet.header is None) != (not scheme.header):
        there = "no header" if packet.header is None else "a header"
        raise Broken(
            f"{where}: {subject} {there}, and the scheme's `header` names {counted(len(scheme.header), 'number')}"
        )
    if packet.header is not None:
        shape = (*rows, len(scheme.header), trials)
        expect_array(f"{where}: {name}.header", packet.header, np.int64, shape, f"{axes}unencrypted numbers, R trials")
    if (packet.sent is None) == scheme.may_be_silent:
        raise Broken(
            f"{where}: {name}.sent and `may_be_silent` = {scheme.may_be_silent} do not agree; expected both or none"
        )
    if packet.sent is not None:
        expect_array(f"{where}: {name}.sent", packet.sent, np.bool_, (*rows, trials), f"{axes}{_TRIALS}")
    if not np.isfinite(packet.z).all():
        for k, z in zip(slots, packet.z if several else [packet.z], strict=True):
            expect_finite(f"slot {k}: Packet.z", z, problem.batch.first_trial)


def expect_belief(where: str, belief: Any, problem: Problem) -> None:
    """Raise Broken unless this is a valid belief for a problem."""
    trials = problem.batch.trials
    if not isinstance(belief, Belief):
        raise Broken(f"{where} is {type(belief).__name__}; expected a Belief")
    _expect_arrays(where, belief, (), problem)
    expect_finite(f"{where}.x_hat", belief.x_hat, problem.batch.first_trial)
    expect_finite(f"{where}.P", belief.P, problem.batch.first_trial)
    place = asymmetry(belief.P)
    if place is not None:
        i, j, r = place
        raise Broken(
            f"{where}.P, trial {problem.batch.first_trial + r}, is {belief.P[i, j, r]} at [{i}][{j}] and {belief.P[j, i, r]} "
            f"at [{j}][{i}]; expected a covariance, which is symmetric except for rounding"
        )
    for i, array in enumerate(belief.memory):
        if not isinstance(array, np.ndarray) or array.shape[-1:] != (trials,):
            raise Broken(f"{where}.memory[{i}] is not an array whose last axis is the {trials} trials")


def expect_actions(slots: range, action: Codes, gamma: Flags, problem: Problem) -> None:
    """Raise Broken unless these are actions of some slots with these γ, both (c, R), and only those with γ = 0 are LOST."""
    wrong = (action > max(Action)) | ((action == int(Action.LOST)) == gamma)
    if wrong.any():
        row, r = np.argwhere(wrong)[0]
        heard, wanted = ("a", "STATE, INNOVATION or DISCARDED") if gamma[row, r] else ("no", "LOST")
        raise Broken(
            f"slot {slots[row]}: the action of trial {problem.batch.first_trial + r} is {action[row, r]} after {heard} packet "
            f"was received; expected Action.{wanted}"
        )


def expect_beliefs(slots: range, given: Any, gamma: Flags, problem: Problem) -> None:
    """Raise Broken unless this is what `Receiver.follow` must return for consecutive slots with these γ, (c, R)."""
    if not (type(given) is tuple and len(given) == 2 and isinstance(given[0], Beliefs)):
        got = (
            f"a tuple of {', '.join(type(element).__name__ for element in given)}"
            if type(given) is tuple
            else type(given).__name__
        )
        raise Broken(
            f"{slots_text(slots)}: follow() returned {got}; expected the Beliefs after each slot, and the Belief after the last"
        )
    beliefs, after = given
    _expect_arrays(f"{slots_text(slots)}: Beliefs", beliefs, (len(slots),), problem)
    if not (np.isfinite(beliefs.x_hat).all() and np.isfinite(beliefs.P).all() and asymmetry(beliefs.P) is None):
        for row, k in enumerate(slots):
            expect_belief(f"slot {k}: Belief", Belief(*(column[row] for column in beliefs)), problem)
    expect_actions(slots, beliefs.action, gamma, problem)
    expect_belief(f"slot {slots[-1]}: the last Belief", after, problem)


def _expect_arrays(where: str, belief: Belief | Beliefs, rows: tuple[int, ...], problem: Problem) -> None:
    """Raise Broken unless the arrays of a belief, or with a first axis of rows those of beliefs, have their shapes and types."""
    n, trials = problem.process.n, problem.batch.trials
    axes = "slots, " if rows else ""
    expect_array(f"{where}.x_hat", belief.x_hat, np.float64, (*rows, n, trials), f"{axes}n states, R trials")
    means = f"{axes}a matrix for each of the R trials"
    expect_array(f"{where}.P", belief.P, np.float64, (*rows, n, n, trials), means)
    means = f"{axes}an `Action` for each of the R trials"
    expect_array(f"{where}.action", belief.action, np.uint8, (*rows, trials), means)


def slots_text(slots: range) -> str:
    """Consecutive slots, at least one, in words."""
    return f"slot {slots.start}" if len(slots) == 1 else f"slots {slots.start} to {slots.stop - 1}"
