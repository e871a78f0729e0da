"""Mistakes in links and events that only show when tables are compared: names, slots, and the order of events.

Source: docs/scenario.md, links and events.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

from pydantic import ValidationError

from evedrop.model.schemes import SCHEMES
from evedrop.names import LEGITIMATE
from evedrop.scenario.events import EventTable
from evedrop.scenario.link_table import LinkTable, changed_link
from evedrop.scenario.timeline import Act, acts_of
from evedrop.scenario.words import as_toml, listed

Sentences = Callable[[ValidationError], list[str]]

_OPENS = {"cut": "heal", "kill": "restart", "pause": "resume"}
_STATES = {"cut": "cut", "kill": "down", "pause": "paused"}


def link_mistakes(tables: Mapping[str, Any], links: Mapping[str, LinkTable]) -> Iterator[str]:
    """Mistakes in correlations, delays in seconds and windows; links: receiver → its link, for each link that is valid."""
    receivers = [LEGITIMATE, *_table(tables.get("eavesdroppers"))]
    for name, link in links.items():
        path = f"{LEGITIMATE}.link" if name == LEGITIMATE else f"eavesdroppers.{name}.link"
        if link.in_seconds and not tables.get("slot_seconds"):
            yield f"{path}.delay.unit: is seconds; expected slot_seconds = 0.02, the duration of a slot, at the top of the file"
        if link.correlation is not None:
            yield from _correlation_mistakes(path, name, link, links, receivers)


def _correlation_mistakes(
    path: str, name: str, link: LinkTable, links: Mapping[str, LinkTable], receivers: Sequence[str]
) -> Iterator[str]:
    assert link.correlation is not None  # noqa: S101 - asked by the caller
    entry, other = f"{path}.correlation.with", link.correlation.to
    if other not in receivers or other == name:
        others = [one for one in receivers if one != name]
        yield f"{entry}: is {as_toml(other)}; expected another receiver" + (f": {listed(others)}" if others else "")
    elif other in links and links[other].correlation is not None:
        yield f"{entry}: is {other}, whose own losses are tied to another link's; expected a link without correlation"
    elif other in links and links[other].loss_spec["model"] != link.loss_spec["model"]:
        models = f"{links[other].loss_spec['model']} there and {link.loss_spec['model']} here"
        yield f"{entry}: is {other}, but the loss models differ ({models}); expected the same model on both links"


def event_mistakes(tables: Mapping[str, Any], links: Mapping[str, LinkTable], sentences: Sentences) -> Iterator[str]:
    """Mistakes across tables in events that are valid by themselves, each with the number of its event."""
    events = _events(tables)
    receivers = [LEGITIMATE, *_table(tables.get("eavesdroppers"))]
    slots = tables.get("slots")
    for i, event in events:
        if type(slots) is int:
            yield from _when_mistakes(f"event.{i}", event, slots)
        for name in event.names:
            if name not in receivers:
                hint = ": it is not a receiver" if name in ("sensor", "router", "observer") else ""
                yield f"event.{i}.{_entry(event)}: names {as_toml(name)}{hint}; expected {listed(receivers)}"
        if event.kind == "jam":
            yield from _jam_mistakes(f"event.{i}", event, tables)
        if event.set is not None:
            for name in event.names:
                if name in links:
                    yield from _set_mistakes(f"event.{i}", event, links[name], tables, sentences)
                elif _table(_table(tables.get("eavesdroppers")).get(name)).get("links") is not None:
                    yield from _pooled_mistakes(f"event.{i}", name, event, tables, sentences)
    yield from _order_mistakes(events, receivers)
    yield from _jams_in_turn(events)


def _events(tables: Mapping[str, Any]) -> list[tuple[int, EventTable]]:
    """The events that are valid by themselves, each with its number."""
    events: list[tuple[int, EventTable]] = []
    for i, found in enumerate(tables.get("event", []) if isinstance(tables.get("event"), list) else []):
        try:
            events.append((i, EventTable.model_validate(found)))
        except ValidationError:
            continue
    return events


def away_in(tables: Mapping[str, Any], name: str, slot: int) -> str | None:
    """Say that a receiver is down or paused in a slot, and by which event; None if it is present."""
    acts = [(i, act) for i, event in _events(tables) for act in acts_of(event) if name in act.names]
    away: tuple[int, Act] | None = None
    for i, act in sorted(acts, key=lambda one: one[1].at):
        if act.at > slot:
            break
        if act.kind in ("kill", "pause"):
            away = i, act
        elif act.kind in ("restart", "resume"):
            away = None
    return None if away is None else f"{name} is {_STATES[away[1].kind]} (event.{away[0]}, from slot {away[1].at} on)"


def _entry(event: EventTable) -> str:
    return "link" if event.kind == "set" else event.kind


def _when_mistakes(path: str, event: EventTable, slots: int) -> Iterator[str]:
    if event.first >= slots:
        entry = "at" if event.at is not None else "from"
        yield f"{path}.{entry}: is {event.first}, but the last slot is {slots - 1}; expected a slot of the run"
    if event.to is not None and event.to > slots:
        yield f"{path}.to: is {event.to}; expected at most {slots}, the end of the run"


def _jam_mistakes(path: str, event: EventTable, tables: Mapping[str, Any]) -> Iterator[str]:
    scheme = _table(tables.get("encoding")).get("scheme")
    if event.jam != "acknowledgements":
        yield f'{path}.jam: is {as_toml(event.jam)}; expected "acknowledgements"'
    elif isinstance(scheme, str) and scheme in SCHEMES and not SCHEMES[scheme].needs_acknowledgements:
        yield f"{path}.jam: the scheme {scheme} has no acknowledgements that could be jammed; remove the event"
    elif _table(tables.get("acknowledgements")).get("attack", "none") == "none":
        yield f'{path}.jam: no attack is described; expected acknowledgements.attack = "all", or another, as well'


def _jams_in_turn(events: Sequence[tuple[int, EventTable]]) -> Iterator[str]:
    """Jams that begin before the previous one has ended."""
    jams = sorted(((event.first, event.to, i) for i, event in events if event.kind == "jam"), key=lambda one: one[0])
    for (_, to, _), (first, _, i) in pairwise(jams):
        if to is None or to > first:
            yield f"event.{i}.jam: begins in slot {first}, while another one lasts; expected that one to end first"


def acknowledgement_mistakes(tables: Mapping[str, Any]) -> Iterator[str]:
    """Missing or needless acknowledgements, an unknown jammer, and link rates with a scheme that may be silent."""
    scheme = SCHEMES.get(str(_table(tables.get("encoding")).get("scheme")))
    name, found = _table(tables.get("encoding")).get("scheme"), tables.get("acknowledgements")
    if scheme is not None and scheme.needs_acknowledgements and found is None:
        yield (
            f"acknowledgements: is missing; the scheme {name} acts on acknowledgements; expected a table "
            "[acknowledgements] with link = { quality = 0.9 }"
        )
    if scheme is not None and not scheme.needs_acknowledgements and found is not None:
        yield f"acknowledgements: is given, but the scheme {name} needs none; remove the table"
    jammer, eavesdroppers = _table(found).get("jammer"), list(_table(tables.get("eavesdroppers")))
    if isinstance(jammer, str) and jammer not in eavesdroppers:
        yield f"acknowledgements.jammer: is {as_toml(jammer)}; expected an eavesdropper" + (
            f": {listed(eavesdroppers)}" if eavesdroppers else ", such as smart, in a table of its own"
        )
    if scheme is not None and scheme.may_be_silent:
        for receiver in (LEGITIMATE, *eavesdroppers):
            path = receiver if receiver == LEGITIMATE else f"eavesdroppers.{receiver}"
            entries = _table(tables.get(LEGITIMATE) if receiver == LEGITIMATE else tables["eavesdroppers"][receiver])
            if _table(entries.get("link")).get("rate") is not None:
                yield (
                    f"{path}.link.rate: is given, but the scheme {name} may stay silent, and a queue counts on a packet "
                    "in every slot; remove the line"
                )


def _set_mistakes(
    path: str, event: EventTable, link: LinkTable, tables: Mapping[str, Any], sentences: Sentences
) -> Iterator[str]:
    known = [name for name in LinkTable.model_fields if name != "correlation"]
    for name in event.set or {}:
        if name not in known:
            yield f"{path}.set.{name}: is not a link setting that can be changed; expected {listed(known)}"
    try:
        changed = changed_link(link, {name: value for name, value in (event.set or {}).items() if name in known})
    except ValidationError as error:
        yield from (f"{path}.set.{line}" for line in sentences(error))
        return
    if changed.in_seconds and not tables.get("slot_seconds"):
        yield f"{path}.set.delay.unit: is seconds; expected slot_seconds = 0.02 at the top of the file"
    if link.correlation is not None and changed.loss_spec["model"] != link.loss_spec["model"]:
        yield f"{path}.set.loss.model: differs from the first one, but the link's losses are tied to another link's"


def _pooled_mistakes(
    path: str, name: str, event: EventTable, tables: Mapping[str, Any], sentences: Sentences
) -> Iterator[str]:
    """Mistakes in an event that changes pooled links: they become one link, with a quality or a loss model of its own."""
    if not {"quality", "loss"} & set(event.set or {}):
        yield f"{path}.set: {name} has several links; expected a quality or a loss, for the one link that replaces them"
        return
    yield from _set_mistakes(path, event, LinkTable(quality=1.0), tables, sentences)


def _order_mistakes(events: Sequence[tuple[int, EventTable]], receivers: Sequence[str]) -> Iterator[str]:
    """Events that end something that has not begun, or begin something during it or during another outage."""
    acts: list[tuple[int, Act]] = [(i, act) for i, event in events for act in acts_of(event)]
    acts.sort(key=lambda one: one[1].at)
    for name in receivers:
        cut: Act | None = None
        away: tuple[Act, int] | None = None
        ended = -1
        for i, act in acts:
            if name not in act.names:
                continue
            path = f"event.{i}"
            if act.kind == "cut" and cut is not None:
                yield f"{path}.cut: {name} is cut already, from slot {cut.at} on; expected a heal before"
            if act.kind == "heal" and cut is None:
                yield f"{path}.heal: {name} is not cut at slot {act.at}; expected a cut before"
            cut = act if act.kind == "cut" else None if act.kind == "heal" else cut
            if act.kind in ("kill", "pause"):
                if away is not None:
                    state = _STATES[away[0].kind]
                    yield f"{path}.{act.kind}: {name} is {state} already, from slot {away[0].at} on; expected it to be back"
                elif act.at == ended:
                    yield f"{path}.{act.kind}: {name} is back in slot {act.at} only; expected a later slot"
                away = (act, i)
            elif act.kind in ("restart", "resume"):
                wanted = next(kind for kind, end in _OPENS.items() if end == act.kind)
                if away is None or away[0].kind != wanted:
                    yield f"{path}.{act.kind}: {name} is not {_STATES[wanted]} at slot {act.at}; expected a {wanted} before"
                elif act.at <= away[0].at:
                    yield f"{path}.{act.kind}: {name} leaves in slot {act.at} only; expected a later slot"
                away, ended = None, act.at


def _table(found: Any) -> Mapping[str, Any]:
    return found if isinstance(found, Mapping) else {}
