"""The actual error of a receiver."""

from __future__ import annotations

from typing import final

from evedrop.model.metrics.metric import (
    COVARIANCE_ONLY,
    MeanMetric,
    MetricColumn,
    ReceiverTally,
    ScoredSlots,
    TallyMetric,
    TrialTally,
)
from evedrop.model.process import Floats


class MeanError(MeanMetric, TallyMetric):
    """The mean of the mode's error: |x − x̂|², or in a covariance-only study the trace of the actual covariance."""

    of_error = True
    expected = "expected_trace_covariance"
    sweep_column = MetricColumn("mean error", 0)
    sweep_picture = "marks"

    @classmethod
    def of_tally(cls, tally: ReceiverTally) -> float:
        """Its mean over the run."""
        return tally.error / max(1, tally.offered)

    @classmethod
    def sums_of_trials(cls, tally: TrialTally) -> Floats | None:
        """Its sum over the slots of every trial, (R,)."""
        return tally.error

    @staticmethod
    def values(slots: ScoredSlots) -> Floats:
        """The error, (c, R)."""
        return slots.error


@final
class MeanSquaredError(MeanError):
    """The mean of |x − x̂|²."""

    meaning = "of |x − x̂|²; null in a covariance-only study"
    not_in_mode = COVARIANCE_ONLY
    rests_on = "recorder"
    column = MetricColumn("mean |x−x̂|²", 2)


@final
class MeanActualTraceCovariance(MeanError):
    """The mean trace of the actual error covariance given the events."""

    meaning = "in a covariance-only study, of the trace of the actual error covariance given the events"
    only_in_mode = COVARIANCE_ONLY
    column = MetricColumn("actual tr P", 2)
