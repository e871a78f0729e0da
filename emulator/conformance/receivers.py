"""Rules for every receiver, the legitimate estimator and eavesdroppers alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evedrop.conformance.packets import expect_belief, row_of
from evedrop.conformance.problems import QUALITY, Problem
from evedrop.conformance.rules import Broken, calling, expect_array, expect_same
from evedrop.model import update
from evedrop.model.process import Floats
from evedrop.model.receiver import Action, Belief, Receiver, Reception
from evedrop.model.theory.covariances import ExpectedCovariance, OutcomesAt

SIGMAS = 6.0
"""Standard deviations allowed for chance."""
_SLACK = 0.02

Step = tuple[Belief, Reception, Belief]
"""The belief before a slot, the reception in it, and the belief after it."""


def expect_pure(receiver: Receiver, steps: Sequence[Step], problem: Problem, kind: type) -> None:
    """Raise Broken unless a receiver, asked for slots backwards, answers as before, and has a prior for every slot."""
    rows = []
    for k, (before, heard, _) in reversed([*enumerate(steps)]):
        with calling(f"slot {k}: step(), asked for again after later slots,", kind):
            found = receiver.step(k, before, heard)
        expect_belief(f"slot {k}: Belief", found, problem)
        rows.append(row_of(found))
    said = "{0!r} at first and {1!r} when the slot is asked for again"
    remedy = "keep what a receiver remembers in Belief.memory, and nothing in itself"
    once = [row_of(after) for _, _, after in steps]
    expect_same(once, rows[::-1], slice(None), problem.batch.first_trial, said, remedy)
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
            found = f"act() says {_name(action[at])} and step() did {_name(after.action[at])}"
            raise Broken(f"slot {k}, trial {problem.batch.first_trial + at}: {found}; make them agree, or {remedy}")
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


def expect_expected(problem: Problem, outcomes_at: OutcomesAt, errors: Sequence[Floats]) -> None:
    """Raise Broken if the mean squared errors (R,) of every slot contradict the outcomes beyond chance."""
    outcomes = outcomes_at(QUALITY)
    parts = (outcomes.predicted, outcomes.decoded, outcomes.leaked, outcomes.state, outcomes.misled)
    if abs(sum(parts) - 1.0) > 1e-9 or min(parts) < 0.0:
        raise Broken(
            f"outcomes sum to {sum(parts):.6g}, the least is {min(parts):.3g}; expected probabilities that sum to 1"
        )
    expected = ExpectedCovariance(problem.process, outcomes).next_traces(len(errors))
    for k, error in enumerate(errors):
        chance = SIGMAS * float(error.std()) / float(np.sqrt(len(error))) + _SLACK * float(expected[k]) + 1e-9
        if abs(float(error.mean()) - float(expected[k])) > chance:
            raise Broken(
                f"slot {k}: the mean squared error is {error.mean():.4g}, and outcomes say {expected[k]:.4g}; correct them, "
                "or return None: no closed form"
            )
