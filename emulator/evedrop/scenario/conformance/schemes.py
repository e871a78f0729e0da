"""The rules for schemes.

Source: docs/your-own/rules.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, final

import numpy as np

from evedrop.model.outcomes import legitimate_outcomes
from evedrop.model.receiver import Receiver
from evedrop.model.schemes.scheme import PacketBlock, Scheme
from evedrop.model.theory.covariances import OutcomesAt
from evedrop.scenario.conformance.problems import Problem, Slot, large, made, played, row_of, sent_of, sides, small
from evedrop.scenario.conformance.receivers import SIGMAS, BlockChecks, ReceiverChecks
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
    judged,
)

_QUALITIES = (0.0, 0.5, 1.0)


@final
class SchemeChecks(ReceiverChecks):
    """The rules, each checked on one problem. kind, parameters: the scheme's class, and its parameters."""

    state = "keep no state outside of what is made from the keys, and take random numbers from their streams alone"
    actions_remedy = "set reads_packets = True if it depends on more than γ"
    _kind: type[Scheme]

    def __init__(self, kind: type[Scheme], parameters: Mapping[str, Any]) -> None:
        super().__init__(kind)
        self._parameters = parameters

    def verdicts(self) -> list[RuleVerdict]:
        """Check every rule, on small problems."""
        exact = [
            ("shapes and types", self.shapes),
            ("same results when made again", self.twice),
            ("independent trials", self.alone),
            ("separate sensor and estimator", self.apart),
            ("slots computed again", self.again),
            ("lost packets unused", self.lost),
            ("a state in slot 0", self.first),
            ("actions predictable from receptions", self.actions),
            ("many slots at once", self.blocks),
        ]
        in_the_mean = [
            ("better than open-loop prediction", self.prediction),
            ("theory agrees with simulation", self.theory),
        ]
        return judged((exact, small()), (in_the_mean, large()))

    def played(self, problem: Problem, *, rubbish: float = 0.0, apart: bool = False) -> Iterator[Slot]:
        """Every slot; apart: sensor and estimator are made separately."""
        return played(self._kind, self._parameters, problem, apart=apart, rubbish=rubbish)

    def row(self, slot: Slot) -> Row:
        """Packets and beliefs."""
        return {**sent_of(slot.packet), **row_of(slot.after)}

    def receiver(self, problem: Problem) -> Receiver:
        """The estimator."""
        scheme = made(self._kind, self._parameters, problem)
        with calling("estimator()", self._kind):
            return scheme.estimator(NamedKeys.of(scheme.estimator_streams), problem.batch)

    def follows_gamma(self, problem: Problem) -> bool:
        """Unless the scheme reads packets."""
        return not made(self._kind, self._parameters, problem).reads_packets

    def outcomes_at(self, problem: Problem) -> OutcomesAt | None:
        """Those of the legitimate estimator."""
        return legitimate_outcomes(made(self._kind, self._parameters, problem))

    def shapes(self, problem: Problem) -> None:
        """All results have the right shapes and types, made together and apart, and no input is changed."""
        for name in ("secret_streams", "estimator_streams", "header"):
            expect_names(name, getattr(self._kind, name))
        for name in ("needs_acknowledgements", "reads_packets", "may_be_silent"):
            expect_bool(name, getattr(self._kind, name))
        scheme = made(self._kind, self._parameters, problem)
        more = sorted(set(scheme.estimator_streams) - set(scheme.secret_streams))
        if more:
            raise Broken(f"estimator_streams has {more}, which secret_streams lacks; expected some of those")
        expect_probability("state_probability", scheme.state_probability)
        slots = self.slots(problem)
        list(self.played(problem, apart=True))
        for mu in _QUALITIES:
            with calling("outcomes()", self._kind):
                outcomes = scheme.outcomes(mu)
            expect_outcomes(f"outcomes({mu})", outcomes)
            with calling("eavesdropper_outcomes()", self._kind):
                theirs = scheme.eavesdropper_outcomes(mu, 1.0, 1.0)
            expect_outcomes(f"eavesdropper_outcomes({mu}, 1.0, 1.0)", theirs)
        packets = PacketBlock.of([slot.packet for slot in slots])
        with calling("encrypted()", self._kind):
            encrypted = scheme.encrypted(packets)
        expect_array("encrypted()", encrypted, np.bool_, packets.nu.shape, "slots, one for each of the R trials")
        with calling("packet_bits, secret_bits and initial_secret_bits", self._kind):
            bits = (scheme.packet_bits, scheme.secret_bits, scheme.initial_secret_bits)
        if any(type(count) is not int or count < 0 for count in bits):
            raise Broken(f"packet_bits, secret_bits and initial_secret_bits are {bits!r:.80}; expected whole numbers")

    def apart(self, problem: Problem) -> None:
        """Sensor and estimator made separately, as in a live run, do the same as in memory."""
        words = "{0!r} made from shared() and {1!r} made from encoder() and estimator()"
        remedy = "make both sides from the keys alone, so that processes of their own agree"
        self._expect_same(problem, self.played(problem, apart=True), words, remedy)

    def first(self, problem: Problem) -> None:
        """The packet of slot 0 is not an innovation, because there is no state before it."""
        slot = next(self.played(problem))
        if slot.packet.nu.any():
            trial = problem.batch.first_trial + int(np.argmax(slot.packet.nu))
            raise Broken(f"slot 0, trial {trial}: nu is true; expected false, for there is no state before the first")

    def blocks(self, problem: Problem) -> None:
        """Blocks of slots give the same packets and beliefs as single slots."""
        scheme = made(self._kind, self._parameters, problem)
        checks = BlockChecks(self.slots(problem), problem, self._kind)
        checks.expect_same_sides(scheme)
        checks.expect_same_beliefs(lambda: sides(scheme, problem, self._kind, apart=True)[1])

    def prediction(self, problem: Problem) -> None:
        """The estimator's mean error never exceeds that of a receiver that hears nothing."""
        for slot in self.slots(problem):
            own = slot.squared_error
            gain = (slot.x**2).sum(axis=0) - own
            error = float(gain.std()) / float(np.sqrt(len(gain)))
            if gain.mean() < -SIGMAS * error - 1e-12:
                raise Broken(
                    f"slot {slot.k}: the mean squared error is {own.mean():.4g}, and {own.mean() + gain.mean():.4g} for a "
                    "receiver that hears nothing; decode what encode() has made, with the same slot's numbers"
                )
