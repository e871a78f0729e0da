"""The events of a scenario in order: the slots before which the run is held, what is done then, and the effect on each link.

Source: docs/scenario.md, events.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from evedrop.model.links.link import Fate
from evedrop.model.slot.link import NEVER, Change, ReceiverOutage
from evedrop.scenario.events import EventTable
from evedrop.scenario.words import as_toml

_REASONS = {"kill": Fate.DOWN, "pause": Fate.PAUSED}
_ENDS = {"cut": "heal", "partition": "heal", "jam": "jammed", "kill": "restart", "pause": "resume"}
_JAMMING = {"jam": "acknowledgements are attacked", "jammed": "acknowledgements are no longer attacked"}

Changed = Callable[[str, Mapping[str, Any]], dict[str, Any]]
"""Maps a receiver and the changed entries of its link to the link's new settings."""


@dataclass(frozen=True)
class Act:
    """One thing done at one slot."""

    at: int
    kind: str
    """`set`, `cut`, `heal`, `kill`, `restart`, `pause`, `resume`, `jam`, `jammed` or `note`."""
    names: tuple[str, ...]
    """The receivers it is done to."""
    changes: Mapping[str, Any] | None = None
    """For a `set`: the link's entries; None restores those of the scenario."""
    text: str = ""
    """For a note."""

    @property
    def said(self) -> str:
        """The act as a line of a journal."""
        if self.kind == "note":
            return self.text
        if self.kind in _JAMMING:
            return _JAMMING[self.kind]
        if self.kind != "set":
            return f"{self.kind} {', '.join(self.names)}"
        changes = (
            [] if self.changes is None else [f"{entry} = {as_toml(value)}" for entry, value in self.changes.items()]
        )
        return f"link {', '.join(self.names)}: {', '.join(changes) or 'as at first'}"


@dataclass(frozen=True)
class Away(ReceiverOutage):
    """An outage of a receiver, and what the receiver knows when it comes back."""

    keeps_state: bool = True
    """False: it restarts from the prior of the slot in which it went away."""


@dataclass(frozen=True)
class Timeline:
    """The effects of a scenario's events."""

    acts: tuple[Act, ...]
    """In order of slots."""
    changes: Mapping[str, tuple[Change, ...]]
    """Receiver → changes of its link."""
    outages: Mapping[str, tuple[Away, ...]]
    """Receiver → its outages."""

    @property
    def holds(self) -> dict[int, list[Act]]:
        """Slot → what is done before it is sent."""
        held: dict[int, list[Act]] = {}
        for act in self.acts:
            held.setdefault(act.at, []).append(act)
        return held

    @property
    def jams(self) -> list[list[int]] | None:
        """Slots [from, to) in which acknowledgements are attacked; None if no event says so: they are then always attacked."""
        spans: list[list[int]] = []
        for act in self.acts:
            if act.kind == "jam":
                spans.append([act.at, NEVER])
            elif act.kind == "jammed":
                spans[-1][1] = act.at
        return spans or None

    @classmethod
    def of(cls, events: Iterable[EventTable], receivers: Sequence[str], changed: Changed) -> Timeline:
        """The timeline of events that have been checked."""
        acts = sorted((act for event in events for act in acts_of(event)), key=lambda act: act.at)
        return cls(
            tuple(acts),
            {name: tuple(_changes(name, acts, changed)) for name in receivers},
            {name: tuple(_outages(name, acts, events)) for name in receivers},
        )


def acts_of(event: EventTable) -> Iterator[Act]:
    """The beginning of an event, and its end if it lasts."""
    kind = "cut" if event.kind == "partition" else event.kind
    yield Act(event.first, kind, event.names, event.set, event.note or "")
    if event.to is not None:
        yield Act(event.to, _ENDS.get(event.kind, "set"), event.names, None)


def _changes(name: str, acts: Sequence[Act], changed: Changed) -> Iterator[Change]:
    entries: dict[str, Any] = {}
    for act in acts:
        if name not in act.names:
            continue
        if act.kind == "set":
            entries = {} if act.changes is None else _over(entries, act.changes)
            yield Change(act.at, settings=changed(name, entries))
        elif act.kind in ("cut", "heal"):
            yield Change(act.at, cut=act.kind == "cut")


def _over(entries: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Entries overlaid by others; the later one of quality and loss replaces the earlier one."""
    dropped = {"quality": "loss", "loss": "quality"}
    gone = {dropped[name] for name in changes if name in dropped}
    return {**{name: value for name, value in entries.items() if name not in gone}, **changes}


def _outages(name: str, acts: Sequence[Act], events: Iterable[EventTable]) -> Iterator[Away]:
    states = {
        (event.first if event.kind == "restart" else event.to): event.state for event in events if name in event.names
    }
    began: Act | None = None
    for act in acts:
        if name not in act.names:
            continue
        if act.kind in _REASONS:
            began = act
        elif began is not None and act.kind == _ENDS[began.kind]:
            keeps = began.kind == "pause" or states.get(act.at) == "last"
            yield Away(began.at, act.at, _REASONS[began.kind], keeps)
            began = None
    if began is not None:
        yield Away(began.at, NEVER, _REASONS[began.kind], began.kind == "pause")
