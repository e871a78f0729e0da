"""Makes a case that breaks a promise smaller, as long as it still breaks the same one.

Another case has other interleavings, so a smaller case that should fail may be lucky: it is tried with other seeds of the world,
too, once nothing smaller fails with its own.

Source: docs/maintainers/simulated-world.md, a failing seed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar, cast, final

from evedrop.errors import EvedropError, ScenarioError
from evedrop.names import LEGITIMATE
from evedrop.scenario.loading import Scenario
from evedrop.virtual.cases import SimulatedCase
from evedrop.virtual.disturbance import Disturbance, processes_of
from evedrop.virtual.drawn_hosts import DrawnHosts
from evedrop.virtual.host_parts import host_of

Tables = dict[str, Any]

MOST_PLAYS = 200
_SEEDS = 3
"""Seeds of the world with which smaller cases are tried, one after the other."""
_FIRST_AFTER = 40
"""Events before the first slot, about: a fault is not moved into them with the slots."""
_MASKS = (
    (r";.*", ""),
    (r" *\([^()]*\)", ""),
    (r"\br?[0-9a-f]{8,}\b", "#"),
    (r"-?\d+(\.\d+)?(e[-+]?\d+)?|\b(nan|inf)\b", "#"),
    (r"[\[]+#(, #)*[\]]+", "#"),
    (r"\b(sensor|router|relay|legitimate|controller|recorder|launcher)\b|\beve#", "@"),
    (r"@(( and|,) @)+", "@"),
)
"""What differs between two misses of one kind: hints, names of runs and processes, digests, numbers, and lists of numbers."""
_SIMPLE_ENCODINGS: tuple[Tables, ...] = ({"scheme": "plain"}, {"scheme": "innovation", "state_probability": 0.6})
_SIMPLE_LINKS: tuple[Tables, ...] = ({"quality": 1.0}, {"quality": 0.5})
"""The simplest one first."""
_SIMPLE_STRATEGY = "naive"
_SIMPLE_PROCESS: Tables = {"A": [[1.0]], "Q": [[0.01]], "initial_covariance": [[1.0]]}


class ShrinkableCase(Protocol):
    """The part of a case that is used here; a dataclass with a field `seed`, for the seed of the world."""

    def to_text(self) -> str:
        """The case in one line."""


C = TypeVar("C", bound=ShrinkableCase)
Reduction = Callable[[C], Iterator[C]]
"""A case → the smaller cases next to it, the smallest first."""


@final
@dataclass(frozen=True)
class Shrunk(Generic[C]):
    """A small case that breaks a promise."""

    case: C
    misses: tuple[str, ...]
    plays: int
    """How many cases were played to find it."""


def kind_of(miss: str) -> str:
    """What a miss is about, without numbers and names: misses of one kind have one cause."""
    for pattern, mask in _MASKS:
        miss = re.sub(pattern, mask, miss)
    return miss


def shrink(
    case: C,
    misses: Sequence[str],
    play: Callable[[C], Sequence[str]],
    most: int = MOST_PLAYS,
    reductions: Sequence[Reduction[C]] = (),
) -> Shrunk[C]:
    """Find a smaller case with a miss of the same kind. Plays at most `most` cases.

    play: the misses of a case; reductions: those of its kind, by default of a `SimulatedCase`.
    """
    shrinker = _Shrinker(case, tuple(misses), play, most, reductions or cast("Sequence[Reduction[C]]", _REDUCTIONS))
    for seed in range(_SEEDS):
        shrinker.try_all(seed)
    return Shrunk(shrinker.case, shrinker.misses, shrinker.plays)


@final
class _Shrinker(Generic[C]):
    """The smallest case so far."""

    def __init__(
        self,
        case: C,
        misses: tuple[str, ...],
        play: Callable[[C], Sequence[str]],
        most: int,
        reductions: Sequence[Reduction[C]],
    ) -> None:
        self.case, self.misses, self.plays = case, misses, 0
        self._play, self._most, self._reductions = play, most, reductions
        self._kinds = set(map(kind_of, misses))
        self._tried = {case.to_text()}

    def try_all(self, seed: int) -> None:
        """Try all reductions until none succeeds; seed: number of the seed of the world, 0: that of the case."""
        smaller = True
        while smaller:
            smaller = False
            for reduction in self._reductions:
                while self._try(reduction, seed):
                    smaller = True

    def _try(self, reduction: Reduction[C], seed: int) -> bool:
        """Try the cases of a reduction until one breaks the promise."""
        for smaller in reduction(self.case):
            candidate = cast(C, replace(cast(Any, smaller), seed=seed)) if seed else smaller
            if self.plays < self._most and self._breaks(candidate):
                return True
        return False

    def _breaks(self, candidate: C) -> bool:
        text = candidate.to_text()
        if text in self._tried:
            return False
        self._tried.add(text)
        self.plays += 1
        try:
            misses = tuple(self._play(candidate))
        except EvedropError:  # it cannot even be computed in memory
            return False
        if self._kinds.isdisjoint(map(kind_of, misses)):
            return False
        self.case, self.misses = candidate, misses
        return True


# Reductions: each gives the smaller cases next to a case, the smallest first.


def _fewer_faults(case: SimulatedCase) -> Iterator[SimulatedCase]:
    faults = case.faults
    if len(faults) > 1:
        yield replace(case, faults=())
    for i in range(len(faults)):
        yield replace(case, faults=(*faults[:i], *faults[i + 1 :]))


def _fewer_eavesdroppers(case: SimulatedCase) -> Iterator[SimulatedCase]:
    names = list(case.scenario.eavesdroppers)
    if len(names) > 1:
        yield from _changed(case, {"eavesdroppers": None})
    for name in reversed(names):
        yield from _changed(case, {f"eavesdroppers.{name}": None})


def _fewer_slots(case: SimulatedCase) -> Iterator[SimulatedCase]:
    slots = case.scenario.slots
    for fewer in dict.fromkeys((1, 2, 4, slots // 4, slots // 2, slots * 3 // 4, slots - 1)):
        if not 0 < fewer < slots:
            continue
        for smaller in _changed(case, {"slots": fewer}):
            yield smaller
            earlier = (_earlier(fault, fewer / slots) for fault in smaller.faults)
            yield replace(smaller, faults=tuple(earlier))


def _earlier(fault: Disturbance, fraction: float) -> Disturbance:
    """The same fault in a shorter run."""
    rest = max(0, fault.after - _FIRST_AFTER)
    return replace(fault, after=min(fault.after, _FIRST_AFTER) + round(rest * fraction))


def _fewer_trials(case: SimulatedCase) -> Iterator[SimulatedCase]:
    trials, recorded = case.scenario.trials, case.scenario.record_trials
    for fewer in (1, trials // 2):
        if 0 < fewer < trials:
            yield from _changed(case, {"trials": fewer, "record_trials": min(fewer, recorded)})
    if recorded > 1:
        yield from _changed(case, {"record_trials": 1})


def _without_tables(case: SimulatedCase) -> Iterator[SimulatedCase]:
    tables = case.scenario.as_tables()
    for names in (
        ("expect",),
        ("nemesis",),
        ("event",),
        ("integrity", "event"),
        ("comfort",),
        ("shards",),
        ("network",),
        ("controller", "plant"),
        ("pace",),
        ("longest_outage",),
    ):
        if names[0] in tables:
            yield from _changed(case, dict.fromkeys(names))
    events = tables.get("event", [])
    for i in range(len(events)):
        yield from _changed(case, {"event": [*events[:i], *events[i + 1 :]]})
    if "attack" in tables.get("acknowledgements", {}):
        yield from _changed(case, {"acknowledgements.attack": None, "acknowledgements.jammer": None})


def _simpler_scheme(case: SimulatedCase) -> Iterator[SimulatedCase]:
    for encoding in _SIMPLE_ENCODINGS:
        if case.scenario.encoding.scheme == encoding["scheme"]:
            return
        yield from _changed(case, {"encoding": encoding, "acknowledgements": None})


def _simpler_strategies(case: SimulatedCase) -> Iterator[SimulatedCase]:
    for name, table in case.scenario.as_tables().get("eavesdroppers", {}).items():
        if table["strategy"] != _SIMPLE_STRATEGY:
            simple = {"strategy": _SIMPLE_STRATEGY, "link": table["link"]}
            yield from _changed(case, {f"eavesdroppers.{name}": simple})


def _simpler_receivers(case: SimulatedCase) -> Iterator[SimulatedCase]:
    """Without windows, and with links that lose no packet, or each with the same probability."""
    tables = case.scenario.as_tables()
    for name in case.scenario.receivers:
        place = LEGITIMATE if name == LEGITIMATE else f"eavesdroppers.{name}"
        table = tables[LEGITIMATE] if name == LEGITIMATE else tables["eavesdroppers"][name]
        if "window" in table:
            yield from _changed(case, {f"{place}.window": None})
        for link in _SIMPLE_LINKS:
            if table["link"] == link:
                break
            yield from _changed(case, {f"{place}.link": link})
        for entry in ("delay", "duplicate", "corrupt"):
            if entry in table["link"]:
                yield from _changed(case, {f"{place}.link.{entry}": None})


def _simpler_process(case: SimulatedCase) -> Iterator[SimulatedCase]:
    tables = case.scenario.as_tables()
    if tables["process"] != _SIMPLE_PROCESS:
        yield from _changed(case, {"process": _SIMPLE_PROCESS})
    if "seed" in tables:
        yield from _changed(case, {"seed": None})


def _fewer_hosts(case: SimulatedCase) -> Iterator[SimulatedCase]:
    if case.hosts is not None:
        for hosts in case.hosts.smaller():
            yield _with_hosts(case, hosts)


def _plainer_program(case: SimulatedCase) -> Iterator[SimulatedCase]:
    for program in () if case.program is None else case.program.smaller():
        yield replace(case, program=program)


def _with_hosts(case: SimulatedCase, hosts: DrawnHosts | None) -> SimulatedCase:
    """The case with other hosts, and without faults of those that are no longer there."""
    there = {"", *(() if hosts is None else hosts.oddities)}
    return replace(case, hosts=hosts, faults=tuple(fault for fault in case.faults if host_of(fault.target) in there))


def _rounder_faults(case: SimulatedCase) -> Iterator[SimulatedCase]:
    for i, fault in enumerate(case.faults):
        for rounder in _rounder(fault):
            yield replace(case, faults=(*case.faults[:i], rounder, *case.faults[i + 1 :]))


def _rounder(fault: Disturbance) -> Iterator[Disturbance]:
    for step in (1000, 100, 10):
        if fault.after > step and fault.after % step:
            yield replace(fault, after=fault.after // step * step)
    if fault.seconds is not None:
        for digits in (0, 1, 2):
            shorter = round(fault.seconds - 0.5 * 10.0**-digits, digits)
            if 0.0 < shorter < fault.seconds and len(repr(shorter)) < len(repr(fault.seconds)):
                yield replace(fault, seconds=shorter)


_REDUCTIONS = (
    _fewer_faults,
    _fewer_hosts,
    _plainer_program,
    _fewer_eavesdroppers,
    _fewer_slots,
    _fewer_trials,
    _without_tables,
    _simpler_scheme,
    _simpler_strategies,
    _simpler_receivers,
    _simpler_process,
    _rounder_faults,
)


def _changed(case: SimulatedCase, changes: Mapping[str, Any]) -> Iterator[SimulatedCase]:
    """The case with other entries, by dotted key, without what no longer belongs to it; nothing if they do not fit.

    None removes an entry.
    """
    tables = deepcopy(case.scenario.as_tables())
    for key, value in changes.items():
        *path, last = key.split(".")
        table = tables
        for name in path:
            table = table[name]
        if value is None:
            table.pop(last, None)
        else:
            table[last] = deepcopy(value)
    _fit(tables)
    try:
        scenario = Scenario(tables)
    except ScenarioError:
        return
    gone = {*processes_of(case.scenario)} - {*processes_of(scenario)}
    faults = tuple(fault for fault in case.faults if fault.target not in gone)
    program = case.program if scenario.process.given else None
    smaller = replace(case, scenario=scenario, faults=faults, program=program)
    yield smaller if case.hosts is None else _with_hosts(smaller, case.hosts.fitting(scenario))


def _fit(tables: Tables) -> None:
    """Remove what speaks of slots, receivers and inputs that are no longer there."""
    names = {LEGITIMATE, *tables.get("eavesdroppers", {})}
    events = [
        event | ({"to": min(event["to"], tables["slots"])} if "to" in event else {})
        for event in tables.pop("event", [])
        if event.get("from", event.get("at")) < tables["slots"]
        and ("spoof" in event or not names.isdisjoint(map(str, event.values())))
    ]
    if events:
        tables["event"] = events
    acknowledgements = tables.get("acknowledgements", {})
    if acknowledgements.get("jammer", LEGITIMATE) not in names:
        del acknowledgements["attack"], acknowledgements["jammer"]
    if "state_values" in tables["process"]:
        tables["process"]["state_values"] = tables["process"]["state_values"][: tables["slots"]]
    if "controller" not in tables:
        tables[LEGITIMATE].pop("knows_input", None)
        for name in ("integrity", "comfort"):
            tables.pop(name, None)
    if not any("spoof" in event for event in events):
        tables.get("integrity", {}).pop("attack", None)
    if tables.get("shards", 1) > tables["trials"]:
        del tables["shards"]
