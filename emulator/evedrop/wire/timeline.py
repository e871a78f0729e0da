"""The events of a wire, in the order of time: which links are cut and what their settings are at each moment.

A link is cut while an event cuts it, or while its two sides are partitioned. Changes of its settings that last at the same time
apply in the order in which they began, and end one by one.

Source: docs/wire/file.md, events.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pydantic import ValidationError

from evedrop.errors import ScenarioError
from evedrop.model.checks import as_toml
from evedrop.scenario.receivers import tie_of
from evedrop.scenario.table import sentences
from evedrop.wire.file import LinkNow, event_mistakes, unknown, wire_event
from evedrop.wire.plan import WireEvent, WirePlan
from evedrop.wire.tables import WireEventTable


@dataclass(frozen=True)
class Moment:
    """A time at which something changes, and the state of all links from then on."""

    time: float
    """Seconds after the start of the wire."""
    lines: tuple[str, ...]
    """A line for each event that begins or ends."""
    cut: frozenset[str]
    """The names of the links that are cut, or whose sides are partitioned."""
    settings: Mapping[str, Mapping[str, Any]]
    """Of every link, by name."""


def times(plan: WirePlan) -> list[float]:
    """The times at which something changes, in order; the first one is the start."""
    ends = (event.stop for event in plan.events if event.stop is not None)
    return sorted({0.0, *(event.start for event in plan.events), *ends})


def moments(plan: WirePlan) -> tuple[Moment, ...]:
    """All moments of a wire, in order of time; the first one is its start."""
    return tuple(moment_at(plan, time) for time in times(plan))


def moment_at(plan: WirePlan, time: float) -> Moment:
    """The state of all links at a time, and what happens just then."""
    lasting = _lasting(plan, time)
    settings: dict[str, Mapping[str, Any]] = {link.name: link.settings for link in plan.links}
    for event in lasting:
        if event.link is not None and event.settings is not None:
            settings[event.link] = {**settings[event.link], **event.settings}
    apart = [set(event.partition) for event in lasting if event.partition is not None]
    named = {event.cut for event in lasting}
    cut = {link.name for link in plan.links if link.name in named or {link.source, link.target} in apart}
    sentences = [_ended(event) for event in plan.events if event.stop == time and event.note is None]
    sentences += [_begun(event) for event in plan.events if event.start == time]
    return Moment(time, tuple(sentences), frozenset(cut), settings)


def with_request(plan: WirePlan, event: Mapping[str, Any], time: float) -> tuple[WirePlan, str]:
    """The plan after an operator's event at a time, and the line that says what it does. Raises ScenarioError.

    event: `heal` with the name of a link that is cut, `join` with two sides that are partitioned, or as for `with_change`.
    """
    if timed := [name for name in ("at", "from", "to") if name in event]:
        raise ScenarioError(
            "event", [f"{name}: is given; expected no time, because it is done at once" for name in timed]
        )
    healed, joined = event.get("heal"), event.get("join")
    if isinstance(healed, str) and len(event) == 1:
        return with_cut_ended(plan, healed, time)
    if isinstance(joined, list) and len(joined) == 2 and len(event) == 1:
        return with_partition_ended(plan, str(joined[0]), str(joined[1]), time)
    return with_change(plan, event, time)


def with_change(plan: WirePlan, table: Mapping[str, Any], time: float) -> tuple[WirePlan, str]:
    """The plan with an event that begins at a time and lasts, and the line that says what it does.

    table: as `[[event]]` without a time. Raises ScenarioError with every mistake, worded as for the events of a file.
    """
    now = moment_at(plan, time).settings
    try:
        checked = WireEventTable.model_validate({"at": 0.0, **table})  # a wire may run for longer than a file can say
    except ValidationError as error:
        raise ScenarioError("event", sentences(error, WireEventTable)) from None
    ties = {link.name: link.correlation[0] for link in plan.links if link.correlation is not None}
    links = {
        link.name: LinkNow(link.name, now[link.name], tie_of(link.name, ties), link.ordered) for link in plan.links
    }
    if mistakes := list(event_mistakes(checked, [*plan.sides], links)):
        raise ScenarioError("event", mistakes)
    event = replace(wire_event(checked, now, {link.name: link.settings for link in plan.links}), start=time)
    return replace(plan, events=(*plan.events, event)), _begun(event)


def with_cut_ended(plan: WirePlan, link: str, time: float) -> tuple[WirePlan, str]:
    """The plan in which no event cuts a link at a time, and the line that says so.

    Later events stay, and so do partitions. Raises ScenarioError if the link is not cut.
    """
    names = [link_.name for link_ in plan.links]
    if link not in names:
        raise ScenarioError("event", [f"heal: {unknown(link, names, 'link')}"])
    apart = link in moment_at(plan, time).cut
    wanted = "end the partition of its sides with `evedrop heal`" if apart else "expected a link that is cut"
    return _ended_at(plan, time, lambda event: event.cut == link, f"heal: {link} is not cut by itself; {wanted}")


def with_partition_ended(plan: WirePlan, side: str, other: str, time: float) -> tuple[WirePlan, str]:
    """The plan in which two sides are not partitioned at a time. Raises ScenarioError if they are not partitioned before."""
    sides = [*plan.sides]
    if strange := [f"heal: {unknown(name, sides, 'side')}" for name in (side, other) if name not in sides]:
        raise ScenarioError("event", strange)
    pair = {side, other}
    refusal = f"heal: {side} and {other} are not partitioned; expected two sides that are"
    return _ended_at(plan, time, lambda event: event.partition is not None and {*event.partition} == pair, refusal)


def _ended_at(plan: WirePlan, time: float, of: Callable[[WireEvent], bool], otherwise: str) -> tuple[WirePlan, str]:
    """End the events of a kind that last at a time."""
    lasting = [event for event in _lasting(plan, time) if of(event)]
    if not lasting:
        raise ScenarioError("event", [otherwise])
    # One that begins at this very moment is left out: an event must end after its beginning.
    kept = [event for event in plan.events if event not in lasting or event.start < time]
    events = tuple(replace(event, stop=time) if event in lasting else event for event in kept)
    return replace(plan, events=events), _ended(lasting[0])


def _lasting(plan: WirePlan, time: float) -> list[WireEvent]:
    """The events that last at a time, in the order in which they began."""
    lasting = [event for event in plan.events if event.start <= time and (event.stop is None or time < event.stop)]
    return sorted(lasting, key=lambda event: event.start)


def _begun(event: WireEvent) -> str:
    """What an event does."""
    if event.partition is not None:
        return f"partition {', '.join(event.partition)}"
    if event.cut is not None:
        return f"cut {event.cut}"
    if event.settings is not None:
        settings = ", ".join(f"{name} = {as_toml(value)}" for name, value in event.settings.items())
        return f"link {event.link}: {settings}"
    return f"{event.note}"


def _ended(event: WireEvent) -> str:
    """What ends with an event."""
    if event.partition is not None:
        return f"heal {', '.join(event.partition)}"
    if event.cut is not None:
        return f"heal {event.cut}"
    return f"link {event.link}: {', '.join(event.settings or ())} as before"
