"""Runs a scheme on a problem: its packets and its estimator's beliefs, slot by slot."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from evedrop.conformance.problems import Problem
from evedrop.conformance.rules import Broken, NamedKeys, Row, calling, expect_array, expect_finite, frozen, key
from evedrop.model.process import Process, Trajectory
from evedrop.model.receiver import Belief, Receiver, Reception
from evedrop.model.schemes.scheme import Encoder, Packet, Scheme

_TRIALS = "one for each of the R trials"

SchemeOf = Callable[[Process], Scheme]


@dataclass(frozen=True)
class Slot:
    """One slot."""

    k: int
    x: Any
    """The state, (n, R)."""
    packet: Packet
    heard: Reception
    before: Belief
    after: Belief

    @property
    def sent(self) -> dict[str, Any]:
        """The parts of the packet that are compared."""
        found = {"Packet.z": self.packet.z, "Packet.nu": self.packet.nu}
        found |= {} if self.packet.header is None else {"Packet.header": self.packet.header}
        return found | ({} if self.packet.sent is None else {"Packet.sent": self.packet.sent})

    @property
    def row(self) -> Row:
        """Everything that is compared."""
        return {**self.sent, **row_of(self.after)}


def frozen_belief(belief: Belief) -> Belief:
    """A read-only copy."""
    memory = tuple(frozen(one) for one in belief.memory)
    return Belief(frozen(belief.x_hat), frozen(belief.P), frozen(belief.action), memory)


def row_of(belief: Belief) -> dict[str, Any]:
    """The parts of a belief that are compared, which are those that enter digests. Its memory may depend on other trials."""
    return {"Belief.x_hat": belief.x_hat, "Belief.P": belief.P, "Belief.action": belief.action}


def made(scheme_of: SchemeOf, problem: Problem, kind: type[Scheme]) -> Scheme:
    """The scheme for a problem's process."""
    with calling(f"{kind.__name__}(process, …)", kind):
        return scheme_of(problem.process)


def played(
    scheme_of: SchemeOf, problem: Problem, kind: type[Scheme], *, apart: bool = False, rubbish: float = 0.0
) -> Iterator[Slot]:
    """Every slot of a problem.

    apart: sensor and estimator are made separately, as in processes of their own; rubbish: the value that a receiver finds in
    place of a lost packet. Everything passed in is read-only; everything returned is checked.
    """
    scheme, batch, n = made(scheme_of, problem, kind), problem.batch, problem.process.n
    encoder, estimator = _sides(scheme, problem, kind, apart)
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
        x = frozen(trajectory.advance())
        with calling(f"slot {k}: encode()", kind):
            packet = encoder.encode(k, x, frozen(trajectory.predicted))
        expect_packet(k, packet, scheme, problem)
        heard = heard_of(packet, problem.gamma[k], rubbish)
        if scheme.needs_acknowledgements:
            with calling(f"slot {k}: acknowledged()", kind):
                encoder.acknowledged(k, frozen(heard.gamma & back[k]))
        with calling(f"slot {k}: step()", kind):
            after = estimator.step(k, belief, heard)
        expect_belief(f"slot {k}: Belief", after, problem)
        after = frozen_belief(after)
        yield Slot(k, x, packet, heard, belief, after)
        belief = after


def _sides(scheme: Scheme, problem: Problem, kind: type[Scheme], apart: bool) -> tuple[Encoder, Receiver]:
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
        found = f"{type(encoder).__name__} and {type(estimator).__name__}"
        raise Broken(f"the two sides are {found}; expected an Encoder and a Receiver")
    return encoder, estimator


def heard_of(packet: Packet, gamma: Any, rubbish: float) -> Reception:
    """A receiver's reception of a packet, read-only."""
    gamma = gamma if packet.sent is None else gamma & packet.sent
    header = None if packet.header is None else frozen(np.where(gamma, packet.header, np.int64(min(rubbish, 2.0**40))))
    return Reception(frozen(gamma), frozen(np.where(gamma, packet.z, rubbish)), header)


def expect_packet(k: int, packet: Any, scheme: Scheme, problem: Problem) -> None:
    """Raise Broken unless this is a valid packet of a scheme."""
    n, trials = problem.process.n, problem.batch.trials
    if not isinstance(packet, Packet):
        raise Broken(f"slot {k}: encode() returned {type(packet).__name__}; expected a Packet")
    expect_array(f"slot {k}: Packet.z", packet.z, np.float64, (n, trials), "n states, R trials")
    expect_array(f"slot {k}: Packet.nu", packet.nu, np.bool_, (trials,), _TRIALS)
    if (packet.header is None) != (not scheme.header):
        there = "no header" if packet.header is None else "a header"
        raise Broken(f"slot {k}: the packet has {there}, and the scheme's `header` names {len(scheme.header)} numbers")
    if packet.header is not None:
        shape = (len(scheme.header), trials)
        expect_array(f"slot {k}: Packet.header", packet.header, np.int64, shape, "numbers in clear, R trials")
    if (packet.sent is None) == scheme.may_be_silent:
        raise Broken(
            f"slot {k}: Packet.sent and `may_be_silent` = {scheme.may_be_silent} do not agree; expected both or none"
        )
    if packet.sent is not None:
        expect_array(f"slot {k}: Packet.sent", packet.sent, np.bool_, (trials,), _TRIALS)
    expect_finite(f"slot {k}: Packet.z", packet.z, problem.batch.first_trial)


def expect_belief(where: str, belief: Any, problem: Problem) -> None:
    """Raise Broken unless this is a valid belief for a problem."""
    n, trials = problem.process.n, problem.batch.trials
    if not isinstance(belief, Belief):
        raise Broken(f"{where} is {type(belief).__name__}; expected a Belief")
    expect_array(f"{where}.x_hat", belief.x_hat, np.float64, (n, trials), "n states, R trials")
    expect_array(f"{where}.P", belief.P, np.float64, (n, n, trials), "a matrix for each of the R trials")
    expect_array(f"{where}.action", belief.action, np.uint8, (trials,), "an `Action` for each of the R trials")
    expect_finite(f"{where}.x_hat", belief.x_hat, problem.batch.first_trial)
    expect_finite(f"{where}.P", belief.P, problem.batch.first_trial)
    for i, array in enumerate(belief.memory):
        if not isinstance(array, np.ndarray) or array.shape[-1:] != (trials,):
            raise Broken(f"{where}.memory[{i}] is not an array whose last axis is the {trials} trials")
