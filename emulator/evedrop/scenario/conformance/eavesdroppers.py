"""The rules for eavesdroppers.

Source: docs/your-own/rules.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np

from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper, Knowledge, PacketTaker
from evedrop.model.outcomes import eavesdropper_outcomes
from evedrop.model.schemes.scheme import Scheme
from evedrop.scenario.conformance.problems import (
    Problem,
    SchemeOf,
    Slot,
    expect_belief,
    frozen_belief,
    large,
    made,
    played,
    row_of,
    small,
)
from evedrop.scenario.conformance.receivers import (
    ReceiverChecks,
    Step,
    expect_actions,
    expect_expected,
    expect_pure,
    expect_same_followed,
)
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


@dataclass(frozen=True)
class EavesdropperSetup:
    """An eavesdropper's class with its parameters, and the scheme it hears."""

    name: str
    """The class's name."""
    kind: type[Eavesdropper]
    parameters: Mapping[str, Any]
    scheme_of: SchemeOf
    scheme: type[Scheme]

    def made(self, problem: Problem) -> Eavesdropper:
        """An eavesdropper for a problem."""
        with calling("streams()", self.kind):
            streams = self.kind.streams(self.parameters)
        scheme = made(self.scheme_of, problem, self.scheme)
        of_slots = scheme.mu_d if isinstance(scheme.mu_d, tuple) else None
        mu_d, keys = scheme.state_probability, NamedKeys.of(streams)
        knowledge = Knowledge(problem.process, mu_d, self.parameters, keys, of_slots, scheme.noise_distribution)
        with calling(f"{self.kind.__name__}(knowledge, batch)", self.kind):
            return self.kind(knowledge, problem.batch)

    @cached_property
    def betrayed(self) -> int | None:
        """The slot whose state is betrayed to it."""
        with calling("betrayed()", self.kind):
            slot = self.kind.betrayed(self.parameters)
        if slot is not None and (type(slot) is not int or slot < 0):
            raise Broken(f"betrayed() is {slot!r}; expected a slot, from 0 on, or None")
        return slot

    def steps(self, problem: Problem, rubbish: float = 0.0) -> Iterator[tuple[Slot, Step]]:
        """Every slot of the scheme, and the eavesdropper's belief in it."""
        receiver = self.made(problem)
        with calling("prior()", self.kind):
            belief = receiver.prior()
        expect_belief("prior(): Belief", belief, problem)
        for slot in played(self.scheme_of, problem, self.scheme, rubbish=rubbish):
            heard = slot.heard._replace(truth=frozen(slot.x) if slot.k == self.betrayed else None)
            with calling(f"slot {slot.k}: step()", self.kind):
                after = receiver.step(slot.k, belief, heard)
            expect_belief(f"slot {slot.k}: Belief", after, problem)
            after = frozen_belief(after)
            yield slot, (belief, heard, after)
            belief = after


def eavesdropper_verdicts(setup: EavesdropperSetup) -> list[RuleVerdict]:
    """Check every rule for eavesdroppers, on small problems."""
    checks = EavesdropperChecks(setup)
    at = setup.betrayed
    slots = 0 if at is None else min(at + 3, 200)
    exact = [
        ("shapes and types", checks.shapes),
        ("same results when made again", checks.twice),
        ("independent trials", checks.alone),
        ("slots computed again", checks.again),
        ("lost packets unused", checks.lost),
        ("actions predictable from receptions", checks.actions),
        ("many slots at once", checks.blocks),
    ]
    return judged((exact, small(slots)), ([("theory agrees with simulation", checks.theory)], large()))


@final
class EavesdropperChecks(ReceiverChecks):
    """The rules, each checked on one problem."""

    state = "keep no state outside of Belief, and take random numbers from the streams alone"

    def __init__(self, setup: EavesdropperSetup) -> None:
        self._setup = setup
        self._heard: dict[int, tuple[Problem, list[Step]]] = {}
        """Its steps on a problem, by the problem's id."""

    def rows(self, problem: Problem, rubbish: float = 0.0) -> Iterator[Row]:
        """Its beliefs."""
        return (row_of(step[2]) for _, step in self._setup.steps(problem, rubbish))

    def undisturbed(self, problem: Problem) -> list[Row]:
        """Its beliefs, computed once."""
        return [row_of(after) for _, _, after in self._steps(problem)]

    def _steps(self, problem: Problem) -> list[Step]:
        if id(problem) not in self._heard:
            self._heard[id(problem)] = (problem, [step for _, step in self._setup.steps(problem)])
        return self._heard[id(problem)][1]

    def shapes(self, problem: Problem) -> None:
        """All results have the right shapes and types, and no input is changed."""
        kind, parameters = self._setup.kind, self._setup.parameters
        with calling("streams()", kind):
            streams = kind.streams(parameters)
        expect_names("streams()", streams)
        self._steps(problem)
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

    def again(self, problem: Problem) -> None:
        """It gives the same answer for a slot after later slots."""
        expect_pure(self._setup.made(problem), self._steps(problem), problem, self._setup.kind)

    def actions(self, problem: Problem) -> None:
        """If it follows γ, γ alone determines its actions, and so its beliefs."""
        kind = self._setup.kind
        if kind.follows_gamma(self._setup.parameters):
            remedy = "let follows_gamma() return False"
            expect_actions(self._setup.made(problem), self._steps(problem), problem, kind, remedy)

    def blocks(self, problem: Problem) -> None:
        """Blocks of slots give the same beliefs as single slots."""
        setup = self._setup
        expect_same_followed(lambda: setup.made(problem), self._steps(problem), problem, setup.kind)

    def theory(self, problem: Problem) -> None:
        """The outcomes it states are the observed ones, if it states any for this scheme."""
        setup = self._setup
        scheme = made(setup.scheme_of, problem, setup.scheme)
        with calling("outcomes()", setup.kind):
            outcomes_at = eavesdropper_outcomes(scheme, setup.name, setup.parameters)
        if outcomes_at is not None:
            errors = [((slot.x - step[2].x_hat) ** 2).sum(axis=0) for slot, step in setup.steps(problem)]
            values = [np.asarray(error) for error in errors]
            if issubclass(setup.kind, PacketTaker):
                expect_expected(problem, outcomes_at, values, _TAKES_OTHERWISE)
            else:
                expect_expected(problem, outcomes_at, values)
