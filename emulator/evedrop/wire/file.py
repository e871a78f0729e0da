"""Wire files: read, checked, explained, and written again.

Mistakes of tables are reported together; without any, those that only show when tables are compared: names, endpoints, events.
An explanation has the links in order, which of them each key takes, and entries that are probably mistakes.

Source: docs/wire/file.md, the file, and which link a key takes.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import resources
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import zenoh
from pydantic import ValidationError

from evedrop.errors import ScenarioError, UsageError
from evedrop.model.checks import as_toml
from evedrop.model.links import loss_of
from evedrop.scenario.input_files import locate_recordings, read_recordings
from evedrop.scenario.line_numbers import with_line_numbers
from evedrop.scenario.loading import set_entry, tables_in
from evedrop.scenario.receivers import CHANGEABLE, other_model, tie_of, unchangeable
from evedrop.scenario.table import sentences, unusable
from evedrop.scenario.words import listed, toml_text
from evedrop.system.files import Unreadable, shown, text_of
from evedrop.system.hints import near
from evedrop.wire.plan import Side, WireEvent, WireLink, WirePlan
from evedrop.wire.tables import (
    ENCRYPTED,
    IN_ORDER,
    NOTHING_LOST,
    EndpointPlace,
    SideTable,
    TlsTable,
    WireEventTable,
    WireFile,
    WireLinkTable,
    WireSettingsTable,
    changed_settings,
    expectation_mistakes,
    key_expression_mistake,
    place_of,
)

_MOST_BYTES = 2**28


def load_wire(path: str | Path, changes: Mapping[str, Any] | None = None) -> WirePlan:
    """The wire in a file, with changes by dotted key, which names a link by its name or its number.

    Raises ScenarioError with every mistake, UsageError if the file cannot be read.
    """
    path = Path(path)
    try:
        text = text_of(path, _MOST_BYTES)
    except Unreadable as error:
        example = "a wire file is a TOML file; `evedrop wire --example` prints one"
        raise UsageError(f"{shown(path)} cannot be read ({error}); {example}") from error
    tables = tables_in(text, shown(path))
    numbered = {_by_number(key, tables, shown(path)): value for key, value in (changes or {}).items()}
    with with_line_numbers(text, numbered):
        return wire_of(tables, shown(path), numbered, folder=path.parent)


def example_wire() -> str:
    """A commented wire file to start from."""
    return resources.files("evedrop.wire").joinpath("examples", "robot.toml").read_text(encoding="utf-8")


def wire_of(
    tables: Mapping[str, Any], source: str = "wire", changes: Mapping[str, Any] | None = None, *, folder: Path = Path()
) -> WirePlan:
    """The wire that tables describe. Raises ScenarioError with every mistake.

    folder: where the recordings and certificates are that the tables name; files that a change names are in the current folder.
    """
    made = copy.deepcopy({**tables})
    _locate_files(made, folder)
    for key, value in (changes or {}).items():
        set_entry(made, key, value)
    if wrong := list(unusable(made)):
        raise ScenarioError(source, wrong)
    recordings = read_recordings(made)
    try:
        file = WireFile.model_validate(made)
    except ValidationError as error:
        wrong = [*sentences(error, WireFile), *recordings]
        mistaken = {line.partition(":")[0] for line in wrong}
        beside = (line for line in _mistakes_beside(made, error) if line.partition(":")[0] not in mistaken)
        raise ScenarioError(source, [*wrong, *beside]) from None
    if mistakes := recordings or list(mistakes_across(file, made["side"])):
        raise ScenarioError(source, mistakes)
    return _plan(file)


def resolved_wire(plan: WirePlan) -> str:
    """The complete wire file of a plan, as TOML: loading it gives the same plan."""
    return toml_text(
        {
            "seed": plan.seed,
            "lossless": list(plan.lossless),
            "largest": plan.largest,
            "query_seconds": plan.query_seconds,
            "held_messages": plan.held_messages,
            "held_bytes": plan.held_bytes,
            "side": {name: _side_table(side) for name, side in plan.sides.items()},
            "link": [_link_table(link) for link in plan.links],
            "event": [_event_table(event) for event in plan.events],
            "expect": [expectation.model_dump(exclude_none=True) for expectation in plan.expectations],
        }
    )


def _by_number(key: str, tables: Mapping[str, Any], source: str) -> str:
    """The dotted key of a change, with a link's number in place of its name. Raises ScenarioError for another name."""
    table, _, rest = key.partition(".")
    name, dot, entry = rest.partition(".")
    links = tables.get("link")
    if table != "link" or not name or name.isdecimal() or not isinstance(links, list):
        return key
    named = [link if isinstance(link, Mapping) else {} for link in links]
    names = link_names((link.get("name"), link.get("from"), link.get("to")) for link in named)
    if name not in names:
        choice = f"expected {listed([*names, 'a number from 0'])}"
        raise ScenarioError(source, [f"{key}: is {as_toml(name)}; {choice}{near(name, names)}"])
    return f"link.{names.index(name)}{dot}{entry}"


def _locate_files(tables: dict[str, Any], folder: Path) -> None:
    """Replace the names of recordings and certificates with their paths, in place."""
    locate_recordings(tables, folder)
    sides = tables.get("side")
    for side in sides.values() if isinstance(sides, dict) else ():
        tls = side.get("tls") if isinstance(side, dict) else None
        for entry in TlsTable.entries():
            if isinstance(tls, dict) and isinstance(tls.get(entry), str):
                tls[entry] = str((folder / tls[entry]).absolute())


def _plan(file: WireFile) -> WirePlan:
    names = link_names((table.name, table.source, table.target) for table in file.link)
    links = tuple(_link(number, name, table) for number, (name, table) in enumerate(zip(names, file.link, strict=True)))
    settings = {link.name: link.settings for link in links}
    return WirePlan(
        seed=file.seed,
        sides={name: _side(name, table) for name, table in file.side.items()},
        links=links,
        events=tuple(wire_event(table, settings, settings) for table in file.event),
        lossless=tuple(file.lossless),
        largest=file.largest,
        query_seconds=file.query_seconds,
        held_messages=file.held_messages,
        held_bytes=file.held_bytes,
        expectations=tuple(file.expect),
    )


def _side(name: str, table: SideTable) -> Side:
    return Side(name, table.endpoints, tuple(table.connect), table.tls, table.users, tuple(table.keys), table.peers)


def _link(number: int, name: str, table: WireLinkTable) -> WireLink:
    tie = None if table.correlation is None else (table.correlation.to, table.correlation.strength)
    return WireLink(
        name, number, table.source, table.target, table.keys, table.wire_settings(), table.tap, table.ordered, tie
    )


def wire_event(
    table: WireEventTable, settings: Mapping[str, Mapping[str, Any]], first: Mapping[str, Mapping[str, Any]]
) -> WireEvent:
    """The event of a table. settings: those of each link when the event begins; first: those at the start of the wire."""
    start = table.at if table.start is None else table.start
    assert start is not None  # noqa: S101 - checked when the table was read
    changes = None
    if table.link is not None and table.set is not None:
        changes = changed_settings(settings[table.link], table.set, first[table.link])
    partition = None if table.partition is None else (table.partition[0], table.partition[1])
    return WireEvent(start, table.to, partition, table.cut, table.link, changes, table.note)


def _side_table(side: Side) -> dict[str, Any]:
    table: dict[str, Any] = {"listen": list(side.listen), "connect": list(side.connect), "keys": list(side.keys)}
    if side.tls is not None:
        table["tls"] = side.tls.model_dump(exclude_none=True)
    if side.users is not None:
        table["users"] = dict(side.users)
    if side.peers:
        table["peers"] = True
    return table


def _link_table(link: WireLink) -> dict[str, Any]:
    table = {
        "name": link.name,
        "from": link.source,
        "to": link.target,
        "keys": link.keys,
        "tap": link.tap,
        "ordered": link.ordered,
        **link.settings,
    }
    if link.correlation is not None:
        table["correlation"] = {"with": link.correlation[0], "strength": link.correlation[1]}
    return table


def _event_table(event: WireEvent) -> dict[str, Any]:
    table: dict[str, Any] = {"at": event.start} if event.stop is None else {"from": event.start, "to": event.stop}
    if event.partition is not None:
        table["partition"] = list(event.partition)
    given = {"cut": event.cut, "link": event.link, "set": event.settings, "note": event.note}
    return table | {name: value for name, value in given.items() if value is not None}


class LinkNow(NamedTuple):
    """What a change of a link depends on."""

    name: str
    settings: Mapping[str, Any]
    tie: str | None
    """How its losses and another link's are tied, in words; None if they are not."""
    ordered: bool


def mistakes_across(file: WireFile, sides: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Mistakes across the tables of a wire file. sides: the tables as they are written, for the places of endpoints."""
    names = link_names((link.name, link.source, link.target) for link in file.link)
    yield from _endpoint_mistakes(sides)
    yield from _side_mistakes([*file.side], file.link)
    yield from _name_mistakes(file.link)
    yield from _correlation_mistakes(names, file.link)
    ties = {
        name: link.correlation.to for name, link in zip(names, file.link, strict=True) if link.correlation is not None
    }
    links = {
        name: LinkNow(name, link.wire_settings(), tie_of(name, ties), link.ordered)
        for name, link in zip(names, file.link, strict=True)
        if link.name is not None or {link.source, link.target} <= {*file.side}  # otherwise the name is mistaken, too
    }
    yield from expectation_mistakes(file.expect, [*links] or names)
    for i, event in enumerate(file.event):
        yield from (f"event.{i}.{line}" for line in event_mistakes(event, [*file.side], links))


def _mistakes_beside(made: Mapping[str, Any], error: ValidationError) -> Iterator[str]:
    """Mistakes across tables in a file some of whose tables are wrong by themselves: others with their names replace them."""
    tables = copy.deepcopy({**made})
    replaced: set[str] = set()
    for place in {mistake["loc"][:2] for mistake in error.errors(include_url=False, include_input=False)}:
        name, at = str(place[0]), place[-1]
        within = tables.get(name)
        if name in _PLACEHOLDERS and isinstance(within, list) and isinstance(at, int):
            entries = within[at] if isinstance(within[at], Mapping) else {}
            within[at] = _PLACEHOLDERS[name](entries)
            replaced.add(f"{name}.{at}")
        elif name == "side" and isinstance(within, dict) and isinstance(within.get(at), Mapping):
            within[at] = {}
        else:
            tables.pop(name, None)
    try:
        lines = [*mistakes_across(WireFile.model_validate(tables), tables["side"])]
    except ValidationError:
        return
    for line in lines:
        table, number, entry, *_ = [*line.partition(":")[0].split("."), "", ""]
        if f"{table}.{number}" not in replaced or (entry in _NAMES and ': is "";' not in line):
            yield line


_NAMES = {"name", "from", "to", "cut", "partition"}


def _link_placeholder(entries: Mapping[str, Any]) -> dict[str, Any]:
    names = {name: entries[name] for name in ("name", "from", "to") if isinstance(entries.get(name), str)}
    return {"from": "", "to": "", **names}


def _event_placeholder(entries: Mapping[str, Any]) -> dict[str, Any]:
    pair, link = entries.get("partition"), entries.get("cut")
    if isinstance(pair, list) and len(pair) == 2 and all(isinstance(side, str) for side in pair):
        return {"at": 0.0, "partition": pair}
    return {"at": 0.0, "cut": link} if isinstance(link, str) else {"at": 0.0, "note": "…"}


_PLACEHOLDERS: Mapping[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    "link": _link_placeholder,
    "event": _event_placeholder,
    "expect": lambda _entries: {"link": ""},
}


def link_names(links: Iterable[tuple[Any, Any, Any]]) -> list[str]:
    """The name of each link: that in its table, or FROM-TO, or FROM-TO-2 and so on where that is taken.

    links: the name or None, where it begins and where it ends, for each.
    """
    links = list(links)
    taken = {str(name) for name, _, _ in links if name is not None}
    names = []
    for own, source, target in links:
        name = own
        if name is None:
            plain = f"{source}-{target}"
            numbered = (f"{plain}-{number}" for number in range(2, 2 * len(links) + 2))
            name = next(name_ for name_ in (plain, *numbered) if name_ not in taken)
            taken.add(name)
        names.append(str(name))
    return names


def change_mistakes(link: LinkNow, changes: Mapping[str, Any]) -> Iterator[str]:
    """Mistakes in changed entries of a link."""
    yield from unchangeable(changes)
    settings = link.settings
    try:
        made = changed_settings(settings, {entry: changes[entry] for entry in changes if entry in CHANGEABLE}, settings)
    except ValidationError as error:
        yield from sentences(error, WireSettingsTable)
        return
    if link.ordered and made.get("reorder"):
        yield f"reorder: {IN_ORDER}"
    if link.tie is not None and made.get("loss", settings["loss"])["model"] != settings["loss"]["model"]:
        yield other_model(link.name, changes, link.tie)


def _endpoint_mistakes(sides: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Two sides, or one side twice, at one place."""
    listens, connects = _places(sides, "listen"), _places(sides, "connect")
    round_and_round = "so that messages would go round"
    for i, placed in enumerate(listens):
        if (other := _overlapping(placed, listens[:i])) is not None:
            same = "the same place" if placed.endpoint == other.endpoint else f"the same place as {other.endpoint}"
            yield f"{placed.beginning}, {same} at which side {other.side} listens; expected another port"
    for i, placed in enumerate(connects):
        if (other := _overlapping(placed, listens)) is not None:
            where = f"where side {other.side} of this wire listens, {round_and_round}"
            yield f"{placed.beginning}, {where}; expected a router outside of the wire"
        if (other := _overlapping(placed, connects[:i])) is not None:
            why = "" if placed.side == other.side else f", {round_and_round}"
            yield f"{placed.beginning}, the router to which side {other.side} connects{why}; expected another router"


class _Placed(NamedTuple):
    """An endpoint of a side."""

    path: str
    side: str
    endpoint: str
    place: EndpointPlace

    @property
    def beginning(self) -> str:
        """The beginning of a message about it."""
        return f"{self.path}: is {as_toml(self.endpoint)}"


def _overlapping(endpoint: _Placed, others: Sequence[_Placed]) -> _Placed | None:
    return next((other for other in others if endpoint.place.overlaps(other.place)), None)


def _places(sides: Mapping[str, Mapping[str, Any]], entry: str) -> list[_Placed]:
    places = []
    for name, side in sides.items():
        given = side.get(entry) or []
        several = {"": given} if isinstance(given, str) else {f".{i}": endpoint for i, endpoint in enumerate(given)}
        for number, endpoint in several.items():
            if (place := place_of(endpoint)) is not None:
                places.append(_Placed(f"side.{name}.{entry}{number}", name, endpoint, place))
    return places


def unknown(name: object, names: Sequence[str], kind: str) -> str:
    """The end of a message about a name that nothing has. kind: `side` or `link`."""
    choice = f"expected {listed(names)}" if names else f"the file has no {kind}"
    return f"is {as_toml(name)}; {choice}{near(name, names)}"


def _side_mistakes(sides: Sequence[str], links: Sequence[WireLinkTable]) -> Iterator[str]:
    for i, link in enumerate(links):
        for entry, name in (("from", link.source), ("to", link.target)):
            if name not in sides:
                yield f"link.{i}.{entry}: {unknown(name, sides, 'side')}"
        if link.target == link.source and link.target in sides:
            yield f"link.{i}.to: is {as_toml(link.target)}, where the link begins; expected another side"


def _name_mistakes(links: Sequence[WireLinkTable]) -> Iterator[str]:
    first: dict[str, int] = {}
    for i, link in enumerate(links):
        if link.name is not None and first.setdefault(link.name, i) != i:
            same = f"the name of link.{first[link.name]}"
            yield f"link.{i}.name: is {as_toml(link.name)}, {same}; expected a name of its own"


def _correlation_mistakes(names: Sequence[str], links: Sequence[WireLinkTable]) -> Iterator[str]:
    for i, (name, link) in enumerate(zip(names, links, strict=True)):
        if link.correlation is None:
            continue
        path, other = f"link.{i}.correlation.with", link.correlation.to
        others = [name_ for name_ in names if name_ != name]
        if other not in others:
            yield f"{path}: {unknown(other, others, 'other link')}"
            continue
        theirs = links[names.index(other)]
        there, here = theirs.loss_spec["model"], link.loss_spec["model"]
        if theirs.correlation is not None:
            yield f"{path}: is {other}, whose own losses are tied to another link's; expected a link without correlation"
        elif there != here:
            yield f"{path}: is {other}, but the loss models differ ({there} there and {here} here); expected the same model"


def event_mistakes(event: WireEventTable, sides: Sequence[str], links: Mapping[str, LinkNow]) -> Iterator[str]:
    """Mistakes in an event that only show with the sides and links of the wire, given by their names."""
    for i, name in enumerate(event.partition or ()):
        if name not in sides:
            yield f"partition.{i}: {unknown(name, sides, 'side')}"
    if event.partition is not None and event.partition[0] == event.partition[1]:
        yield f"partition: is {as_toml(event.partition)}; expected two different sides"
    for entry, link in (("cut", event.cut), ("link", event.link)):
        if link is not None and link not in links:
            yield f"{entry}: {unknown(link, [*links], 'link')}"
    if event.link is not None and event.set is not None and event.link in links:
        yield from (f"set.{line}" for line in change_mistakes(links[event.link], event.set))


def wire_lines(plan: WirePlan) -> Iterator[str]:
    """The sides, and the links in the order in which they are tried."""
    width = max(len(name) for name in (*plan.sides, *(link.name for link in plan.links)))
    for side in plan.sides.values():
        where = [*side.listen, *(f"connects to {endpoint}" for endpoint in side.connect)]
        yield f"side  {side.name:<{width}}  {', '.join(where)}{_guards(side)}"
    for link in plan.links:
        tap = " (tap)" if link.tap else ""
        yield f"link  {link.name:<{width}}  {link.source} → {link.target}{tap}  {link.keys}  {_effects(link)}"
    for expression in plan.lossless:
        yield f"never lost  {expression}"


def key_lines(plan: WirePlan, keys: Sequence[str]) -> Iterator[str]:
    """Which link each key takes, in each direction that has a link. Raises UsageError for all keys that Zenoh refuses."""
    wrong = [
        f"key {as_toml(key)}{why}{f'; the ROS 2 topic {key} has the keys */{key[1:]}/**' if key[:1] == '/' else ''}"
        for key in keys
        if (why := key_expression_mistake(key)) is not None
    ]
    if wrong:
        raise UsageError("\n".join(wrong))
    ways = [way for way in permutations(plan.sides, 2) if any((link.source, link.target) == way for link in plan.links)]
    for key in keys:
        expression = zenoh.KeyExpr(key)
        yield f"key  {key}{'  (never lost)' if plan.is_lossless(expression) else ''}"
        taken = {way: plan.link_of(*way, expression) for way in ways}
        for (source, target), link in taken.items():
            yield f"  {source} → {target}  {'no link takes it' if link is None else _taken(link, expression)}"
        if "@" in key and not any(taken.values()):
            yield "  wildcards do not match the parts of a key that begin with @: name them in a link's keys"


def warnings_of_wire(plan: WirePlan) -> Iterator[str]:
    """What is allowed, and probably a mistake."""
    for i, link in enumerate(plan.links):
        for before in plan.links[:i]:
            same = (before.source, before.target) == (link.source, link.target)
            if same and before.expression.includes(link.expression):
                none = "publication" if before.tap and not link.tap else "key"
                why = f"{before.name}, which comes first, takes all of them"
                yield f"link {link.name} takes no {none}: {why}; move {link.name} up"
                break
    for side in plan.sides.values():
        if not any(side.name in (link.source, link.target) for link in plan.links):
            yield f"side {side.name} has no link: nothing crosses to it or from it"
        yield from _openness(side)
    ways = {(link.source, link.target) for link in plan.links if not link.tap}
    for source, target in sorted(ways):
        if (target, source) not in ways:
            yield f"no link leads from {target} back to {source}: queries from {source} get no replies"


def _taken(link: WireLink, key: zenoh.KeyExpr) -> str:
    """The link that takes a key, and what is special about that."""
    notes = ["a copy of publications, no queries"] if link.tap else []
    if not link.takes_all(key):
        notes.append("which takes only some of these keys")
    return f"{link.name} ({'; '.join(notes)})" if notes else link.name


def _losses(spec: Mapping[str, Any]) -> Iterator[str]:
    """How much a link with a memory loses on average, and how many messages in a row."""
    chain = loss_of(spec).chain
    if chain is None or chain.independent:
        return
    lost = 1.0 - chain.quality
    average = float(chain.stationary @ lost)
    beginning = float((chain.stationary * chain.quality) @ chain.transitions @ lost)
    if beginning > 0.0:
        yield f"loses {100.0 * average:.3g} % on average, in bursts of {average / beginning:.3g} messages"


def _effects(link: WireLink) -> str:
    """The settings of a link, without those that do nothing."""
    settings: Mapping[str, Any] = link.settings
    told = [f"{name} = {as_toml(value)}" for name, value in settings.items() if (name, value) != ("loss", NOTHING_LOST)]
    told += _losses(settings["loss"])
    if link.ordered:
        told.append("in order")
    if link.correlation is not None:
        told.append(f"losses tied to {link.correlation[0]} with strength {link.correlation[1]}")
    return ", ".join(told) or "no faults"


def _guards(side: Side) -> str:
    """Who may use a side, if not every client that can reach it."""
    guards = [] if side.users is None else [f"users {', '.join(side.users)}"]
    if side.listen and all(_certified(side, endpoint) for endpoint in side.listen):
        guards.append("certificates required")
    if side.keys != ("**",):
        guards.append(f"only {', '.join(side.keys)}")
    if side.peers:
        guards.append("mode peer allowed")
    return f"  ({'; '.join(guards)})" if guards else ""


def _certified(side: Side, endpoint: str) -> bool:
    """Whether programs need a certificate at an endpoint: only encrypted ones ask for it."""
    return endpoint.partition("/")[0] in ENCRYPTED and side.tls is not None and side.tls.authority is not None


def _openness(side: Side) -> Iterator[str]:
    """A warning for each endpoint that other machines can reach without proving who they are."""
    for endpoint in side.listen:
        place = place_of(endpoint)
        if place is None or place.loopback:
            continue
        lacking = [] if place.protocol in ENCRYPTED else ["encryption (tls)"]
        if side.users is None and not _certified(side, endpoint):
            lacking.append("users or an authority")
        if lacking:
            without = " and without ".join(lacking)
            yield f"side {side.name} listens on {endpoint}, which other machines may reach, without {without}"
