"""Mistakes of a wire file that only show when its tables are compared: names, endpoints, events. Any table may be malformed.

Source: docs/wire.md, the file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from pydantic import ValidationError

from evedrop.model.checks import as_toml
from evedrop.scenario.link_table import CHANGEABLE, OTHER_MODEL, unchangeable
from evedrop.scenario.sentences import sentences
from evedrop.scenario.words import listed
from evedrop.system.hints import near
from evedrop.wire.endpoints import EndpointPlace, place_of
from evedrop.wire.expect import expectation_mistakes
from evedrop.wire.tables import WireLinkTable, WireSettingsTable, changed_settings

Tables = Sequence[Mapping[str, Any]]
LinkNow = tuple[Mapping[str, Any], bool]
"""A link's settings, and whether its losses are tied to another link's."""


def mistakes_across(tables: Mapping[str, Any]) -> Iterator[str]:
    """Mistakes across the tables of a wire file."""
    side = tables.get("side")
    sides: Mapping[str, Any] = side if isinstance(side, Mapping) else {}
    links, events = _tables(tables.get("link")), _tables(tables.get("event"))
    yield from _endpoint_mistakes(sides)
    if sides:
        yield from _side_mistakes(sides, links)
    yield from _name_mistakes(links)
    yield from _correlation_mistakes(links)
    names = link_names(links)
    yield from expectation_mistakes(_tables(tables.get("expect")), names)
    for i, event in enumerate(events):
        settings_of = partial(_settings_of, dict(zip(names, links, strict=True)))
        yield from (f"event.{i}.{line}" for line in event_mistakes(event, [*sides], names, settings_of))


def link_names(links: Tables) -> list[str]:
    """The name of each link: that in its table, or FROM-TO, or FROM-TO-2 and so on where that is taken."""
    taken = {str(link["name"]) for link in links if link.get("name") is not None}
    names = []
    for link in links:
        name = link.get("name")
        if name is None:
            plain = f"{link.get('from')}-{link.get('to')}"
            numbered = (f"{plain}-{number}" for number in range(2, 2 * len(links) + 2))
            name = next(one for one in (plain, *numbered) if one not in taken)
            taken.add(name)
        names.append(str(name))
    return names


def change_mistakes(settings: Mapping[str, Any], correlated: bool, changes: Mapping[str, Any]) -> Iterator[str]:
    """Mistakes in changed entries of a link with these settings. correlated: whether its losses are tied to another link's."""
    yield from unchangeable(changes)
    try:
        made = changed_settings(settings, {entry: changes[entry] for entry in changes if entry in CHANGEABLE}, settings)
    except ValidationError as error:
        yield from sentences(error, WireSettingsTable)
        return
    if correlated and made.get("loss", settings["loss"])["model"] != settings["loss"]["model"]:
        yield OTHER_MODEL


def _settings_of(links: Mapping[str, Mapping[str, Any]], name: str) -> LinkNow | None:
    """The settings of a link of the file at the start; None if the link's table has mistakes, which are reported elsewhere."""
    try:
        return WireLinkTable.model_validate(links[name]).wire_settings(), links[name].get("correlation") is not None
    except ValidationError:
        return None


def _tables(found: Any) -> Tables:
    """The entries of a list of tables; a malformed one is empty."""
    return [one if isinstance(one, Mapping) else {} for one in found] if isinstance(found, list) else []


def _endpoint_mistakes(sides: Mapping[str, Any]) -> Iterator[str]:
    """Two sides, or one side twice, at one place."""
    listens, connects = _places(sides, "listen"), _places(sides, "connect")
    round_and_round = "so that messages would go round"
    for i, one in enumerate(listens):
        if (other := _overlapping(one, listens[:i])) is not None:
            same = "the same place" if one.endpoint == other.endpoint else f"the same place as {other.endpoint}"
            yield f"{one.said}, {same} at which side {other.side} listens; expected another port"
    for i, one in enumerate(connects):
        if (other := _overlapping(one, listens)) is not None:
            where = f"where side {other.side} of this wire listens, {round_and_round}"
            yield f"{one.said}, {where}; expected a router outside of the wire"
        if (other := _overlapping(one, connects[:i])) is not None:
            why = "" if one.side == other.side else f", {round_and_round}"
            yield f"{one.said}, the router to which side {other.side} connects{why}; expected another router"


class _Placed(NamedTuple):
    """A well-formed endpoint of a side."""

    path: str
    side: str
    endpoint: str
    place: EndpointPlace

    @property
    def said(self) -> str:
        """The beginning of a message about it."""
        return f"{self.path}: is {as_toml(self.endpoint)}"


def _overlapping(one: _Placed, others: Sequence[_Placed]) -> _Placed | None:
    return next((other for other in others if one.place.overlaps(other.place)), None)


def _places(sides: Mapping[str, Any], entry: str) -> list[_Placed]:
    found = []
    for name, side in sides.items():
        given = side.get(entry) if isinstance(side, Mapping) else None
        several = {f".{i}": one for i, one in enumerate(given)} if isinstance(given, list) else {"": given}
        for number, endpoint in several.items():
            if isinstance(endpoint, str) and (place := place_of(endpoint)) is not None:
                found.append(_Placed(f"side.{name}.{entry}{number}", name, endpoint, place))
    return found


def unknown(name: object, known: Sequence[str], what: str) -> str:
    """The end of a message about a name that nothing has. what: `side` or `link`."""
    choice = f"expected {listed(known)}" if known else f"the file has no {what}"
    return f"is {as_toml(name)}; {choice}{near(name, known)}"


def _side_mistakes(sides: Mapping[str, Any], links: Tables) -> Iterator[str]:
    for i, link in enumerate(links):
        for entry in ("from", "to"):
            if isinstance(link.get(entry), str) and link[entry] not in sides:
                yield f"link.{i}.{entry}: {unknown(link[entry], [*sides], 'side')}"
        if isinstance(link.get("to"), str) and link["to"] == link.get("from") and link["to"] in sides:
            yield f"link.{i}.to: is {as_toml(link['to'])}, where the link begins; expected another side"


def _name_mistakes(links: Tables) -> Iterator[str]:
    first: dict[str, int] = {}
    for i, link in enumerate(links):
        if isinstance(name := link.get("name"), str) and first.setdefault(name, i) != i:
            yield f"link.{i}.name: is {as_toml(name)}, the name of link.{first[name]}; expected a name of its own"


def _correlation_mistakes(links: Tables) -> Iterator[str]:
    names = link_names(links)
    for i, (name, link) in enumerate(zip(names, links, strict=True)):
        tie = link.get("correlation")
        other = tie.get("with") if isinstance(tie, Mapping) else None
        if not isinstance(other, str):
            continue
        path = f"link.{i}.correlation.with"
        others = [one for one in names if one != name]
        if other not in others:
            yield f"{path}: {unknown(other, others, 'other link')}"
            continue
        theirs = links[names.index(other)]
        if theirs.get("correlation") is not None:
            yield f"{path}: is {other}, whose own losses are tied to another link's; expected a link without correlation"
        elif (there := _model(theirs)) != (here := _model(link)):
            yield f"{path}: is {other}, but the loss models differ ({there} there and {here} here); expected the same model"


def _model(link: Mapping[str, Any]) -> object:
    loss = link.get("loss")
    return loss.get("model") if isinstance(loss, Mapping) else "bernoulli"


def event_mistakes(
    event: Mapping[str, Any], sides: Sequence[str], links: Sequence[str], settings_of: Callable[[str], LinkNow | None]
) -> Iterator[str]:
    """Mistakes in an event that only show with the sides and links of the wire, given by their names.

    settings_of: the settings of a link, and whether its losses are tied to another link's; None for a link with mistakes.
    """
    partition = event.get("partition")
    if isinstance(partition, list) and sides:
        for i, name in enumerate(partition):
            if isinstance(name, str) and name not in sides:
                yield f"partition.{i}: {unknown(name, sides, 'side')}"
        if len(partition) == 2 and partition[0] == partition[1]:
            yield f"partition: is {as_toml(partition)}; expected two different sides"
    for entry in ("cut", "link"):
        if isinstance(event.get(entry), str) and event[entry] not in links:
            yield f"{entry}: {unknown(event[entry], links, 'link')}"
    if (
        isinstance(event.get("set"), Mapping)
        and event.get("link") in links
        and (now := settings_of(event["link"])) is not None
    ):
        yield from (f"set.{line}" for line in change_mistakes(*now, event["set"]))
