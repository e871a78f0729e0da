"""The events of a scenario in order: the slots before which the run is held, the actions there, and the effects on each link.

Source: docs/scenario.md, events.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from evedrop.model.slot.link import NEVER, Change, ReceiverOutage
from evedrop.scenario.events.event import Act, EventKind, Jamming, Spoofing
from evedrop.scenario.receivers import entries_after

Changed = Callable[[str, Mapping[str, Any]], dict[str, Any]]
"""Maps a receiver and the changed entries of its link to the link's new settings."""


@dataclass(frozen=True)
class Timeline:
    """The effects of a scenario's events."""

    acts: tuple[Act, ...]
    """In order of slots."""
    changes: Mapping[str, tuple[Change, ...]]
    """Receiver → changes of its link."""
    outages: Mapping[str, tuple[ReceiverOutage, ...]]
    """Receiver → its outages."""

    @property
    def holds(self) -> dict[int, list[Act]]:
        """Slot → the acts that are carried out before it is sent."""
        held: dict[int, list[Act]] = {}
        for act in self.acts:
            held.setdefault(act.at, []).append(act)
        return held

    @property
    def jams(self) -> list[tuple[int, int]] | None:
        """Slots [from, to) in which acknowledgements are attacked; None without such events: an attack then lasts all run."""
        return self._spans(Jamming.attacked) or None

    @property
    def spoofs(self) -> list[tuple[int, int]]:
        """Slots [from, to) of events in which measurements are attacked."""
        return self._spans(Spoofing.attacked)

    def _spans(self, attacked: str) -> list[tuple[int, int]]:
        spans: list[tuple[int, int]] = []
        began: int | None = None
        for act in self.acts:
            if act.effect.attacked != attacked:
                continue
            if act.effect.on:
                began = act.at if began is None else began
            elif began is not None:
                spans.append((began, act.at))
                began = None
        return spans if began is None else [*spans, (began, NEVER)]

    @classmethod
    def of(cls, events: Iterable[EventKind], receivers: Sequence[str], changed: Changed) -> Timeline:
        """The timeline of events that have been checked."""
        acts = acts_of(events)
        return cls(
            acts,
            {name: tuple(_changes(name, acts, changed)) for name in receivers},
            {name: tuple(_outages(name, acts)) for name in receivers},
        )


def numbered_acts(events: Iterable[EventKind]) -> list[tuple[int, Act]]:
    """The acts of events, each with the number of its event, in order of slots.

    In one slot, what an event does after its beginning, such as to end, comes before the beginnings of events.
    """
    acts = [(event.first, i, act) for i, event in enumerate(events) for act in event.acts()]
    return [(i, act) for _, i, act in sorted(acts, key=lambda placed: (placed[2].at, placed[0] == placed[2].at))]


def acts_of(events: Iterable[EventKind]) -> tuple[Act, ...]:
    """The acts of events, in the order of `numbered_acts`."""
    return tuple(act for _, act in numbered_acts(events))


def _changes(name: str, acts: Sequence[Act], changed: Changed) -> Iterator[Change]:
    entries: dict[str, Any] = {}
    for act in acts:
        if name not in act.names:
            continue
        if act.effect.changes_settings:
            entries = entries_after(entries, act.effect.entries)
            yield Change(act.at, settings=changed(name, entries))
        if act.effect.cuts is not None:
            yield Change(act.at, cut=act.effect.cuts)


def _outages(name: str, acts: Sequence[Act]) -> Iterator[ReceiverOutage]:
    began: Act | None = None
    for act in acts:
        if name not in act.names or act.effect.present is None:
            continue
        if not act.effect.present:
            began = act
        elif began is not None:
            yield ReceiverOutage(began.at, act.at, began.effect.reason, act.effect.keeps_state)
            began = None
    if began is not None:
        yield ReceiverOutage(began.at, NEVER, began.effect.reason, began.effect.keeps_state)
