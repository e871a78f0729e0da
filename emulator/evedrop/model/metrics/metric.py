"""The base classes of metrics: numbers that the summary has for every receiver, or for every eavesdropper.

The class of a metric says how it is summed, merged, checked and shown. No other code depends on its name.

Source: docs/metrics.md, receivers; docs/your-own/metric.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple, Self, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.model.receiver import Codes
from evedrop.model.record import Record, column

U16 = NDArray[np.uint16]
COVARIANCE_ONLY = "covariance-only"
"""The mode that simulates covariances, and no errors."""


@dataclass(frozen=True, eq=False)
class ScoredSlots(Record):
    """One receiver over c consecutive slots of R trials, compared with the true states."""

    error: Floats = column("c R", "squared error, or tr of the actual covariance in a covariance-only study")
    action: Codes = column("c R", "`Action`", "u1")
    trace: Floats = column("c", "reported tr P, summed over trials: a live run does not know it trial by trial")
    expected: Floats = column("c", "trace of the theoretical error covariance")
    late: U16 | None = column(
        "c R", "packets of earlier slots that arrived; None: the receiver accepts none", "<u2", default=None
    )
    late_used: U16 | None = column("c R", "those among them that it used", "<u2", default=None)
    x: Floats | None = column("c n R", "true states; None in modes without states", default=None)
    x_hat: Floats | None = column("c n R", "estimates; None in modes without states", default=None)

    @property
    def trials(self) -> int:
        """The number of trials."""
        return int(self.error.shape[1])


class MetricTally(ABC):
    """A metric's tally over a set of trials, whose slots come in order. Pickled between processes.

    A trial's numbers should be added slot by slot, so that they have the same bits however slots and trials were divided.
    """

    @abstractmethod
    def add(self, slots: ScoredSlots) -> None:
        """Add the next slots."""

    @classmethod
    @abstractmethod
    def merged(cls, parts: Sequence[Self]) -> Self:
        """The tally of disjoint sets of trials, in their order."""

    @property
    @abstractmethod
    def value(self) -> float | None:
        """The metric over the slots so far; None if it has no value."""

    @property
    def of_trials(self) -> Floats | None:
        """The metric of every trial, (R,); None for a metric that is not `by_trial`."""
        return None


@dataclass
class TrialTally:
    """The tally of one receiver for each trial, (R,) each. Each entry is a sum over slots."""

    error: Floats
    trace: Floats | None
    """None: not known trial by trial."""
    received: NDArray[np.int64]
    """Late packets are included here and in `used`."""
    used: NDArray[np.int64]


@dataclass(kw_only=True)
class ReceiverTally:
    """The tally of one receiver. Each entry is a sum over slots and trials."""

    offered: int = 0
    """Slots times trials: the packets that were sent, and the `unsent` ones."""
    unsent: int = 0
    error: float = 0.0
    trace: float = 0.0
    theoretical_trace: float = 0.0
    received: int = 0
    used: int = 0
    unexplained: int = 0
    """Packets for which the router's journal and another process disagree."""
    late: int = 0
    """Packets that arrived after their own slot, within the window; `late_used`: those of them that were used."""
    late_used: int = 0
    late_sent: int = 0
    """Packets that the router did not report as lost, but that arrive after their slot."""
    lost: dict[str, int] = field(default_factory=dict)
    """Reason → packets."""


class MetricColumn(NamedTuple):
    """A column of a table in the terminal. Metrics with equal columns share one, because no run has both."""

    heading: str
    place: int = 99
    """Columns are sorted by it."""
    format: str = ".4g"


class Metric(ABC):
    """A number of a receiver. A class, never an instance, is registered; its name in the registry is that in the summary."""

    of: ClassVar[Literal["receiver", "eavesdropper"]] = "receiver"
    """Whether every receiver has it, or only every eavesdropper."""
    meaning: ClassVar[str] = ""
    """Its description, with its unit."""
    by_trial: ClassVar[bool] = False
    """Whether every trial has it, so that it has quantiles over trials."""
    averages_trials: ClassVar[bool] = False
    """Whether it is the mean over trials of what every trial has, so that it has a standard error; otherwise it has none."""
    of_error: ClassVar[bool] = False
    """Whether it is a mean of errors or covariances: no standard error where theory says that their variance is infinite."""
    expected: ClassVar[str | None] = None
    """The metric of theory that it estimates, if there is one: the summary then has its z."""
    needs_states: ClassVar[bool] = False
    """Whether it needs states and estimates; it is null in modes without them."""
    needs_theory: ClassVar[bool] = False
    """Whether it is null for a receiver without theory."""
    only_in_mode: ClassVar[str | None] = None
    """The only mode whose summaries have it; no expectation can name such a metric."""
    not_in_mode: ClassVar[str | None] = None
    """The mode in which it is null."""
    rests_on: ClassVar[Literal["recorder", "recorded trials", "receiver", "theory"]] = "receiver"
    """Its source in a live run: the recorder, for all trials or only for recorded ones; the receiver's word alone; or theory."""
    column: ClassVar[MetricColumn | None] = None
    """Its column in the closing table, if it has one."""
    sweep_column: ClassVar[MetricColumn | None] = None
    """Its column in the printed table of a sweep, if it has one. The table on disk has every metric."""
    sweep_picture: ClassVar[Literal["marks", "lines"] | None] = None
    """How the picture of a sweep shows it, if it does."""

    @classmethod
    @abstractmethod
    def tally(cls, trials: int) -> MetricTally:
        """A tally of no slots yet, for this many trials. Expectations over some slots use it, too."""


class TallyMetric(Metric):
    """A mean whose sums over a whole run are in `ReceiverTally`, so that it needs no tally of its own for that."""

    sums: ClassVar[tuple[str, ...]]
    """The entries of `ReceiverTally` that are added up; the metric is their sum for each slot and trial."""
    trial_sums: ClassVar[str | None] = None
    """The entry of `TrialTally` that is the same sum for each trial, if there is one."""

    @classmethod
    def of_tally(cls, tally: ReceiverTally) -> float:
        """The metric of a whole run; NaN if it has none."""
        total: float = sum(getattr(tally, name) for name in cls.sums)
        return total / max(1, tally.offered)

    @classmethod
    def sums_of_trials(cls, tally: TrialTally) -> Floats | None:
        """What it is the mean of, summed over the slots of every trial, (R,); None if that is not known."""
        sums: NDArray[Any] | None = None if cls.trial_sums is None else getattr(tally, cls.trial_sums)
        return None if sums is None else sums.astype(np.float64)


@final
class MeanTally(MetricTally):
    """Sums of a value over slots, for each trial or for all trials together."""

    def __init__(self, values: Callable[[ScoredSlots], Floats], trials: int, by_trial: bool) -> None:
        """values: gives the value in every slot, (c, R) if by_trial, otherwise its sum over trials, (c, 1)."""
        self._values, self._by_trial = values, by_trial
        self._sums = np.zeros(trials if by_trial else 1)
        self._slots: NDArray[np.int64] = np.zeros(trials, np.int64)

    def add(self, slots: ScoredSlots) -> None:
        """Add the next slots."""
        self._slots += len(slots.error)
        for row in self._values(slots):
            self._sums += row

    @classmethod
    def merged(cls, parts: Sequence[MeanTally]) -> MeanTally:
        """The sums of disjoint sets of trials, in their order."""
        whole = cls(parts[0]._values, 0, parts[0]._by_trial)
        sums = [part._sums for part in parts]
        whole._sums = np.concatenate(sums) if whole._by_trial else np.sum(sums, axis=0)
        whole._slots = np.concatenate([part._slots for part in parts])
        return whole

    @property
    def of_trials(self) -> Floats | None:
        """The mean over its slots, for each trial, (R,); None unless by_trial, and without slots in every trial."""
        return self._sums / self._slots if self._by_trial and self._slots.all() else None

    @property
    def value(self) -> float | None:
        """The mean over slots and trials; None without slots."""
        return float(self._sums.sum()) / int(self._slots.sum()) if self._slots.any() else None


class MeanMetric(Metric):
    """A mean over slots and trials."""

    by_trial = True
    averages_trials = True

    @staticmethod
    @abstractmethod
    def values(slots: ScoredSlots) -> Floats:
        """The value in every slot and trial, (c, R); or its sum over trials, (c, 1), of a metric that is not `by_trial`."""

    @classmethod
    def tally(cls, trials: int) -> MetricTally:
        """Sums over no slots yet, for this many trials."""
        return MeanTally(cls.values, trials, cls.by_trial)
