"""Rules for every receiver, the legitimate estimator and eavesdroppers alike."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import ClassVar

import numpy as np

from evedrop.model import update
from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.process import Floats
from evedrop.model.receiver import Action, Belief, Receiver, Reception
from evedrop.model.theory.covariances import ExpectedCovariance, OutcomesAt
from evedrop.scenario.conformance.packets import expect_belief, row_of
from evedrop.scenario.conformance.problems import QUALITY, Problem
from evedrop.scenario.conformance.rules import Broken, Row, calling, expect_array, expect_same

SIGMAS = 6.0
"""Standard deviations allowed for chance."""
_SLACK = 0.02
_COLUMN = (
    "compute each trial from its own column alone: no sum over trials, no `@` or other BLAS, random numbers by the "
    "batch's trials"
)

Step = tuple[Belief, Reception, Belief]
"""The belief before a slot, the reception in it, and the belief after it."""


class ReceiverChecks(ABC):
    """The rules that schemes and eavesdroppers share, each checked on one problem."""

    state: ClassVar[str]
    """What to do if another one of its kind makes a difference."""

    @abstractmethod
    def rows(self, problem: Problem, rubbish: float = 0.0) -> Iterable[Row]:
        """Everything that is compared, slot by slot; rubbish: the value in place of a lost packet."""

    @abstractmethod
    def undisturbed(self, problem: Problem) -> list[Row]:
        """The same of one by itself, computed once for all rules that compare something with it."""

    @abstractmethod
    def shapes(self, problem: Problem) -> None:
        """All results have the right shapes and types, and no input is changed."""

    @abstractmethod
    def blocks(self, problem: Problem) -> None:
        """Blocks of slots give the same results as single slots."""

    def at_first(self, problem: Problem) -> None:
        """The rules that a dry run checks: shapes, types and blocks of slots."""
        self.shapes(problem)
        self.blocks(problem)

    def twice(self, problem: Problem) -> None:
        """Two that take turns do the same as one alone."""
        once = self.undisturbed(problem)
        for rows in zip(*zip(self.rows(problem), self.rows(problem), strict=True), strict=True):
            words = "{0!r} by itself and {1!r} with another one of its kind"
            expect_same(once, rows, slice(None), problem.batch.first_trial, words, self.state)

    def alone(self, problem: Problem) -> None:
        """A trial alone gives the same bits as among others."""
        among = self.undisturbed(problem)
        for trial in (0, problem.batch.trials - 1):
            by_itself = list(self.rows(problem.part(trial, 1)))
            words = f"{{0!r}} among {problem.batch.trials} trials and {{1!r}} alone"
            number = problem.batch.first_trial + trial
            expect_same(among, by_itself, slice(trial, trial + 1), number, words, _COLUMN)

    def lost(self, problem: Problem) -> None:
        """The value in place of a lost packet changes nothing."""
        zeros, rubbish = self.undisturbed(problem), list(self.rows(problem, 1e30))
        words = "{0!r} or {1!r}, depending on z where nothing was received"
        remedy = "look at z where gamma is true alone, such as by np.where(heard.gamma, …)"
        expect_same(zeros, rubbish, slice(None), problem.batch.first_trial, words, remedy)


def expect_pure(receiver: Receiver, steps: Sequence[Step], problem: Problem, kind: type) -> None:
    """Raise Broken unless a receiver, asked for slots backwards, answers as before, and has a prior for every slot."""
    rows = []
    for k, (before, heard, _) in reversed([*enumerate(steps)]):
        with calling(f"slot {k}: step(), asked for again after later slots,", kind):
            belief = receiver.step(k, before, heard)
        expect_belief(f"slot {k}: Belief", belief, problem)
        rows.append(row_of(belief))
    words = "{0!r} at first and {1!r} when the slot is asked for again"
    remedy = "keep what a receiver remembers in Belief.memory, and nothing in itself"
    once = [row_of(after) for _, _, after in steps]
    expect_same(once, rows[::-1], slice(None), problem.batch.first_trial, words, remedy)
    with calling("prior(first=3)", kind):
        expect_belief("prior(first=3): Belief", receiver.prior(3), problem)


def expect_actions(receiver: Receiver, steps: Sequence[Step], problem: Problem, kind: type, remedy: str) -> None:
    """Raise Broken unless `act` predicts from γ what `step` does, and the covariance follows from it."""
    for k, (before, heard, after) in enumerate(steps):
        with calling(f"slot {k}: act()", kind):
            action = receiver.act(k, heard.gamma)
        expect_array(f"slot {k}: act()", action, np.uint8, heard.gamma.shape, "an `Action` for each of the R trials")
        other = action != after.action
        if other.any():
            at = int(np.argmax(other))
            contradiction = f"act() says {_name(action[at])} and step() did {_name(after.action[at])}"
            raise Broken(
                f"slot {k}, trial {problem.batch.first_trial + at}: {contradiction}; make them agree, or {remedy}"
            )
        P = update.believed_covariance(problem.process, k, before.P, action)
        unlike = (P != after.P).any(axis=(0, 1))
        if unlike.any():
            at = int(np.argmax(unlike))
            raise Broken(
                f"slot {k}, trial {problem.batch.first_trial + at}: Belief.P after {_name(action[at])} is not that of "
                f"update.believed_covariance; use that function, or {remedy}"
            )


def _name(action: int) -> str:
    return Action(action).name if int(action) in set(Action) else str(int(action))


def expect_expected(
    problem: Problem,
    outcomes_at: OutcomesAt,
    errors: Sequence[Floats],
    remedy: str = "correct them, or return None: no closed form",
) -> None:
    """Raise Broken if the mean squared errors (R,) of every slot contradict the outcomes beyond chance; remedy: what to do."""
    outcomes = outcomes_at(QUALITY)
    parts = (outcomes.predicted, outcomes.decoded, outcomes.leaked, outcomes.state, outcomes.misled)
    if abs(sum_in_order(parts) - 1.0) > 1e-9 or min(parts) < 0.0:
        raise Broken(
            f"outcomes sum to {sum_in_order(parts):.6g}, the least is {min(parts):.3g}; expected probabilities that sum to 1"
        )
    expected = ExpectedCovariance(problem.process, outcomes).next_traces(len(errors))
    for k, error in enumerate(errors):
        chance = SIGMAS * float(error.std()) / float(np.sqrt(len(error))) + _SLACK * float(expected[k]) + 1e-9
        if abs(float(error.mean()) - float(expected[k])) > chance:
            raise Broken(
                f"slot {k}: the mean squared error is {error.mean():.4g}, and outcomes say {expected[k]:.4g}; {remedy}"
            )
