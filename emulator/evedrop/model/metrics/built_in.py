"""The built-in metrics of a receiver: the fractions of packets that it received and used, its error, and covariances.

Late packets are included. There are two covariances: the one that the receiver reports, and the theoretical one. The
account of a link's packets has the entries that expectations can name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self, final

import numpy as np

from evedrop.model.metrics.metric import (
    COVARIANCE_ONLY,
    MeanMetric,
    MetricColumn,
    MetricTally,
    ReceiverTally,
    ScoredSlots,
    TallyMetric,
)
from evedrop.model.process import Floats
from evedrop.model.receiver import Action


@final
class ReceivedFraction(MeanMetric, TallyMetric):
    """The number of packets that were received per slot: a sensor that stays silent lowers it, too."""

    meaning = "packets received per slot"
    rests_on = "recorder"
    column = MetricColumn("received", 0, ".4f")
    sums = ("received", "late")
    trial_sums = "received"

    @staticmethod
    def values(slots: ScoredSlots) -> Floats:
        """Counts of packets received, (c, R)."""
        received: Floats = (slots.action != int(Action.LOST)).astype(np.float64)
        return received if slots.late is None else np.add(received, slots.late, out=received)


@final
class UsedFraction(MeanMetric, TallyMetric):
    """The number of packets that were received and used per slot."""

    meaning = "packets received and used per slot"
    column = MetricColumn("used", 1, ".4f")
    sums = ("used", "late_used")
    trial_sums = "used"

    @staticmethod
    def values(slots: ScoredSlots) -> Floats:
        """Counts of packets received and used, (c, R)."""
        used: Floats = ((slots.action != int(Action.LOST)) & (slots.action != int(Action.DISCARDED))).astype(np.float64)
        return used if slots.late_used is None else np.add(used, slots.late_used, out=used)


class MeanError(MeanMetric, TallyMetric):
    """The mean of the mode's error: |x − x̂|², or in a covariance-only study the trace of the actual covariance."""

    of_error = True
    expected = "theoretical_trace_covariance"
    sweep_column = MetricColumn("mean error", 0)
    sweep_picture = "marks"
    sums = ("error",)
    trial_sums = "error"

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


@final
class MeanTraceCovariance(MeanMetric, TallyMetric):
    """The mean of tr P, where P is the covariance that the receiver reports."""

    meaning = "of tr P, the error covariance that the receiver reports"
    by_trial = False
    of_error = True
    rests_on = "recorded trials"
    column = MetricColumn("reported tr P", 3)
    sweep_column = MetricColumn("reported tr P", 2)
    sums = ("trace",)
    trial_sums = "trace"

    @staticmethod
    def values(slots: ScoredSlots) -> Floats:
        """The sum of tr P over trials, (c, 1)."""
        return slots.trace[:, None]


@final
class TheoreticalTraceCovariance(TallyMetric):
    """The mean trace of the theoretical error covariance."""

    meaning = (
        "trace of the theoretical error covariance over the same slots; null if no theory covers the losses "
        "of its link, or if no closed form is known for its strategy"
    )
    needs_theory = True
    rests_on = "theory"
    column = MetricColumn("theoretical tr P", 4)
    sweep_column = MetricColumn("theoretical tr P", 1)
    sweep_picture = "lines"
    sums = ("theoretical_trace",)

    @classmethod
    def tally(cls, trials: int) -> MetricTally:
        """A tally of no slots yet."""
        del trials
        return TheoreticalTraces()


@final
class TheoreticalTraces(MetricTally):
    """The theoretical traces of some slots, which are the same for all trials."""

    def __init__(self) -> None:
        self._traces: list[Floats] = []

    def add(self, slots: ScoredSlots) -> None:
        """Add the next slots."""
        self._traces.append(slots.expected.copy())

    @classmethod
    def merged(cls, parts: Sequence[TheoreticalTraces]) -> TheoreticalTraces:
        """The traces of the first set of trials, which are those of all."""
        return parts[0]

    @property
    def value(self) -> float | None:
        """Their mean; None without slots."""
        return float(np.mean(np.concatenate(self._traces))) if self._traces else None


@dataclass(frozen=True)
class LinkAccount:
    """The packets of one link: every packet offered is delivered, or lost for a reason."""

    offered: int
    """Packets that the sensor sent."""
    delivered: int
    """Packets that the receiver counted itself, late ones included."""
    late: int
    lost: int
    """Packets lost according to the router's journal."""
    unexplained: int
    """Packets for which the journal and another process disagree."""

    @classmethod
    def of(cls, tally: ReceiverTally) -> Self:
        """The account of a receiver's link."""
        # In a run cut short, packets that are still under way count as lost; in a whole run, the router reports them itself.
        lost = sum(tally.lost.values()) + max(0, tally.late_sent - tally.late)
        delivered = tally.received + tally.late
        offered = tally.offered - tally.unsent
        missing = abs(offered - delivered - lost)
        return cls(offered, delivered, tally.late, lost, max(missing, tally.unexplained))


LINK_METRICS = (*(one.name for one in fields(LinkAccount)), "rate")
"""The metrics of a link; `rate` is the fraction of packets that its loss model let through."""
