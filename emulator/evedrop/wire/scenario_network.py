"""A wire as the network of a scenario: its links become those of the receivers, its events those of the scenario.

The packet of slot k has the fate of the k-th message that a program publishes on a key of the wire.

Source: docs/links.md, the links of a wire.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby, pairwise
from typing import Any

import zenoh

from evedrop.errors import UsageError
from evedrop.names import LEGITIMATE, SENSOR
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import listed
from evedrop.wire.plan import WireLink, WirePlan
from evedrop.wire.timeline import Moment, moments

_ROUNDING = 1e-9  # of a slot: the time of an event is not rounded up to the next one for so little
_FAULTS = ("reorder", "duplicate", "corrupt")
_LOSSLESS: Mapping[str, Any] = {"loss": {"model": "bernoulli", "quality": 1.0}}


def over_wire(
    scenario: Scenario, plan: WirePlan, key: str | None = None, sides: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """The changes, by dotted key, that give a scenario the links and events of a wire.

    key: of the packets; by default that of the program that gives the states. sides: sensor or receiver → its side of the wire;
    by default the side of the same name.

    Raises UsageError with every reason why the scenario cannot have this network.
    """
    wrong: list[str] = []
    if key is None and scenario.process.zenoh is not None:
        key = scenario.process.zenoh.key
    if key is None:
        wrong.append("the key of the packets is not known; give --wire-key, such as --wire-key robot/pose")
    places = _places(scenario, plan, sides or {}, wrong)
    links = _links(scenario, plan, key, places, wrong) if key is not None and not wrong else {}
    lossless = not wrong and key is not None and plan.is_lossless(_expression(key, wrong))
    happens = moments(plan)
    if scenario.slot_seconds is None and (
        len(happens) > 1 or any("delay" in links_.settings for links_ in links.values())
    ):
        wrong.append(
            "its delays and events are in seconds, and the scenario has no slot_seconds; give slot_seconds = 0.1"
        )
    for name, link in links.items():
        if not lossless:
            wrong += _unusable(name, link, links, happens)
    if wrong:
        raise UsageError("\n".join(f"--wire: {links_}" for links_ in wrong))
    made: dict[str, Any] = {}
    for name, link in links.items():
        table = LEGITIMATE if name == LEGITIMATE else f"eavesdroppers.{name}"
        made[f"{table}.link"] = _table(
            _LOSSLESS if lossless else link.settings, None if lossless else _tie(link, links)
        )
    if not lossless:
        made["wire"] = {"seed": plan.seed, "key": key, "links": {name: link.name for name, link in links.items()}}
        events = [event for name, link in links.items() for event in _events(name, link, happens, scenario)]
        made |= {f"event.{len(scenario.event) + i}": event for i, event in enumerate(events)}
    return made


def _places(scenario: Scenario, plan: WirePlan, sides: Mapping[str, str], wrong: list[str]) -> dict[str, str]:
    """Sensor and receivers → the sides that they are on."""
    processes = (SENSOR, *scenario.receivers)
    wrong += [f"{name} is not {listed(processes)}" for name in sides if name not in processes]
    places = {name: sides.get(name, name) for name in processes}
    for name, side in places.items():
        if side not in plan.sides:
            given = f"--wire-side {name}={next(iter(plan.sides))}"
            wrong.append(
                f"{name} is on no side of the wire, whose sides are {listed(tuple(plan.sides))}; give such as {given}"
            )
    return places


def _expression(key: str, wrong: list[str]) -> zenoh.KeyExpr:
    """The key as Zenoh knows it; "none" if it is not one, which is added to what is wrong."""
    if not set(key) & set("*$"):
        try:
            return zenoh.KeyExpr(key)
        except zenoh.ZError:
            pass
    wrong.append(f"{key} is not a key without wildcards; give one such as --wire-key robot/pose")
    return zenoh.KeyExpr("none")


def _links(
    scenario: Scenario, plan: WirePlan, key: str, places: Mapping[str, str], wrong: list[str]
) -> dict[str, WireLink]:
    """Receiver → the link of the wire that takes its packets."""
    expression = _expression(key, wrong)
    tables: dict[str, WireLink] = {}
    for name in scenario.receivers if not wrong else ():
        link = plan.link_of(places[SENSOR], places[name], expression)
        if link is None:
            wrong.append(f"no link of the wire takes {key} from {places[SENSOR]} to {places[name]}, where {name} is")
        elif name != LEGITIMATE and scenario.eavesdroppers[name].links is not None:
            wrong.append(f"{name} has several links, and is on one side of the wire; give it one link")
        else:
            tables[name] = link
    return tables


def _unusable(name: str, link: WireLink, links: Mapping[str, WireLink], happens: Sequence[Moment]) -> Iterator[str]:
    """The reasons why a receiver cannot have a link of the wire."""
    if any("rate" in moment.settings[link.name] for moment in happens):
        why = "has a rate in bytes per second, and a packet of a scenario has no bytes; leave the rate out"
        yield f"{link.name}, the link of {name}, {why}"
    if link.ordered and any("delay" in moment.settings[link.name] for moment in happens):
        why = "has ordered = true, and the delays of a scenario's packets do not depend on each other; leave it out"
        yield f"{link.name}, the link of {name}, {why}"
    tie = None if link.correlation is None else link.correlation[0]
    if tie is not None and tie not in {link_.name for other, link_ in links.items() if other != name}:
        yield f"{link.name}, the link of {name}, is tied to {tie}, which is not the link of another receiver"


def _tie(link: WireLink, links: Mapping[str, WireLink]) -> dict[str, Any] | None:
    """The correlation of a link with another receiver's."""
    if link.correlation is None:
        return None
    to, strength = link.correlation
    return {"with": next(name for name, candidate in links.items() if candidate.name == to), "strength": strength}


def _table(settings: Mapping[str, Any], tie: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The link of a scenario with the settings of a wire's link."""
    made = {"loss": settings["loss"], **{name: settings[name] for name in _FAULTS if settings.get(name)}}
    if "delay" in settings:
        made["delay"] = {**settings["delay"], "unit": "seconds"}
    return made if tie is None else {**made, "correlation": tie}


def _events(name: str, link: WireLink, happens: Sequence[Moment], scenario: Scenario) -> Iterator[dict[str, Any]]:
    """The events of a receiver's link: the spans in which it is cut, and its settings where they are not those of the start."""
    seconds = scenario.slot_seconds or 1.0
    slots = [min(scenario.slots, math.ceil(happening.time / seconds - _ROUNDING)) for happening in happens]
    spans = [
        (start, stop, moment)
        for (start, stop), moment in zip(pairwise([*slots, scenario.slots]), happens, strict=True)
        if start < stop
    ]
    for cut, some in groupby(spans, lambda span: link.name in span[2].cut):
        if cut:
            yield {**_lasting([*some], scenario), "cut": name}
    delayed = any("delay" in moment.settings[link.name] for moment in happens)
    for other, some in groupby(spans, lambda span: span[2].settings[link.name] != link.settings):
        if not other:
            continue
        changed = [*some]
        yield {**_lasting(changed, scenario), "link": name, "set": _changes(changed[0][2].settings[link.name], delayed)}
        for (_, _, before), (start, _, moment) in pairwise(changed):
            if moment.settings[link.name] != before.settings[link.name]:
                yield {"at": start, "link": name, "set": _changes(moment.settings[link.name], delayed)}


def _lasting(spans: Sequence[tuple[int, int, Moment]], scenario: Scenario) -> dict[str, int]:
    """When an event begins and ends; one that lasts to the end of the run has no end."""
    start, stop = spans[0][0], spans[-1][1]
    return {"at": start} if stop == scenario.slots else {"from": start, "to": stop}


def _changes(settings: Mapping[str, Any], delayed: bool) -> dict[str, Any]:
    """All settings of a link as changes; delayed: whether it has a delay at any time, so that its absence must be stated."""
    made = {**dict.fromkeys(_FAULTS, 0.0), **_table(settings)}
    return {"delay": {"model": "constant", "value": 0.0, "unit": "seconds"}, **made} if delayed else made
