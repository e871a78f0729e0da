"""Sums over the trials of every slot and over the slots of every trial, from which the summary is made, and histograms of slots.

Quantiles over trials are taken slot by slot from histograms that add up: they are the same for any number of workers, in bounded
memory. A bin is a quarter of an octave wide (the exponent and two bits of the mantissa), so a quantile is within 25 % of the
exact one; interpolation usually brings it within a few per cent. 512 bins span 128 octaves; smaller values count as 0, and larger
ones as infinite.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.digest import BlockSums, added_in_order
from evedrop.model.kernels.current import kernels
from evedrop.model.links.loss_model import REASONS
from evedrop.model.metrics import metric
from evedrop.model.metrics.metric import ReceiverTally, TallyMetric, TrialTally
from evedrop.model.metrics.standard_error import standard_error
from evedrop.model.process import Floats
from evedrop.model.receiver import Action, Codes, Flags
from evedrop.model.slot.link import COUNTED_BURSTS, Account
from evedrop.model.slot.records import LinkSlots
from evedrop.score.after_start import DistanceTally
from evedrop.score.conditional import ConditionalError
from evedrop.score.leak import LeakTally
from evedrop.score.watched_tally import WatchedQuantity, WatchedTally

LEVELS = (0.05, 0.5, 0.95)
"""The quantiles that are reported."""
_BINS = 512
_OCTAVES_BELOW = 24  # octaves below the scale
_MOST_ROWS = 4096
_SHIFT = 50  # keeps sign, exponent and two bits of the mantissa


@final
class SlotHistograms:
    """Histograms of one quantity in at most 4096 evenly spaced slots of a run."""

    def __init__(self, slots: int, scale: float) -> None:
        self._slots = slots
        self._stride = -(-slots // _MOST_ROWS)
        self._base = int(np.float64(scale * 2.0**-_OCTAVES_BELOW).view(np.int64)) >> _SHIFT
        self.counts = np.zeros((-(-slots // self._stride), _BINS), np.uint32)
        """The number of values in each histogram and bin, (histograms, 512)."""

    def add_values(self, first: int, values: Floats) -> None:
        """Add the values (c, R), none negative, of slots first … first+c−1."""
        skip = -first % self._stride
        chosen = values[skip :: self._stride]
        rows = len(chosen)
        if not rows:
            return
        start = (first + skip) // self._stride
        kernels.add_to_histograms(self.counts[start : start + rows], chosen, _SHIFT, self._base)

    def merge(self, other: SlotHistograms) -> None:
        """Add the histograms of further trials."""
        self.counts += other.counts

    def __getstate__(self) -> dict[str, Any]:
        """The state as a worker sends it: only the filled bins, a few per cent of up to two million."""
        filled = np.flatnonzero(self.counts).astype(np.uint32)
        return {**self.__dict__, "counts": (self.counts.shape, filled, self.counts.reshape(-1)[filled])}

    def __setstate__(self, state: dict[str, Any]) -> None:
        shape, filled, values = state["counts"]
        counts = np.zeros(shape, np.uint32)
        counts.reshape(-1)[filled] = values
        self.__dict__.update(state, counts=counts)

    def quantiles(self) -> Floats:
        """`LEVELS` of every slot, (slots, levels); NaN in slots that were left out or have no values."""
        edges = self._edges()
        quantiles = np.full((self._slots, len(LEVELS)), np.nan)
        filled = np.flatnonzero(self.counts.any(axis=0))
        low, high = (filled[0], filled[-1] + 1) if filled.size else (0, 1)
        counts = self.counts[:, low:high]
        cumulative = np.cumsum(counts, axis=1)
        rows = np.flatnonzero(cumulative[:, -1])
        for column, level in enumerate(LEVELS):
            wanted = level * cumulative[rows, -1]
            bins = (cumulative[rows] < wanted[:, None]).sum(axis=1)
            count = counts[rows, bins]
            before = cumulative[rows, bins] - count
            part = np.clip((wanted - before) / np.maximum(count, 1), 0.0, 1.0)
            bins += low
            values = edges[bins] + part * (edges[bins + 1] - edges[bins])
            # In the first and the last bin, values are known only to be too small or too large.
            quantiles[rows * self._stride, column] = np.select([bins == 0, bins == _BINS - 1], [0.0, np.inf], values)
        return quantiles

    def _edges(self) -> Floats:
        bits = (self._base + np.arange(_BINS + 1, dtype=np.int64)) << _SHIFT
        edges: NDArray[np.float64] = bits.view(np.float64).copy()
        edges[0] = 0.0
        return edges


WINDOWS = 8
"""The number of windows into which slots k ≥ 1 are divided for verdicts; their lengths differ by at most one slot."""


@final
@dataclass
class SlotSums:
    """Sums over trials, slot by slot, (c,) each."""

    trials: Floats
    error: Floats
    """Squared error, or in a covariance-only study the trace of the actual covariance."""
    error_squared: Floats
    trace: Floats
    """Reported tr P."""
    trace_squared: Floats
    received: Floats
    used: Floats

    @classmethod
    def zero(cls, slots: int) -> SlotSums:
        """Sums of no trials, to add to."""
        return cls(*(np.zeros(slots) for _ in fields(cls)))

    def add_trials(self, first: int, other: SlotSums) -> None:
        """Add the sums of further trials over some slots from `first` on."""
        rows = slice(first, first + len(other.error))
        for column in fields(self):
            getattr(self, column.name)[rows] += getattr(other, column.name)

    def with_late(self, taken: NDArray[np.uint16], used: NDArray[np.uint16]) -> SlotSums:
        """The sums with the late packets that receivers took in each slot, and those that they used, (c, R) each."""
        return replace(self, received=self.received + taken.sum(axis=1), used=self.used + used.sum(axis=1))

    @property
    def standard_errors(self) -> Floats:
        """The standard error of the mean error in each slot, (c,); NaN for one trial."""
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            mean = self.error / self.trials
            variance = np.maximum(0.0, self.error_squared / self.trials - mean * mean)
            variance = variance * self.trials / (self.trials - 1.0)
            errors: Floats = np.where(self.trials > 1, np.sqrt(variance / self.trials), np.nan)
        return errors

    def measured(self) -> SlotSums:
        """Only the slots that some trial reached: a run that was cut short lacks the last ones."""
        rows = slice(0, int(np.count_nonzero(self.trials)))
        return SlotSums(*(getattr(self, column.name)[rows] for column in fields(self)))


def squared_errors(x: Floats, x_hat: Floats) -> Floats:
    """|x − x̂|² of every slot and trial, (c, R), from (c, n, R)."""
    return kernels.squared_errors(x, x_hat)


def slot_sums(error: Floats, action: Codes, trace: Floats | None = None) -> SlotSums:
    """The sums of some slots, from error (c, R), action (c, R), and the sums of tr P and of its square, (c, 2).

    trace: if None, the error is tr P itself.
    """
    count, trials = error.shape
    errors, squares = kernels.sums(error).T
    counts = kernels.count_codes(action, len(Action))
    received = trials - counts[:, Action.LOST].astype(np.float64)
    discarded = counts[:, Action.DISCARDED]
    return SlotSums(
        trials=np.full(count, float(trials)),
        error=errors,
        error_squared=squares,
        trace=errors if trace is None else trace[:, 0],
        trace_squared=squares if trace is None else trace[:, 1],
        received=received,
        used=received - discarded,
    )


def window_of(k: NDArray[np.intp], slots: int) -> NDArray[np.intp]:
    """The window that contains each slot k ≥ 1 of a run of `slots` slots; −1 for k = 0."""
    return np.where(k == 0, -1, (k - 1) * WINDOWS // max(slots - 1, 1))


def window_bounds(slots: int) -> NDArray[np.intp]:
    """The first slot of each window of a run of `slots` slots, and the slot after the last one, (WINDOWS + 1,)."""
    return 1 - -np.arange(WINDOWS + 1) * max(slots - 1, 0) // WINDOWS


@final
class DirectionTally:
    """The squared errors of vᵀx of one receiver, summed over the slots of each window and trial."""

    def __init__(self, v: Floats, slots: int, trials: int) -> None:
        """v: the direction, (n,); slots: of the whole run."""
        self.v, self.slots = v, slots
        self.window_errors = np.zeros((WINDOWS + 1, trials))
        """As that of `Tally`."""
        self.reached: NDArray[np.int64] = np.zeros(trials, np.int64)
        """The number of slots so far, of every trial, (R,); 0 in a mode without estimates."""

    @property
    def done(self) -> int:
        """Slots that all trials have reached."""
        return int(self.reached.min(initial=self.slots))

    def add_slots(self, first: int, x: Floats, x_hat: Floats) -> None:
        """Add the slots from `first` on, from x and x̂, (c, n, R) each."""
        self.reached += len(x)
        error = np.zeros((len(x), x.shape[2]))
        for i, weight in enumerate(self.v.tolist()):
            error += weight * (x[:, i] - x_hat[:, i])
        windows = window_of(np.arange(first, first + len(x)), self.slots)
        for window in dict.fromkeys(windows.tolist()):
            self.window_errors[window] = added_in_order(self.window_errors[window], (error * error)[windows == window])

    @classmethod
    def merged(cls, parts: Sequence[DirectionTally]) -> DirectionTally:
        """The sums of disjoint sets of trials, in their order."""
        whole = cls(parts[0].v, parts[0].slots, 0)
        whole.window_errors = np.concatenate([part.window_errors for part in parts], axis=1)
        whole.reached = np.concatenate([part.reached for part in parts])
        return whole


@final
@dataclass
class Tally(ReceiverTally):
    """One receiver's tally over a run."""

    slots: int
    """The number of slots of the whole run."""
    trials: int
    watched: WatchedTally = field(default_factory=lambda: WatchedTally((), 0))
    """The tallies that its metrics and expectations need."""
    done: int = 0
    """Slots that all trials have reached."""
    conditional: ConditionalError | None = None
    """The expected errors given what happened to the packets; None where that does not determine them."""
    leak: LeakTally | None = None
    """What its packets reveal without the secret; None where that is unknown."""
    distance: DistanceTally | None = None
    """How far it is off after the start; None where nobody asks."""
    directions: dict[str, DirectionTally] = field(default_factory=dict)
    """The errors in the scenario's directions, by their names."""
    window_errors: Floats = field(init=False)
    """Sum of errors of each window and trial, (WINDOWS + 1, R); the last row is slot 0, which is in no window."""
    bursts: NDArray[np.int64] = field(init=False)
    """As in `Account`."""
    delays: NDArray[np.int64] = field(init=False)
    """As in `Account`; empty until something is counted."""
    cuts: Sequence[int] = ()
    """Slots in which an outage of the receiver begins or ends."""
    packets: NDArray[np.int64] = field(init=False)
    """Counts of the packets that each trial received, and used, late ones included, (2, R)."""

    def __post_init__(self) -> None:
        self.window_errors = np.zeros((WINDOWS + 1, self.trials))
        self._bounds = [0, *window_bounds(self.slots).tolist()]
        self.bursts = np.zeros(COUNTED_BURSTS, np.int64)
        self.delays = np.zeros(0, np.int64)
        self._finished: Floats | None = np.zeros(self.trials)
        self._unfinished = BlockSums(self.trials, self.slots, self.cuts)
        self.packets = np.zeros((2, self.trials), np.int64)

    def add_slots(self, first: int, error: Floats, sums: SlotSums, expected: Floats) -> None:
        """Add the c slots from `first` on: their errors (c, R), sums, and theoretical traces (c,)."""
        count = len(error)
        self.done += count
        self.offered += count * self.trials
        self.error += float(sums.error.sum())
        self.trace += float(sums.trace.sum())
        self.theoretical_trace += float(expected.sum()) * self.trials
        self.received += int(sums.received.sum())
        self.used += int(sums.used.sum())
        bounds = self._bounds
        for i in range(bisect_right(bounds, first) - 1, bisect_left(bounds, first + count)):
            start, stop = max(bounds[i] - first, 0), bounds[i + 1] - first
            self.window_errors[i - 1] += error[start:stop].sum(axis=0)

    def add_traces(self, first: int, traces: Floats | None) -> None:
        """Add tr P of the slots from `first` on and of every trial, (c, R); None if it is not known."""
        if traces is None:
            self._finished = None
        elif self._finished is not None:
            for sums in self._unfinished.add(range(first, first + len(traces)), traces).values():
                self._finished = self._finished + sums

    def know_traces(self, traces: Floats) -> None:
        """Set the sum of tr P over all slots of the run of every trial, (R,), which another process has computed."""
        self._finished = traces

    @property
    def traces(self) -> Floats | None:
        """Sum of tr P of each trial, (R,); None once slots were added whose tr P is not known trial by trial."""
        return None if self._finished is None else self._finished + self._unfinished.unfinished

    def account(self, link: LinkSlots, action: Codes) -> None:
        """Compare the journal of the link with the receiver's action, (c, R)."""
        received, delivered = action != int(Action.LOST), link.delivered
        self.unexplained += int(np.count_nonzero(delivered != received))
        self.packets[0] += _counts_of_trials(received)
        self.packets[1] += _counts_of_trials(received & (action != int(Action.DISCARDED)))
        count = delivered.size - int(np.count_nonzero(delivered))
        for reason, lost in zip(REASONS, link.lost.sum(axis=0, dtype=np.int64).tolist(), strict=True):
            self.lost[reason] = self.lost.get(reason, 0) + lost
            count -= lost
        silent = int(link.unsent.sum())
        self.unsent += silent
        self.late_sent += count - silent

    def account_sent(self, sent: Flags, link: LinkSlots) -> None:
        """Compare the packets that the sensor reports as sent, (c, R), with the journal of the link."""
        silent = np.count_nonzero(~sent, axis=1)
        self.unexplained += int(np.count_nonzero(link.delivered & ~sent))
        self.unexplained += int(np.abs(silent - link.unsent.astype(np.int64)).sum())

    def account_late(self, delivered: NDArray[np.uint16], taken: NDArray[np.uint16], used: NDArray[np.uint16]) -> None:
        """Compare the late packets that the router delivered in each slot, (c, R), with those that the receiver took."""
        self.late += int(taken.sum())
        self.late_used += int(used.sum())
        self.packets += taken.sum(axis=0, dtype=np.int64), used.sum(axis=0, dtype=np.int64)
        self.unexplained += int(np.count_nonzero(delivered != taken))

    def count(self, account: Account) -> None:
        """Add a link's bursts and delays."""
        self.bursts += account.bursts
        if self.delays.size < account.delays.size:
            self.delays = np.zeros(account.delays.size, np.int64)
        self.delays += account.delays

    def metric(self, name: str) -> float | None:
        """A metric of the run by its name; None if it has no value."""
        metric_class = metric(name)
        if not issubclass(metric_class, TallyMetric):
            return self.watched.tally(WatchedQuantity(name, 0, self.slots)).value
        value = metric_class.of_tally(self) if self.offered else math.nan
        return None if math.isnan(value) else value

    @property
    def alike(self) -> bool:
        """Whether there are slots, and every trial has the same: trials in memory may be cut short at different slots."""
        return self.done > 0 and self.offered == self.done * self.trials

    def of_trials(self, name: str) -> Floats | None:
        """What a metric is the mean of, for every trial, (R,).

        None if the metric is not such a mean, if that is not known, or if trials were cut short at different slots.
        """
        kind = metric(name)
        if not (kind.averages_trials and self.alike):
            return None
        if issubclass(kind, TallyMetric):
            error: Floats = self.window_errors.sum(axis=0)
            sums = kind.sums_of_trials(TrialTally(error, self.traces, self.packets[0], self.packets[1]))
            return None if sums is None else sums / self.done
        return self.watched.tally(WatchedQuantity(name, 0, self.slots)).of_trials if kind.by_trial else None

    def standard_error(self, name: str) -> float | None:
        """The standard error of a metric of the run; None if it has none."""
        return standard_error(self.of_trials(name))


def _counts_of_trials(flags: Flags) -> NDArray[np.int64]:
    """The number of flags (c, R) that are set in each trial, (R,). Bytes are added up, which takes a tenth of the time."""
    counts = np.zeros(flags.shape[1], np.int64)
    for first in range(0, len(flags), _BYTE):
        counts += flags[first : first + _BYTE].view(np.uint8).sum(axis=0, dtype=np.uint8)
    return counts


_BYTE = 255  # the largest count in a byte


def window_means(tally: Tally | DirectionTally) -> Floats:
    """Mean squared error of each window and trial, (WINDOWS, R); NaN for windows without slots."""
    lengths = np.diff(window_bounds(tally.slots))
    with np.errstate(invalid="ignore", divide="ignore"):
        means: Floats = tally.window_errors[:WINDOWS] / lengths[:, None]
    return means


def trial_means(tally: Tally | DirectionTally) -> Floats:
    """Mean error of every trial over its slots, (R,)."""
    means: Floats = tally.window_errors.sum(axis=0) / tally.slots
    return means


def quantile_of(values: Floats, level: float) -> float:
    """The quantile of values (R,), the largest of which may be infinite; between two neighbours, in proportion."""
    low, high = (float(np.quantile(values, level, method=method)) for method in ("lower", "higher"))
    return high if low == high or not math.isfinite(high) else float(np.quantile(values, level))


_COUNTED = [one.name for one in fields(ReceiverTally) if one.name != "lost"]


def merged(parts: Sequence[Tally]) -> Tally:
    """The tally of several disjoint sets of trials, in their order."""
    total = Tally(parts[0].slots, sum(part.trials for part in parts))
    total.watched = WatchedTally.merged([part.watched for part in parts])
    total.done = min(part.done for part in parts)
    for part in parts:
        for name in _COUNTED:
            setattr(total, name, getattr(total, name) + getattr(part, name))
        for reason, count in part.lost.items():
            total.lost[reason] = total.lost.get(reason, 0) + count
        total.bursts += part.bursts
        if part.delays.size:
            total.delays = part.delays + (total.delays if total.delays.size else 0)
    total.window_errors = np.concatenate([part.window_errors for part in parts], axis=1)
    for name in parts[0].directions:
        total.directions[name] = DirectionTally.merged([part.directions[name] for part in parts])
    for name in ("conditional", "distance", "leak"):
        of_parts = [tally for part in parts if (tally := getattr(part, name)) is not None]
        setattr(total, name, type(of_parts[0]).merged(of_parts) if of_parts else None)
    total.packets = np.concatenate([part.packets for part in parts], axis=1)
    traces = [part.traces for part in parts if part.traces is not None]
    total._finished = np.concatenate(traces) if len(traces) == len(parts) else None
    return total
