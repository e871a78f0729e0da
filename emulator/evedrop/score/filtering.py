"""Errors against the true state, for a sensor that filters: it sends an estimate, so these differ from the usual errors.

Source: docs/metrics.md, filter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from typing import final

import numpy as np

from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.local_filter import LocalFilter, Steps
from evedrop.model.metrics.standard_error import ratio_error, standard_error, z_of
from evedrop.model.process import Floats
from evedrop.model.streams import Batch
from evedrop.names import LEGITIMATE, SENSOR
from evedrop.scenario.closed_loop import monitor_of
from evedrop.scenario.tables import Scenario
from evedrop.score.after_start import AfterStart, BatchMeans, ratio_interval
from evedrop.score.summary import FilterSummary, TrueRatio
from evedrop.score.sums import WINDOWS, squared_errors, window_bounds


def local_filter_of(
    scenario: Scenario, key: bytes, batch: Batch, spoofing: Callable[[int, Floats], Floats] | None = None
) -> LocalFilter | None:
    """The sensor's filter; None if the sensor knows the state. spoofing: as for `LocalFilter`."""
    driven = scenario.driven
    if driven is None or not scenario.measures:
        return None
    return LocalFilter(scenario.process.process, driven, key, batch, spoofing)


def true_errors(true: Floats, x: Floats, x_hats: Mapping[str, Floats]) -> dict[str, Floats]:
    """Squared errors against the true state (c, n, R): of the sensor's estimate x, and of the receivers', (c, R) each."""
    return {SENSOR: squared_errors(true, x), **{name: squared_errors(true, x_hat) for name, x_hat in x_hats.items()}}


@final
class FilterTally:
    """Sums of errors against the true state, over the slots and trials so far."""

    def __init__(self, slots: int, trials: int) -> None:
        """slots: of the whole run."""
        self._run, self._first = slots, int(window_bounds(slots)[WINDOWS // 2])
        self._alone = trials == 1
        self._later: dict[str, Floats] = {}
        self._batches = {SENSOR: BatchMeans()}  # also without a slot, as an example for those of a shard
        self.count = 0
        """Slots times trials so far."""
        self.slots = 0
        self.sums: dict[str, float] = {}
        """Sensor or receiver → sum of squared errors."""
        self.of_trials: dict[str, Floats] = {}
        """The same for each trial, (R,)."""

    @classmethod
    def from_scenario(cls, scenario: Scenario, trials: int) -> FilterTally | None:
        """A tally of some trials of a scenario; None if its sensor knows the state."""
        return cls(scenario.slots, trials) if scenario.measures else None

    def add_errors(self, errors: Mapping[str, Floats]) -> None:
        """Add the next slots, errors as from `true_errors`, (c, R) each."""
        later = max(0, self._first - self.slots)
        self.slots += len(errors[SENSOR])
        self.count += errors[SENSOR].size
        for name, error in errors.items():
            self._later[name] = self._later.get(name, 0.0) + error[later:].sum(axis=0)
            if self._alone:
                self._batches.setdefault(name, BatchMeans()).add(error[:, 0], error[:, 0])
            self.sums[name] = self.sums.get(name, 0.0) + float(error.sum(axis=1).sum())
            self.of_trials[name] = self.of_trials.get(name, 0.0) + error.sum(axis=0)

    @classmethod
    def merged(cls, parts: Sequence[FilterTally | None]) -> FilterTally | None:
        """The sums of several sets of trials, in order."""
        tallies = [part for part in parts if part is not None]
        if not tallies:
            return None
        whole = copy(tallies[0])
        whole.sums = dict(whole.sums)
        for part in tallies[1:]:
            whole.slots = min(whole.slots, part.slots)
            whole.count += part.count
            for name, value in part.sums.items():
                whole.sums[name] = whole.sums.get(name, 0.0) + value
        whole.of_trials = _concatenated([part.of_trials for part in tallies])
        whole._later = _concatenated([part._later for part in tallies])
        whole._alone = whole._alone and len(tallies) == 1
        return whole

    def compared(self, name: str, infinite_variance: bool = False) -> AfterStart:
        """A receiver's error against the true state over the legitimate one, in the same slots as the ratio of a verdict.

        infinite_variance: of an error of either, so that there is no interval over several trials.
        """
        if self._alone and name in self._batches:
            return AfterStart.of_batches(self._batches[LEGITIMATE], self._batches[name])
        sums = self._later if self.slots == self._run > self._first else self.of_trials
        if name not in sums or not self._alike:
            return AfterStart(math.nan)
        over, under = sums[name], sums[LEGITIMATE]
        theirs, ours = float(np.mean(over)), float(np.mean(under))
        # Over a perfect link the legitimate error is 0 where measurements are exact.
        ratio = theirs / ours if ours > 0.0 else math.inf if theirs > 0.0 else 1.0
        error = None if infinite_variance or self.slots < self._run else ratio_error(over, under)
        return AfterStart(ratio, ratio_interval(ratio, error, len(over)))

    @property
    def _alike(self) -> bool:
        """Whether all trials have the same slots."""
        return all(self.slots * len(values) == self.count for values in self.of_trials.values())

    def summary(self, scenario: Scenario, compared: Mapping[str, AfterStart], heavy: Collection[str]) -> FilterSummary:
        """The summary's entry on the filter.

        compared: eavesdropper → what `compared` gives; heavy: receivers whose errors have infinite variance.
        """
        driven = scenario.driven
        assert driven is not None  # noqa: S101 - else there is no tally
        steps = Steps(scenario.process.process, driven)
        traces: list[float] = []
        last = 0.0
        while len(traces) < self.slots and not steps.settled:
            last = float(np.trace(steps.next().covariance))
            traces.append(last)
        mean = (sum_in_order(traces) + (self.slots - len(traces)) * last) / max(1, self.slots)
        errors = {name: value / max(1, self.count) for name, value in self.sums.items()}
        own = errors.pop(SENSOR, None)
        mean_trace = mean if self.slots else None
        alike = self._alike
        spread = {
            name: standard_error(values / self.slots) if alike and name not in heavy else None
            for name, values in self.of_trials.items()
        }
        error, own_of_trials = spread.pop(SENSOR, None), self.of_trials.get(SENSOR)
        plan = monitor_of(scenario)
        # Theory expects the error of a filter that gets the true measurements.
        attacked = plan is not None and plan.attack is not None and any(start < self.slots for start, _ in plan.spans)
        comparable = alike and self.slots and not attacked
        z = z_of(own_of_trials / self.slots, mean_trace) if comparable and own_of_trials is not None else None
        of_mean = {"mean_squared_error": error, "mean_true_squared_errors": spread}
        ratios = {
            name: TrueRatio(values.ratio, values.interval)
            for name, values in compared.items()
            if math.isfinite(values.ratio)
        }
        return FilterSummary(mean_trace, own, errors, of_mean, z, ratios)


def _concatenated(of_parts: Sequence[Mapping[str, Floats]]) -> dict[str, Floats]:
    """Values of trials by name, of parts that have the same names; those without a slot have none."""
    some = [values for values in of_parts if values]
    return {name: np.concatenate([values[name] for values in some]) for name in (some[0] if some else ())}
