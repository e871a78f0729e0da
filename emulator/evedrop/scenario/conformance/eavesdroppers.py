"""The rules for eavesdroppers.

Source: docs/your-own/rules.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any, final

from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper, Knowledge, PacketTaker
from evedrop.model.outcomes import eavesdropper_outcomes
from evedrop.model.receiver import Receiver
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.theory.covariances import OutcomesAt
from evedrop.scenario.conformance.problems import (
    Problem,
    Slot,
    expect_actions,
    expect_belief,
    frozen_belief,
    large,
    made,
    played,
    row_of,
    small,
)
from evedrop.scenario.conformance.receivers import ReceiverChecks
from evedrop.scenario.conformance.rules import (
    Broken,
    NamedKeys,
    Row,
    RuleVerdict,
    calling,
    expect_bool,
    expect_names,
    expect_outcomes,
    frozen,
    judged,
)

_TAKES_OTHERWISE = (
    "correct use_probabilities, which must be the same in every slot; if the slots themselves decide, override outcomes to "
    "return None: no closed form"
)


@final
class EavesdropperChecks(ReceiverChecks):
    """The rules, each checked on one problem.

    name, kind, parameters: the eavesdropper's class, and its parameters; scheme, scheme_parameters: those of the scheme that it
    hears.
    """

    state = "keep no state outside of Belief, and take random numbers from the streams alone"
    actions_remedy = "let follows_gamma() return False"
    _kind: type[Eavesdropper]

    def __init__(
        self,
        name: str,
        kind: type[Eavesdropper],
        parameters: Mapping[str, Any],
        scheme: type[Scheme],
        scheme_parameters: Mapping[str, Any],
    ) -> None:
        super().__init__(kind)
        self._name, self._parameters = name, parameters
        self._scheme, self._scheme_parameters = scheme, scheme_parameters
        if issubclass(kind, PacketTaker):
            self.theory_remedy = _TAKES_OTHERWISE

    def verdicts(self) -> list[RuleVerdict]:
        """Check every rule, on small problems. Raises Broken if it is not told of a slot."""
        slots = 0 if self._betrayed is None else min(self._betrayed + 3, 200)
        exact = [
            ("shapes and types", self.shapes),
            ("same results when made again", self.twice),
            ("independent trials", self.alone),
            ("slots computed again", self.again),
            ("lost packets unused", self.lost),
            ("actions predictable from receptions", self.actions),
            ("many slots at once", self.blocks),
        ]
        return judged((exact, small(slots)), ([("theory agrees with simulation", self.theory)], large()))

    @cached_property
    def _betrayed(self) -> int | None:
        """The slot whose state is betrayed to it."""
        with calling("betrayed()", self._kind):
            slot = self._kind.betrayed(self._parameters)
        if slot is not None and (type(slot) is not int or slot < 0):
            raise Broken(f"betrayed() is {slot!r}; expected a slot, from 0 on, or None")
        return slot

    def receiver(self, problem: Problem) -> Receiver:
        """The eavesdropper."""
        with calling("streams()", self._kind):
            streams = self._kind.streams(self._parameters)
        scheme = made(self._scheme, self._scheme_parameters, problem)
        of_slots = scheme.mu_d if isinstance(scheme.mu_d, tuple) else None
        mu_d, keys = scheme.state_probability, NamedKeys.of(streams)
        knowledge = Knowledge(problem.process, mu_d, self._parameters, keys, of_slots, scheme.noise_distribution)
        with calling(f"{self._kind.__name__}(knowledge, batch)", self._kind):
            return self._kind(knowledge, problem.batch)

    def played(self, problem: Problem, *, rubbish: float = 0.0) -> Iterator[Slot]:
        """Every slot of the scheme, with what the eavesdropper hears and believes in it."""
        receiver = self.receiver(problem)
        with calling("prior()", self._kind):
            belief = receiver.prior()
        expect_belief("prior(): Belief", belief, problem)
        for slot in played(self._scheme, self._scheme_parameters, problem, rubbish=rubbish):
            heard = slot.heard._replace(truth=frozen(slot.x) if slot.k == self._betrayed else None)
            with calling(f"slot {slot.k}: step()", self._kind):
                after = receiver.step(slot.k, belief, heard)
            expect_belief(f"slot {slot.k}: Belief", after, problem)
            expect_actions(range(slot.k, slot.k + 1), after.action[None], heard.gamma[None], problem)
            after = frozen_belief(after)
            yield replace(slot, heard=heard, before=belief, after=after)
            belief = after

    def row(self, slot: Slot) -> Row:
        """Its beliefs."""
        return row_of(slot.after)

    def follows_gamma(self, problem: Problem) -> bool:
        """As its class says."""
        del problem
        return self._kind.follows_gamma(self._parameters)

    def outcomes_at(self, problem: Problem) -> OutcomesAt | None:
        """Those of its class with this scheme."""
        scheme = made(self._scheme, self._scheme_parameters, problem)
        with calling("outcomes()", self._kind):
            return eavesdropper_outcomes(scheme, self._name, self._parameters)

    def shapes(self, problem: Problem) -> None:
        """All results have the right shapes and types, and no input is changed."""
        kind, parameters = self._kind, self._parameters
        with calling("streams()", kind):
            streams = kind.streams(parameters)
        expect_names("streams()", streams)
        self.slots(problem)
        with calling("outcomes() and follows_gamma()", kind):
            outcomes_at = kind.outcomes(parameters, 0.5)
            follows = kind.follows_gamma(parameters)
        if outcomes_at is not None and not callable(outcomes_at):
            raise Broken(
                f"outcomes() is {type(outcomes_at).__name__}; expected a function of the link's quality that gives Outcomes, "
                "or None: no closed form"
            )
        for mu_e in (0.0, 0.5, 1.0) if outcomes_at is not None else ():
            with calling("what outcomes() returned", kind):
                outcomes = outcomes_at(mu_e)  # type: ignore[misc]
            if outcomes is None:
                raise Broken(
                    f"outcomes() gives None for the quality {mu_e}; expected Outcomes, or None in its own place"
                )
            expect_outcomes(f"outcomes() of the quality {mu_e}", outcomes)
        expect_bool("follows_gamma()", follows)
