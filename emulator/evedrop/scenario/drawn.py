"""The events that a nemesis draws.

Each receiver has a random stream of its own: adding, changing or removing one receiver does not change the faults of the others.

Source: docs/scenario.md, nemesis.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import count
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels.elementary import log
from evedrop.model.links.loss_model import Fate
from evedrop.model.process import Floats
from evedrop.model.slot.link import NEVER
from evedrop.model.streams import Stream, root_of_seed, stream_key, uniforms
from evedrop.names import LEGITIMATE
from evedrop.scenario.across import change_mistakes
from evedrop.scenario.events import EVENTS
from evedrop.scenario.events.event import EventKind, Fault
from evedrop.scenario.nemesis import NEMESIS, NemesisTable
from evedrop.scenario.tables import Scenario
from evedrop.scenario.timeline import acts_of
from evedrop.scenario.words import as_toml, listed

MOST_EVENTS = 10_000
"""The largest number of events in a scenario: those of the file and the drawn ones together."""
_BLOCK = 256  # faults drawn at once

Span = tuple[int, int]
"""Slots [from, to)."""


def with_faults(tables: Mapping[str, Any], scenario: Scenario) -> tuple[dict[str, Any], list[str]]:
    """The tables with the nemesis replaced by its events, and its mistakes.

    scenario: the same tables as a scenario, which has a nemesis.
    """
    table = scenario.nemesis
    assert table is not None  # noqa: S101 - checked by the caller
    mistakes = [*_mistakes(table, scenario)]
    nemesis = _Nemesis(table, scenario)
    room = MOST_EVENTS - len(scenario.event)
    events = [] if mistakes else [event for _, event in zip(range(room + 1), nemesis.events(), strict=False)]
    if len(events) > room:
        mistakes.append(f"{NEMESIS}.every: comes to more than {room} events; expected fewer faults: a larger every")
    elif not mistakes and nemesis.targets and not nemesis.possible:
        mistakes.append(f"{NEMESIS}.faults: none of them may happen to any of the targets; expected cut")
    own = tables.get("event", [])
    rest = {name: entries for name, entries in tables.items() if name != NEMESIS}
    return {**rest, "event": [*own, *sorted(events, key=lambda event: int(event["from"]))]}, mistakes


def _mistakes(table: NemesisTable, scenario: Scenario) -> Iterator[str]:
    """Slots outside the run, targets that are not receivers, and a `set` that does not fit the link of a target."""
    if table.start >= scenario.slots:
        yield f"{NEMESIS}.from: is {table.start}, but the last slot is {scenario.slots - 1}; expected a slot of the run"
    if table.to is not None and table.to > scenario.slots:
        yield f"{NEMESIS}.to: is {table.to}; expected at most {scenario.slots}, the end of the run"
    for i, name in enumerate(table.targets or ()):
        if name not in scenario.receivers:
            yield f"{NEMESIS}.targets.{i}: is {as_toml(name)}; expected {listed(scenario.receivers)}"
    told = set[str]()
    for name in _targets(table, scenario) if table.set is not None else ():
        lines = [*change_mistakes(f"{NEMESIS}.set", name, table.set or {}, scenario)]
        yield from (line for line in lines if line not in told)
        told.update(lines)


def _targets(table: NemesisTable, scenario: Scenario) -> tuple[str, ...]:
    """The receivers that a nemesis may hit, in the scenario's order."""
    return tuple(name for name in scenario.receivers if table.targets is None or name in table.targets)


@final
class _Nemesis:
    """Draws the events of a nemesis in its scenario."""

    def __init__(self, table: NemesisTable, scenario: Scenario) -> None:
        self._table, self._scenario = table, scenario
        self.targets = _targets(table, scenario)
        self._until = scenario.slots if table.to is None else table.to
        self._root = stream_key(root_of_seed(scenario.seed if table.seed is None else table.seed), NEMESIS)
        self._kinds = sorted(
            (EVENTS[fault] for fault in table.faults), key=lambda kind: (_fault(kind).place, kind.kind)
        )
        self._taken = {name: self._taken_by_file(name) for name in self.targets}

    def events(self) -> Iterator[dict[str, Any]]:
        """All events: first those that concern several receivers at once, then each receiver's own."""
        for kind in self._kinds:
            if _fault(kind).together:
                yield from self._together(kind)
        for name in self.targets:
            yield from self._own(name)

    @property
    def possible(self) -> bool:
        """Whether any of the faults may happen to any of the targets."""
        return any(_fault(kind).together for kind in self._kinds) or any(map(self.kinds, self.targets))

    def kinds(self, name: str) -> list[type[EventKind]]:
        """The faults that may happen to one receiver alone, in the order of their places."""
        scenario = self._scenario
        loop = scenario.controller is not None and (
            scenario.controller.acts_on == "estimate" or scenario.legitimate.knows_input
        )
        stays = loop and name == LEGITIMATE  # the loop would stand still
        changed = any(event.does.changes_settings and name in event.names for event in scenario.event)
        return [
            kind
            for kind in self._kinds
            if not _fault(kind).together
            and not (stays and kind.does.present is False)
            and not (changed and kind.does.changes_settings)
        ]

    def _taken_by_file(self, name: str) -> list[Span]:
        """The slots in which the file's own events cut a receiver off or make it leave."""
        spans: list[Span] = []
        begun: dict[Fate, int] = {}
        for act in acts_of(self._scenario.event):
            if name not in act.names or act.effect.loses is None:
                continue
            if act.effect.loses:
                begun[act.effect.reason] = act.at
            else:
                spans.append((begun.pop(act.effect.reason, act.at), act.at))
        return spans + [(start, NEVER) for start in begun.values()]

    def _together(self, kind: type[EventKind]) -> Iterator[dict[str, Any]]:
        """Events of a kind that hits several receivers at once: an independent fair coin decides for each receiver."""
        coins = {name: self._coins(kind, name) for name in self.targets}
        for start, end, _ in self._spans(kind.kind):
            heads = [name for name in self.targets if next(coins[name])]
            inside = [name for name in heads if self._free(name, start, end)]
            for name in inside:
                self._taken[name].append((start, end))
            if inside:
                yield self._event(kind, start, end, inside)

    def _coins(self, kind: type[EventKind], name: str) -> Iterator[bool]:
        for draws in _draws(self._root, f"{kind.kind}/{name}"):
            yield from (draws[:, 0] < 0.5).tolist()

    def _own(self, name: str) -> Iterator[dict[str, Any]]:
        kinds, needed = self.kinds(name), self._scenario.leaks.get(name)
        for start, end, choice in self._spans(f"receiver/{name}") if kinds else ():
            kind = kinds[int(choice * len(kinds))]
            missed = kind.does.present is False and needed is not None and start <= needed < end
            if missed or not self._free(name, start, end):
                continue
            yield self._event(kind, start, end, name)

    def _event(self, kind: type[EventKind], start: int, end: int, names: str | list[str]) -> dict[str, Any]:
        """The table of an event."""
        given = {entry: getattr(self._table, entry) for entry in _fault(kind).entries}
        own = {entry: value for entry, value in given.items() if value is not None}
        return {"from": start, "to": end, str(kind.names_in): names, **own}

    def _free(self, name: str, start: int, end: int) -> bool:
        """Whether at least one slot separates slots [start, end) from all spans that are taken on a receiver."""
        return all(end < other or until < start for other, until in self._taken[name])

    def _spans(self, stream: str) -> Iterator[tuple[int, int, float]]:
        """The beginning and end of each fault in order, and a number in [0, 1) that chooses which fault it is."""
        before = self._table.start - 1
        for draws in _draws(self._root, stream):
            gaps, lengths = (
                _geometric(draws[:, i], mean).tolist()
                for i, mean in enumerate((self._table.every, self._table.lasting))
            )
            for gap, length, choice in zip(gaps, lengths, draws[:, 2].tolist(), strict=True):
                start = before + gap
                if start >= self._until:
                    return
                before = min(start + length, self._until)
                yield start, before, choice


def _fault(kind: type[EventKind]) -> Fault:
    assert kind.fault is not None  # noqa: S101 - checked with the table
    return kind.fault


def _draws(root: bytes, name: str) -> Iterator[Floats]:
    """Three uniform numbers in [0, 1) for each fault of a stream, (256, 3) at a time, without end."""
    stream = Stream(stream_key(root, name), range(1), 3)
    for first in count(0, _BLOCK):
        yield uniforms(stream.words(range(first, first + _BLOCK)))[:, 0]


def _geometric(u: Floats, mean: float) -> NDArray[np.int64]:
    """Geometrically distributed numbers of slots, at least 1, with this mean, from uniform numbers in [0, 1)."""
    if mean <= 1.0:
        return np.ones(len(u), np.int64)
    return 1 + (log(1.0 - u) / log(np.array([1.0 - 1.0 / mean]))).astype(np.int64)
