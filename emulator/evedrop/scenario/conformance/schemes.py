"""The rules for schemes.

Source: docs/your-own/rules.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import numpy as np

from evedrop.model.outcomes import legitimate_outcomes
from evedrop.model.schemes.scheme import PacketBlock, Scheme
from evedrop.scenario.conformance.problems import Problem, SchemeOf, Slot, large, made, played, small
from evedrop.scenario.conformance.receivers import (
    SIGMAS,
    ReceiverChecks,
    expect_actions,
    expect_expected,
    expect_pure,
    expect_same_in_blocks,
)
from evedrop.scenario.conformance.rules import (
    Broken,
    NamedKeys,
    Row,
    RuleVerdict,
    calling,
    expect_array,
    expect_bool,
    expect_names,
    expect_outcomes,
    expect_probability,
    expect_same,
    judged,
)

_QUALITIES = (0.0, 0.5, 1.0)


def scheme_verdicts(scheme_of: SchemeOf, kind: type[Scheme]) -> list[RuleVerdict]:
    """Check every rule for schemes, on small problems; scheme_of makes the scheme of a process."""
    checks = SchemeChecks(scheme_of, kind)
    exact = [
        ("shapes and types", checks.shapes),
        ("same results when made again", checks.twice),
        ("independent trials", checks.alone),
        ("separate sensor and estimator", checks.apart),
        ("slots computed again", checks.again),
        ("lost packets unused", checks.lost),
        ("a state in slot 0", checks.first),
        ("actions predictable from receptions", checks.actions),
        ("many slots at once", checks.blocks),
    ]
    in_the_mean = [
        ("better than open-loop prediction", checks.prediction),
        ("theory agrees with simulation", checks.theory),
    ]
    return judged((exact, small()), (in_the_mean, large()))


@final
class SchemeChecks(ReceiverChecks):
    """The rules, each checked on one problem."""

    state = "keep no state outside of what is made from the keys, and take random numbers from their streams alone"

    def __init__(self, scheme_of: SchemeOf, kind: type[Scheme]) -> None:
        self._scheme_of, self._kind = scheme_of, kind
        self._played: dict[tuple[int, bool], tuple[Problem, list[Slot]]] = {}
        """The slots of a problem, by its id and whether the sides were made apart."""

    def _slots(self, problem: Problem, apart: bool = False) -> list[Slot]:
        if (id(problem), apart) not in self._played:
            slots = list(played(self._scheme_of, problem, self._kind, apart=apart))
            self._played[id(problem), apart] = (problem, slots)
        return self._played[id(problem), apart][1]

    def rows(self, problem: Problem, rubbish: float = 0.0) -> Iterator[Row]:
        """Packets and beliefs."""
        return (slot.row for slot in played(self._scheme_of, problem, self._kind, rubbish=rubbish))

    def undisturbed(self, problem: Problem) -> list[Row]:
        """Packets and beliefs, computed once."""
        return [slot.row for slot in self._slots(problem)]

    def shapes(self, problem: Problem) -> None:
        """All results have the right shapes and types, made together and apart, and no input is changed."""
        for name in ("secret_streams", "estimator_streams", "header"):
            expect_names(name, getattr(self._kind, name))
        for name in ("needs_acknowledgements", "reads_packets", "may_be_silent"):
            expect_bool(name, getattr(self._kind, name))
        scheme = made(self._scheme_of, problem, self._kind)
        more = sorted(set(scheme.estimator_streams) - set(scheme.secret_streams))
        if more:
            raise Broken(f"estimator_streams has {more}, which secret_streams lacks; expected some of those")
        expect_probability("state_probability", scheme.state_probability)
        for apart in (False, True):
            self._slots(problem, apart)
        for mu in _QUALITIES:
            with calling("outcomes()", self._kind):
                outcomes = scheme.outcomes(mu)
            expect_outcomes(f"outcomes({mu})", outcomes)
            with calling("eavesdropper_outcomes()", self._kind):
                theirs = scheme.eavesdropper_outcomes(mu, 1.0, 1.0)
            expect_outcomes(f"eavesdropper_outcomes({mu}, 1.0, 1.0)", theirs)
        packets = PacketBlock.of([slot.packet for slot in self._slots(problem)])
        with calling("encrypted()", self._kind):
            encrypted = scheme.encrypted(packets)
        expect_array("encrypted()", encrypted, np.bool_, packets.nu.shape, "slots, one for each of the R trials")
        with calling("packet_bits, secret_bits and initial_secret_bits", self._kind):
            bits = (scheme.packet_bits, scheme.secret_bits, scheme.initial_secret_bits)
        if any(type(count) is not int or count < 0 for count in bits):
            raise Broken(f"packet_bits, secret_bits and initial_secret_bits are {bits!r:.80}; expected whole numbers")

    def apart(self, problem: Problem) -> None:
        """Sensor and estimator made separately, as in a live run, do the same as in memory."""
        together = [slot.row for slot in self._slots(problem)]
        words = "{0!r} made from shared() and {1!r} made from encoder() and estimator()"
        remedy = "make both sides from the keys alone, so that processes of their own agree"
        rows = [slot.row for slot in self._slots(problem, apart=True)]
        expect_same(together, rows, slice(None), problem.batch.first_trial, words, remedy)

    def again(self, problem: Problem) -> None:
        """The estimator gives the same answer for a slot after later slots."""
        slots = self._slots(problem)
        scheme = made(self._scheme_of, problem, self._kind)
        with calling("estimator()", self._kind):
            estimator = scheme.estimator(NamedKeys.of(scheme.estimator_streams), problem.batch)
        expect_pure(estimator, [(slot.before, slot.heard, slot.after) for slot in slots], problem, self._kind)

    def first(self, problem: Problem) -> None:
        """The packet of slot 0 is not an innovation, because there is no state before it."""
        slot = next(iter(played(self._scheme_of, problem, self._kind)))
        if slot.packet.nu.any():
            trial = problem.batch.first_trial + int(np.argmax(slot.packet.nu))
            raise Broken(f"slot 0, trial {trial}: nu is true; expected false, for there is no state before the first")

    def actions(self, problem: Problem) -> None:
        """Unless it reads packets, γ alone determines the estimator's actions, and so its beliefs."""
        scheme = made(self._scheme_of, problem, self._kind)
        if scheme.reads_packets:
            return
        with calling("estimator()", self._kind):
            estimator = scheme.estimator(NamedKeys.of(scheme.estimator_streams), problem.batch)
        steps = [(slot.before, slot.heard, slot.after) for slot in self._slots(problem)]
        expect_actions(estimator, steps, problem, self._kind, "set reads_packets = True if it depends on more than γ")

    def blocks(self, problem: Problem) -> None:
        """Blocks of slots give the same packets and beliefs as single slots."""
        expect_same_in_blocks(made(self._scheme_of, problem, self._kind), self._slots(problem), problem, self._kind)

    def prediction(self, problem: Problem) -> None:
        """The estimator's mean error never exceeds that of a receiver that hears nothing."""
        for slot in self._slots(problem):
            own = ((slot.x - slot.after.x_hat) ** 2).sum(axis=0)
            gain = (slot.x**2).sum(axis=0) - own
            error = float(gain.std()) / float(np.sqrt(len(gain)))
            if gain.mean() < -SIGMAS * error - 1e-12:
                raise Broken(
                    f"slot {slot.k}: the mean squared error is {own.mean():.4g}, and {own.mean() + gain.mean():.4g} for a "
                    "receiver that hears nothing; decode what encode() has made, with the same slot's numbers"
                )

    def theory(self, problem: Problem) -> None:
        """The outcomes it states are the observed ones, if it states any."""
        scheme = made(self._scheme_of, problem, self._kind)
        outcomes_at = legitimate_outcomes(scheme)
        if outcomes_at is None:
            return
        errors = [((slot.x - slot.after.x_hat) ** 2).sum(axis=0) for slot in self._slots(problem)]
        expect_expected(problem, outcomes_at, errors)
