"""Mistakes in events that only show when tables are compared: names, slots, changes of links, and the order of events.

Source: docs/scenario.md, events.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from pydantic import ValidationError

from evedrop.model.links.loss_model import Fate
from evedrop.model.registry import place_of
from evedrop.scenario.application import APPLICATIONS
from evedrop.scenario.events.event import Act, EventKind, Surroundings
from evedrop.scenario.link_table import CHANGEABLE, OTHER_MODEL, LinkTable, changed_link, unchangeable
from evedrop.scenario.sentences import sentences
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import as_toml, listed

Numbered = tuple[int, Act]
"""An act with the number of its event."""


def event_mistakes(scenario: Scenario) -> Iterator[str]:
    """Mistakes across tables in events that are valid by themselves, each with the number of its event."""
    surroundings = Surroundings(
        scenario.scheme,
        scenario.encoding.scheme,
        "none" if scenario.acknowledgements is None else scenario.acknowledgements.attack,
        any(APPLICATIONS[name].has_monitor for name in scenario.applications),
    )
    for i, event in enumerate(scenario.event):
        path = f"event.{i}"
        yield from _when_mistakes(path, event, scenario.slots)
        for name in event.names:
            if name not in scenario.receivers:
                hint = ": it is not a receiver" if name in ("sensor", "router", "recorder") else ""
                yield f"{path}.{event.names_in}: names {as_toml(name)}{hint}; expected {listed(scenario.receivers)}"
        yield from _own(path, type(event), partial(_compared, path, event, surroundings))
        for act in event.acts():
            if act.effect.changes_settings and act.effect.entries is not None:
                for name in act.names:
                    yield from _change_mistakes(f"{path}.{act.entry}", name, act.effect.entries, scenario)
    yield from _order_mistakes(scenario)
    kinds = dict.fromkeys(type(event) for event in scenario.event)
    for kind in kinds:
        events = [(i, event) for i, event in enumerate(scenario.event) if type(event) is kind]
        yield from _own(f"event.{events[0][0]}", kind, partial(kind.in_turn, events))


def _compared(path: str, event: EventKind, surroundings: Surroundings) -> Iterator[str]:
    return (f"{path}.{entry}: {sentence}" for entry, sentence in event.compared(surroundings))


def _own(path: str, kind: type[EventKind], ask: Callable[[], Iterator[str]]) -> list[str]:
    """The mistakes that a kind finds itself, or the error that it raised: its class may come from a package."""
    try:
        return list(ask())
    except Exception as error:
        return [f"{path}.{kind.kind}: cannot be checked: {kind.__name__} raised {place_of(error)}"]


def _acts(scenario: Scenario) -> list[Numbered]:
    """All acts, each with the number of its event, in order of slots."""
    acts = ((i, act) for i, event in enumerate(scenario.event) for act in event.acts())
    return sorted(acts, key=lambda numbered: numbered[1].at)


def away_in(scenario: Scenario, name: str, slot: int) -> str | None:
    """Say that a receiver is down or paused in a slot, and by which event; None if it is present."""
    away = None
    for i, act in _acts(scenario):
        if act.at <= slot and name in act.names and act.effect.present is not None:
            away = None if act.effect.present else (i, act.at, act.effect.reason)
    return None if away is None else f"{name} is {_said(away[2])} (event.{away[0]}, from slot {away[1]} on)"


def _said(reason: Fate) -> str:
    return reason.name.lower()


def _when_mistakes(path: str, event: EventKind, slots: int) -> Iterator[str]:
    if event.first >= slots:
        entry = "at" if event.at is not None else "from"
        yield f"{path}.{entry}: is {event.first}, but the last slot is {slots - 1}; expected a slot of the run"
    if event.to is not None and event.to > slots:
        yield f"{path}.to: is {event.to}; expected at most {slots}, the end of the run"


def _change_mistakes(path: str, name: str, changes: Mapping[str, Any], scenario: Scenario) -> Iterator[str]:
    """Mistakes in the changed entries of a receiver's link. One link with a new quality or loss model replaces pooled links."""
    link = scenario.links.get(name)
    if link is None:
        if name not in scenario.eavesdroppers or scenario.eavesdroppers[name].links is None:
            return
        if not {"quality", "loss"} & set(changes):
            yield f"{path}: {name} has several links; expected a quality or a loss, for the one link that replaces them"
            return
        link = LinkTable(quality=1.0)
    yield from (f"{path}.{line}" for line in unchangeable(changes))
    try:
        changed = changed_link(link, {entry: value for entry, value in changes.items() if entry in CHANGEABLE})
    except ValidationError as error:
        yield from (f"{path}.{line}" for line in sentences(error, LinkTable))
        return
    if changed.in_seconds and scenario.slot_seconds is None:
        yield f"{path}.delay.unit: is seconds; expected slot_seconds = 0.02 at the top of the file"
    if link.correlation is not None and changed.loss_spec["model"] != link.loss_spec["model"]:
        yield f"{path}.{OTHER_MODEL}"


def _order_mistakes(scenario: Scenario) -> Iterator[str]:
    """Events that end a cut or an outage that has not begun, or that begin one while another of its kind lasts."""
    acts = _acts(scenario)
    for name in scenario.receivers:
        yield from _order_mistakes_of(name, [(i, act) for i, act in acts if name in act.names])


def _order_mistakes_of(name: str, acts: Sequence[Numbered]) -> Iterator[str]:
    """The same for one receiver; acts: those that concern it, in order of slots."""
    cut: int | None = None
    away: tuple[int, Fate] | None = None
    ended = -1
    for i, act in acts:
        path = f"event.{i}.{act.entry}: {name}"
        effect = act.effect
        if effect.cuts is True:
            if cut is not None:
                yield f"{path} is cut already, from slot {cut} on; expected a heal before"
            cut = act.at
        if effect.cuts is False:
            if cut is None:
                yield f"{path} is not cut at slot {act.at}; expected a cut before"
            cut = None
        if effect.present is False:
            if away is not None:
                yield f"{path} is {_said(away[1])} already, from slot {away[0]} on; expected it to be back"
            elif act.at == ended:
                yield f"{path} comes back only in slot {act.at}; expected a later slot"
            away = act.at, effect.reason
        if effect.present is True:
            if away is None or away[1] != effect.reason:
                yield f"{path} is not {_said(effect.reason)} at slot {act.at}; expected a {effect.after} before"
            elif act.at <= away[0]:
                yield f"{path} leaves in the same slot, {act.at}; expected a later slot"
            away, ended = None, act.at
