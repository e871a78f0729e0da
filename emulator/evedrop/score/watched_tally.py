"""Quantities of a receiver that its tally does not have: metrics over some slots, packages' metrics, when it was synchronised.

They take a number for each trial and expectation. A trial's numbers are added slot by slot, so they have the same bits
however its slots and the other trials were divided, live and in memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeVar, final

import numpy as np

from evedrop.errors import NoAnswer
from evedrop.model.metrics import METRICS, metric, metrics_of
from evedrop.model.metrics.metric import MetricTally, ScoredSlots, TallyMetric
from evedrop.model.process import Floats
from evedrop.model.receiver import Action
from evedrop.model.registry import CLASS_ERRORS, place_of
from evedrop.scenario.expect import ExpectTable
from evedrop.scenario.tables import Scenario

T = TypeVar("T")


@final
class GuardedTally(MetricTally):
    """The tally of a package's metric, which never raises an error."""

    def __init__(self, name: str, trials: int) -> None:
        """name: the metric's name."""
        self._name, self._trials = name, trials
        self.failure = ""
        """Why the metric is None, if it failed."""
        self._tally: MetricTally | None = None

    def begin(self) -> None:
        """Make the package's tally now, not with the first slot."""
        self._asked(lambda: self._begun)

    def add(self, slots: ScoredSlots) -> None:
        """Add the next slots."""
        self._asked(lambda: self._begun.add(slots))

    @classmethod
    def merged(cls, parts: Sequence[GuardedTally]) -> GuardedTally:
        """The tally of disjoint sets of trials, in their order."""
        whole = cls(parts[0]._name, sum(part._trials for part in parts))
        whole.failure = next((part.failure for part in parts if part.failure), "")
        tallies = whole._asked(lambda: [part._begun for part in parts])
        whole._tally = whole._asked(lambda: type(tallies[0]).merged(tallies)) if tallies else None
        return whole

    @property
    def value(self) -> float | None:
        """The metric over the slots so far; None if it has no value, or if it is not a number."""
        value = self._asked(lambda: _number(self._begun.value))
        return None if value is None or math.isnan(value) else value

    @property
    def of_trials(self) -> Floats | None:
        """The metric of every trial, (R,); None if it failed."""
        return self._asked(lambda: _numbers(self._begun.of_trials, self._trials))

    @property
    def _begun(self) -> MetricTally:
        if self._tally is None:
            tally: object = metric(self._name).tally(self._trials)
            if not isinstance(tally, MetricTally):
                raise NoAnswer(f"tally() gave {tally!r:.40}; expected a MetricTally")
            self._tally = tally
        return self._tally

    def fail(self, why: str) -> None:
        """From now on the metric is None; why: in words."""
        self.failure, self._tally = f"the metric {self._name} of an installed package failed: {why}", None

    def _asked(self, ask: Callable[[], T]) -> T | None:
        if not self.failure:
            try:
                return ask()
            except CLASS_ERRORS as error:
                self.fail(place_of(error))
        return None


def _number(answer: object) -> float | None:
    if answer is None or (isinstance(answer, (int, float, np.number)) and not isinstance(answer, bool)):
        return None if answer is None else float(answer)
    raise NoAnswer(f"value gave {answer!r:.40}; expected a number, or None")


def _numbers(answer: object, trials: int) -> Floats:
    if isinstance(answer, np.ndarray) and answer.shape == (trials,):
        return answer.astype(np.float64)
    raise NoAnswer(f"of_trials gave {answer!r:.40}; expected an array of {trials} numbers")


SYNCHRONISED = "synchronised"
_NEVER = -1


class WatchedQuantity(NamedTuple):
    """A quantity to keep, over the slots from `first` to before `end`."""

    metric: str
    """A metric's name, or `synchronised`."""
    first: int
    end: int


def watch_of(scenario: Scenario, expect: ExpectTable) -> tuple[str, WatchedQuantity] | None:
    """The receiver and the quantity that an expectation needs; None if the summary's metrics are enough."""
    if expect.synchronised is not None:
        return expect.synchronised, WatchedQuantity(SYNCHRONISED, _since(scenario, expect), scenario.slots)
    if expect.metric is None or (expect.slots is None and expect.quantile is None):
        return None
    receiver, _, name = expect.metric.partition(".")
    return receiver, WatchedQuantity(name, *(expect.slots or (0, scenario.slots)))


def _since(scenario: Scenario, expect: ExpectTable) -> int:
    """The slot from which a receiver must come into step: `since`, or the slot of the last event on it up to slot `by`."""
    if expect.since is not None:
        return expect.since
    by = scenario.slots if expect.by is None else expect.by
    over = [act.at for act in scenario.timeline.acts if expect.synchronised in act.names and act.at <= by]
    return max(over, default=0)


def watches_of(scenario: Scenario) -> dict[str, tuple[WatchedQuantity, ...]]:
    """Receiver → all quantities that its metrics and the scenario's expectations need."""
    wanted = [watch for expect in scenario.expect if (watch := watch_of(scenario, expect)) is not None]
    watches = {}
    for receiver in scenario.receivers:
        own = [
            WatchedQuantity(name, 0, scenario.slots)
            for name, kind in metrics_of(receiver).items()
            if not issubclass(kind, TallyMetric)
        ]
        watches[receiver] = tuple(dict.fromkeys([*own, *(watch for name, watch in wanted if name == receiver)]))
    return watches


@final
class FirstState(MetricTally):
    """The first slot of each trial in which a packet was used as the state."""

    def __init__(self, trials: int) -> None:
        self._first = np.full(trials, _NEVER)

    def add(self, slots: ScoredSlots) -> None:
        """Add the next slots."""
        states = slots.action == int(Action.STATE)
        new = states.any(axis=0) & (self._first == _NEVER)
        self._first[new] = slots.first + states.argmax(axis=0)[new]

    @classmethod
    def merged(cls, parts: Sequence[FirstState]) -> FirstState:
        """The first slots of disjoint sets of trials, in their order."""
        whole = cls(0)
        whole._first = np.concatenate([part._first for part in parts])
        return whole

    @property
    def value(self) -> int | None:
        """The largest of them; None if a trial has no such slot."""
        return None if (self._first == _NEVER).any() else int(self._first.max())


def _tally(name: str, trials: int) -> MetricTally:
    """A tally of a quantity, of no slots yet."""
    if name == SYNCHRONISED:
        return FirstState(trials)
    return GuardedTally(name, trials) if METRICS.foreign(name) else metric(name).tally(trials)


@final
class WatchedTally:
    """Keeps the tallies of these quantities over R trials."""

    def __init__(self, watches: Iterable[WatchedQuantity], trials: int) -> None:
        self._tallies: dict[WatchedQuantity, MetricTally] = {}
        self.watch(watches, trials)

    def watch(self, watches: Iterable[WatchedQuantity], trials: int) -> None:
        """Keep these quantities, too, whose first slots have not been added yet."""
        for watch in watches:
            if watch not in self._tallies:
                self._tallies[watch] = _tally(watch.metric, trials)

    def add_slots(self, slots: ScoredSlots) -> None:
        """Add the next slots."""
        for watch, tally in self._tallies.items():
            start, stop = max(watch.first - slots.first, 0), min(watch.end - slots.first, slots.count)
            stateless = slots.x is None and watch.metric != SYNCHRONISED and metric(watch.metric).needs_states
            if start < stop and not stateless:
                tally.add(slots.rows(slice(start, stop)))

    def begin(self) -> None:
        """Make the tallies of packages' metrics now, not with the first slot."""
        for tally in self.of_packages.values():
            tally.begin()

    @property
    def of_packages(self) -> dict[WatchedQuantity, GuardedTally]:
        """The tallies of packages' metrics."""
        return {watch: tally for watch, tally in self._tallies.items() if isinstance(tally, GuardedTally)}

    @property
    def failures(self) -> list[str]:
        """Why metrics of packages failed, in words."""
        return [tally.failure for tally in self.of_packages.values() if tally.failure]

    def tally(self, watch: WatchedQuantity) -> MetricTally:
        """The tally of a quantity over its slots."""
        return self._tallies[watch]

    @classmethod
    def merged(cls, parts: Sequence[WatchedTally]) -> WatchedTally:
        """The quantities of disjoint sets of trials, in their order."""
        total = cls((), 0)
        total._tallies = {
            watch: type(tally).merged([part._tallies[watch] for part in parts])
            for watch, tally in parts[0]._tallies.items()
        }
        return total
