"""The fractions of packets that a receiver received and used, late ones included."""

from __future__ import annotations

from typing import final

import numpy as np

from evedrop.model.metrics.metric import (
    MeanMetric,
    MetricColumn,
    ReceiverTally,
    ScoredSlots,
    TallyMetric,
    TrialTally,
)
from evedrop.model.process import Floats
from evedrop.model.receiver import Action


@final
class ReceivedFraction(MeanMetric, TallyMetric):
    """The fraction of packets that were received."""

    meaning = "packets received"
    rests_on = "recorder"
    column = MetricColumn("received", 0, ".4f")

    @classmethod
    def of_tally(cls, tally: ReceiverTally) -> float:
        """The fraction over the run."""
        return (tally.received + tally.late) / max(1, tally.offered)

    @classmethod
    def sums_of_trials(cls, tally: TrialTally) -> Floats | None:
        """Counts of packets received in every trial, (R,)."""
        return tally.received.astype(np.float64)

    @staticmethod
    def values(slots: ScoredSlots) -> Floats:
        """Counts of packets received, (c, R)."""
        received: Floats = (slots.action != Action.LOST).astype(np.float64)
        return received if slots.late is None else np.add(received, slots.late[0], out=received)


@final
class UsedFraction(MeanMetric, TallyMetric):
    """The fraction of packets that were received and used."""

    meaning = "packets received and used"
    column = MetricColumn("used", 1, ".4f")

    @classmethod
    def of_tally(cls, tally: ReceiverTally) -> float:
        """The fraction over the run."""
        return (tally.used + tally.late_used) / max(1, tally.offered)

    @classmethod
    def sums_of_trials(cls, tally: TrialTally) -> Floats | None:
        """Counts of packets received and used in every trial, (R,)."""
        return tally.used.astype(np.float64)

    @staticmethod
    def values(slots: ScoredSlots) -> Floats:
        """Counts of packets received and used, (c, R)."""
        used: Floats = ((slots.action != Action.LOST) & (slots.action != Action.DISCARDED)).astype(np.float64)
        return used if slots.late is None else np.add(used, slots.late[1], out=used)
