"""The error covariance that a receiver believes, and the one that theory expects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np

from evedrop.model.metrics.metric import (
    MeanMetric,
    MetricColumn,
    MetricTally,
    ReceiverTally,
    ScoredSlots,
    TallyMetric,
    TrialTally,
)
from evedrop.model.process import Floats


@final
class MeanTraceCovariance(MeanMetric, TallyMetric):
    """The mean of tr P, where P is the covariance that the receiver believes."""

    meaning = "of tr P, the error covariance that the receiver believes"
    by_trial = False
    of_error = True
    rests_on = "recorded trials"
    column = MetricColumn("believed tr P", 3)
    sweep_column = MetricColumn("believed tr P", 2)

    @classmethod
    def of_tally(cls, tally: ReceiverTally) -> float:
        """Its mean over the run."""
        return tally.trace / max(1, tally.offered)

    @classmethod
    def sums_of_trials(cls, tally: TrialTally) -> Floats | None:
        """The sum of tr P over the slots of every trial, (R,); None if not every trial's is known."""
        return tally.trace

    @staticmethod
    def values(slots: ScoredSlots) -> Floats:
        """The sum of tr P over trials, (c, 1)."""
        return slots.trace[:, None]


@final
class ExpectedTraceCovariance(TallyMetric):
    """The mean trace of the actual error covariance that theory expects."""

    meaning = (
        "theory: trace of the expected actual error covariance over the same slots; null if no theory covers the losses "
        "of its link, or if no closed form is known for its strategy"
    )
    needs_theory = True
    rests_on = "theory"
    column = MetricColumn("expected tr P", 4)
    sweep_column = MetricColumn("expected tr P", 1)
    sweep_picture = "lines"

    @classmethod
    def of_tally(cls, tally: ReceiverTally) -> float:
        """Its mean over the run; NaN without theory."""
        return tally.expected_trace / max(1, tally.offered)

    @classmethod
    def tally(cls, trials: int) -> MetricTally:
        """A tally of no slots yet."""
        del trials
        return ExpectedTraces()


@final
class ExpectedTraces(MetricTally):
    """The expected traces of some slots, which are the same for all trials."""

    def __init__(self) -> None:
        self._traces: list[Floats] = []

    def add(self, slots: ScoredSlots) -> None:
        """Add the next slots."""
        self._traces.append(slots.expected.copy())

    @classmethod
    def merged(cls, parts: Sequence[ExpectedTraces]) -> ExpectedTraces:
        """The traces of the first set of trials, which are those of all."""
        return parts[0]

    @property
    def value(self) -> float | None:
        """Their mean; None without slots."""
        return float(np.mean(np.concatenate(self._traces))) if self._traces else None
