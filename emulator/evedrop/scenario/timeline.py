"""The events of a scenario in order: the slots before which the run is held, the actions there, and the effects on each link.

Source: docs/scenario.md, events.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from evedrop.model.slot.link import NEVER, Change, ReceiverOutage
from evedrop.scenario.events.event import Act, EventKind, Jamming, Spoofing

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
        for act in self.acts:
            if act.effect.attacked == attacked:
                if act.effect.on:
                    spans.append((act.at, NEVER))
                else:
                    spans[-1] = (spans[-1][0], act.at)
        return spans

    @classmethod
    def of(cls, events: Iterable[EventKind], receivers: Sequence[str], changed: Changed) -> Timeline:
        """The timeline of events that have been checked."""
        acts = acts_of(events)
        return cls(
            acts,
            {name: tuple(_changes(name, acts, changed)) for name in receivers},
            {name: tuple(_outages(name, acts)) for name in receivers},
        )


def acts_of(events: Iterable[EventKind]) -> tuple[Act, ...]:
    """The acts of events, in order of slots."""
    return tuple(sorted((act for event in events for act in event.acts()), key=lambda act: act.at))


def _changes(name: str, acts: Sequence[Act], changed: Changed) -> Iterator[Change]:
    entries: dict[str, Any] = {}
    for act in acts:
        if name not in act.names:
            continue
        if act.effect.changes_settings:
            entries = {} if act.effect.entries is None else _over(entries, act.effect.entries)
            yield Change(act.at, settings=changed(name, entries))
        if act.effect.cuts is not None:
            yield Change(act.at, cut=act.effect.cuts)


def _over(entries: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Entries with some changed; a quality removes an earlier loss, and a loss an earlier quality."""
    dropped = {"quality": "loss", "loss": "quality"}
    gone = {dropped[name] for name in changes if name in dropped}
    return {**{name: value for name, value in entries.items() if name not in gone}, **changes}


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
