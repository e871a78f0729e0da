"""The error of an eavesdropper compared with the legitimate one after the start of a run, on which a verdict rests.

The first half of a run does not count: there, few packets decide. Several trials are the samples of a comparison. A single trial,
and a run that has not ended, is divided into batches of consecutive slots instead.

Source: docs/mathematics/verdicts.md, verdicts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self, final

import numpy as np

from evedrop.model.digest import added_in_order
from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats

ERROR_RATE = 0.01
"""Of a verdict: how often it may be given in error."""
AS_MUCH = 1.25
"""An eavesdropper knows as much as the legitimate estimator if its squared error is at most this many times as large."""
TOO_SHORT = "the run has too few slots"
"""Why a comparison is open, however many trials there are."""
_MOST, _FEWEST, _SHORTEST = 32, 8, 8
"""Batches before neighbours are joined; batches in the second half, and slots of a batch, that a comparison needs."""
_ROUNDING = 1e-6
"""The fraction of tr Q below which a squared error is only that of rounding."""
_CORRELATION = 0.9  # the largest correlation of neighbouring batches that is corrected for
_LARGEST = 1e300
FARTHEST = 700.0
"""The largest logarithm of a ratio that can be written."""
_HELD = 512  # slots


@dataclass(frozen=True)
class AfterStart:
    """An eavesdropper's squared error compared with the legitimate one."""

    ratio: float
    """The eavesdropper's mean squared error over the legitimate one; inf if the latter is only rounding, NaN without slots."""
    interval: tuple[float, float] | None = None
    """Of the ratio, at 99 %, or of a single trial at 98 %; None if it is not known."""
    larger: bool | None = None
    """Whether the eavesdropper's error is larger; False: at most `AS_MUCH` times as large. None: the samples do not decide it."""
    distances: tuple[float, float] | None = None
    """How far the estimates are off, root mean square: the legitimate estimator's and the eavesdropper's; None if not known."""
    why_open: str = ""
    """Why `larger` is None, as a clause."""
    in_one_trial: bool = False
    """Whether the samples are batches of slots."""

    @classmethod
    def of_batches(cls, ours: BatchMeans, theirs: BatchMeans, noise: float = 0.0) -> Self:
        """A comparison by batches, whose mean errors are positive; noise: tr Q.

        Tests the mean of the logarithm of the ratio by Student's t, with the variance for correlated batches.
        """
        over, under = theirs.later, ours.later
        if not len(under):  # not even a slot, or only one, which is in the first half
            return cls(math.nan, why_open=TOO_SHORT if ours._batches else "", in_one_trial=True)
        squares = float(under[:, 1].mean()), float(over[:, 1].mean())
        distances = None if any(map(math.isnan, squares)) else (math.sqrt(squares[0]), math.sqrt(squares[1]))
        floor = max(_ROUNDING * noise, np.finfo(float).tiny)
        mean, other = float(under[:, 0].mean()), float(over[:, 0].mean())
        ratio = 1.0 if max(mean, other) <= floor else math.inf if mean <= floor else other / mean
        if len(under) < _FEWEST or ours.length < _SHORTEST:
            return cls(ratio, None, None, distances, TOO_SHORT, in_one_trial=True)
        logarithms = np.log(np.clip(over[:, 0], floor, _LARGEST)) - np.log(np.clip(under[:, 0], floor, _LARGEST))
        low, high = _limits(logarithms)
        # Means of logarithms decide only what the ratio of the means says as well: a few large errors may make up all of a mean.
        larger = True if low > 0.0 and ratio > 1.0 else False if high < math.log(AS_MUCH) and ratio <= AS_MUCH else None
        interval = (math.exp(low), math.exp(high)) if math.isfinite(ratio) and high < FARTHEST else None
        if interval is not None and not interval[0] <= ratio <= interval[1]:
            interval = None
        return cls(ratio, interval, larger, distances, "the errors scatter too much in time", in_one_trial=True)


def ratio_interval(ratio: float, error: float | None, trials: int) -> tuple[float, float] | None:
    """The 99 % interval of a ratio of means over several trials: Student's, of its logarithm; error: its standard error.

    None without a standard error, and for a ratio, or a limit, that is 0 or cannot be written.

    Source: docs/mathematics/verdicts.md, verdicts.
    """
    if error is None or not 0.0 < ratio < math.inf:
        return None
    from scipy.special import stdtrit  # noqa: PLC0415 - takes a quarter of a second, and not every process judges

    reach = float(stdtrit(trials - 1, 1.0 - ERROR_RATE / 2)) * error / ratio
    return (ratio * math.exp(-reach), ratio * math.exp(reach)) if reach + math.log(ratio) < FARTHEST else None


def _limits(samples: Floats) -> tuple[float, float]:
    """One-sided confidence limits of the mean of samples in time, each at 99 %."""
    from scipy.special import stdtrit  # noqa: PLC0415 - takes a quarter of a second, and not every process judges

    around = samples - samples.mean()
    variance, count = float(around @ around) / (len(samples) - 1), len(samples)
    if not variance > 0.0:
        return float(samples.mean()), float(samples.mean())
    correlation = float(np.clip((around[1:] @ around[:-1]) / (around @ around), 0.0, _CORRELATION))
    spread = math.sqrt(variance / count * (1.0 + correlation) / (1.0 - correlation))
    reach = float(stdtrit(count - 1, 1.0 - ERROR_RATE)) * spread
    return float(samples.mean()) - reach, float(samples.mean()) + reach


@final
class BatchMeans:
    """Means of a receiver's squared error over batches of consecutive slots, at most 32 and all of the same length.

    When there are too many, neighbours are joined: the number of slots need not be known. The same slots give the same bits,
    however they are divided into calls.
    """

    def __init__(self) -> None:
        self.length = 1
        """Slots of a batch."""
        self._sums = np.zeros((_MOST, 2))
        self._batches, self._filled = 0, 0
        self._open = np.zeros(2)

    def add(self, errors: Floats, squared_distances: Floats) -> None:
        """Add the next c slots: squared errors of all states, and of those that a distance counts, (c,) each."""
        values, at = np.stack([errors, squared_distances], axis=1), 0
        while at < len(values):
            part = values[at : at + self.length - self._filled]
            self._open = added_in_order(self._open, part)
            self._filled, at = self._filled + len(part), at + len(part)
            if self._filled == self.length:
                self._sums[self._batches] = self._open
                self._batches, self._filled, self._open = self._batches + 1, 0, np.zeros(2)
                if self._batches == _MOST:
                    self._sums[: _MOST // 2] = self._sums[::2] + self._sums[1::2]
                    self._batches, self.length = _MOST // 2, 2 * self.length

    @property
    def later(self) -> Floats:
        """The means of the complete batches in the second half of the slots, (b, 2): of both quantities of `add`."""
        means: Floats = self._sums[(self._batches + 1) // 2 : self._batches] / self.length
        return means


@final
class DistanceTally:
    """How far one receiver's estimates are off in either half of a run; for a single trial, its errors by batches as well."""

    def __init__(self, states: int | None, slots: int, trials: int) -> None:
        """states: how many of the first states a distance counts, None for all; slots: of the whole run."""
        self._states, self._slots = states, slots
        self._first = slots // 2 + 1  # of the second half, as that of a ratio
        self._sums, self._counts = np.zeros(2), np.zeros(2, np.int64)
        self._batches = BatchMeans() if trials == 1 else None
        self._held: list[tuple[Floats, Floats]] = []
        self._held_slots = self._done = 0

    def add_slots(
        self, first: int, errors: Floats, sums: Floats, x: Floats | None = None, x_hat: Floats | None = None
    ) -> None:
        """Add the slots from `first` on.

        Squared errors (c, R) and their sums (c,), states and estimates (c, n, R), None in modes without states.
        """
        if self._states is not None:
            if x is None or x_hat is None:
                sums = np.full(len(errors), np.nan)
            else:
                sums = kernels.sums(kernels.squared_errors(x[:, : self._states], x_hat[:, : self._states]))[:, 0]
        later = errors[max(0, self._first - first) :].size
        self._counts += errors.size - later, later
        self._held.append((errors[:, 0].copy(), sums))
        self._held_slots += len(errors)
        if self._held_slots >= _HELD:
            self._add_held()

    def _add_held(self) -> None:
        """Add what is held back: messages of a few slots would each cost as much as many slots."""
        if not self._held:
            return
        errors, sums = (np.concatenate(columns) for columns in zip(*self._held, strict=True))
        earlier = max(0, self._first - self._done)
        for half, part in enumerate((sums[:earlier], sums[earlier:])):
            self._sums[half] = added_in_order(self._sums[half : half + 1], part[:, None])[0]
        if self._batches is not None:
            self._batches.add(errors, sums)
        self._done, self._held, self._held_slots = self._done + len(sums), [], 0

    @property
    def batches(self) -> BatchMeans | None:
        """The errors by batches; None for several trials, which are samples themselves."""
        self._add_held()
        return self._batches

    def distance(self, *, later: bool) -> float | None:
        """Root mean square over trials and slots, if `later` those of the second half; None without slots, or if not known."""
        self._add_held()
        halves = slice(1 if later else 0, None)
        total, count = float(self._sums[halves].sum()), int(self._counts[halves].sum())
        return math.sqrt(total / count) if count and not math.isnan(total) else None

    @classmethod
    def merged(cls, parts: Sequence[Self]) -> Self:
        """The tally of disjoint sets of trials, in their order."""
        whole = cls(parts[0]._states, parts[0]._slots, 0)
        for part in parts:
            part._add_held()
            whole._sums += part._sums
            whole._counts += part._counts
        whole._batches = parts[0].batches if len(parts) == 1 else None
        return whole


def leading_states(units: Sequence[str], n: int) -> int:
    """How many states a distance counts: the first ones, as far as they have the unit of the first; all without units."""
    return next((i for i, unit in enumerate(units) if unit != units[0]), n)
