"""The error that is expected of each trial, given what happened to its packets, and how improbable its actual error is.

A trial whose link lost much has a larger expectation of its own. Its error is judged by that, not by the other trials'.

Source: docs/montecarlo.md, the most surprising trial.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np

from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Action, Codes
from evedrop.model.schemes import SCHEMES
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import outcomes_of

_STATE = int(Action.STATE)
_ANY_QUALITY = 0.5  # of a link that may lose a packet and may deliver it


@final
class ConditionalError:
    """The expected squared errors of R trials of a receiver that is never misled, summed over slots from slot 0 on.

    Given the actions of a trial, the error in slot k is normal with covariance P_k. Errors are independent if a state was
    used between them. Let t be the sum of tr P_k from one used state to the next. The sum of squared errors has the mean Σ t
    and at most the variance 2 Σ t², because none of its correlations exceeds 1, and tr P² ≤ (tr P)².
    """

    def __init__(self, process: Process, prior: Floats, trials: int) -> None:
        """prior: covariance before slot 0, (n, n)."""
        self._process = process
        self._P = np.repeat(prior[:, :, None], trials, axis=2)
        self._sums = np.zeros((3, trials))
        """Of tr P over all slots, and up to the last used state; and the squares of its sums from one used state to the next."""
        self.slots = 0
        """The number of slots so far; 0 in a mode without errors."""

    def add_actions(self, action: Codes, traces: Floats | None = None) -> None:
        """Add the next slots: the actions (c, R).

        traces: tr P_k, (c, R), as a receiver that is built in computes it itself; either always given or never.
        """
        if traces is None:
            process = self._process
            covariances = kernels.follow_covariance(process.A, process.Q, self._P, action, self.slots == 0)
            self._P, traces = covariances[-1], kernels.traces(covariances)
        self.slots += len(action)
        kernels.add_between(self._sums, action == _STATE, traces)

    @property
    def expected(self) -> Floats:
        """The expected sum of the squared errors of each trial, (R,)."""
        total: Floats = self._sums[0]
        return total

    @property
    def variance(self) -> Floats:
        """The upper bound of its variance, (R,)."""
        total, mark, squares = self._sums
        return 2.0 * (squares + (total - mark) ** 2)

    def probability(self, error: Floats) -> Floats:
        """The probability, for each trial, that the sum of squared errors is as far from its expectation as `error` (R,).

        Two-sided, by the scaled χ² distribution with the expectation and the variance above. NaN where no error is expected.
        """
        from scipy.special import gammainc, gammaincc  # noqa: PLC0415 - 0.2 s that only the summary needs

        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            shape = self.expected**2 / self.variance
            at = shape * (error / self.expected)
            probability: Floats = np.minimum(2.0 * np.minimum(gammainc(shape, at), gammaincc(shape, at)), 1.0)
        return probability

    @classmethod
    def merged(cls, parts: Sequence[ConditionalError]) -> ConditionalError:
        """The sums of disjoint sets of trials, in their order."""
        whole = cls(parts[0]._process, np.zeros_like(parts[0]._process.Q), 0)
        for name in ("_P", "_sums"):
            setattr(whole, name, np.concatenate([getattr(part, name) for part in parts], axis=-1))
        whole.slots = min(part.slots for part in parts)
        return whole


def conditional_error_of(scenario: Scenario, receiver: str, trials: int) -> ConditionalError | None:
    """The conditional error of a receiver's trials, of no slots yet; None if actions do not determine its covariance.

    That is so for a receiver that may be misled, reads packets that are not states, waits for late packets or goes away, for a
    scheme that acts on acknowledgements, and for a plant, whose inputs and disturbances add to the error.
    """
    outcomes_at = outcomes_of(scenario, receiver)
    away = scenario.timeline.outages[receiver] or scenario.window(receiver)
    if outcomes_at is None or away or scenario.of_model:
        return None
    outcomes = outcomes_at(_ANY_QUALITY)
    if outcomes.misled or outcomes.leaked or SCHEMES[scenario.encoding.scheme].needs_acknowledgements:
        return None
    process = scenario.process.process
    prior = process.initial_covariance if outcomes.initial else np.zeros_like(process.Q)
    return ConditionalError(process, prior, trials)
