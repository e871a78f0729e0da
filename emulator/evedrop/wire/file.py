"""Wire files: read, checked, and written again; mistakes are reported together.

Source: docs/wire.md, the file.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from evedrop.errors import ScenarioError, UsageError
from evedrop.scenario.input_files import locate_recordings, read_recordings
from evedrop.scenario.loading import set_entry, tables_in
from evedrop.scenario.loading.line_numbers import with_line_numbers
from evedrop.scenario.sentences import sentences
from evedrop.scenario.toml_text import toml_text
from evedrop.scenario.values import unusable
from evedrop.system.files import Unreadable, shown, text_of
from evedrop.wire.across import link_names, mistakes_across, unknown
from evedrop.wire.plan import Side, SideTls, WireEvent, WireLink, WirePlan
from evedrop.wire.tables import SideTable, TlsTable, WireEventTable, WireFile, WireLinkTable, changed_settings

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
    numbered = {_by_number(key, tables): value for key, value in (changes or {}).items()}
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
        raise ScenarioError(source, [*sentences(error, WireFile), *recordings, *mistakes_across(made)]) from None
    if mistakes := [*recordings, *mistakes_across(made)]:
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
            "expect": [one.model_dump(exclude_none=True) for one in plan.expectations],
        }
    )


def _by_number(key: str, tables: Mapping[str, Any]) -> str:
    """The dotted key of a change, with a link's number in place of its name. Raises UsageError for another name."""
    table, _, rest = key.partition(".")
    name, dot, entry = rest.partition(".")
    links = tables.get("link")
    if table != "link" or not name or name.isdecimal() or not isinstance(links, list):
        return key
    names = link_names([link if isinstance(link, Mapping) else {} for link in links])
    if name not in names:
        raise UsageError(f"{key}: {unknown(name, names, 'link')}, or a number from 0")
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
    names = link_names([table.model_dump(include={"name", "source", "target"}) for table in file.link])
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
    tls = None if table.tls is None else SideTls(table.tls.certificate, table.tls.key, table.tls.authority)
    return Side(name, table.endpoints, tuple(table.connect), tls, table.users, tuple(table.keys), table.peers)


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
    one, other = table.partition or ("", "")
    changes = None
    if table.link is not None and table.set is not None:
        changes = changed_settings(settings[table.link], table.set, first[table.link])
    partition = None if table.partition is None else (one, other)
    return WireEvent(start, table.to, partition, table.cut, table.link, changes, table.note)


def _side_table(side: Side) -> dict[str, Any]:
    table: dict[str, Any] = {"listen": list(side.listen), "connect": list(side.connect), "keys": list(side.keys)}
    if side.tls is not None:
        authority = {} if side.tls.authority is None else {"authority": side.tls.authority}
        table["tls"] = {"certificate": side.tls.certificate, "key": side.tls.key, **authority}
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
