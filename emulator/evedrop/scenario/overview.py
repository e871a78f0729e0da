"""A scenario in a few lines, as Python and a notebook show it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from evedrop.counting import counted
from evedrop.scenario.words import as_toml

_SHOWN = ("title", "slots", "seed", "trials", "slot_seconds", "process", "encoding", "legitimate", "eavesdroppers")
_MOST = 100  # characters of a line's contents
_MOST_VALUES = 4  # of a list that is written out


def overview(tables: Mapping[str, Any], n: int) -> str:
    """Title, slots, process, scheme, and the link of each receiver, a line each; then the names of the other tables.

    tables: those of the scenario's file; n: the number of states.
    """
    rows = dict(_rows(tables, n))
    width = max(map(len, rows))
    lines = [f"{name:<{width}}  {_shortened(contents)}" for name, contents in rows.items()]
    return "\n  ".join([f"Scenario {as_toml(tables['title'])}", *lines])


def _rows(tables: Mapping[str, Any], n: int) -> Iterator[tuple[str, str]]:
    seconds = f" of {tables['slot_seconds']:g} s" if "slot_seconds" in tables else ""
    trials = f", {counted(tables['trials'], 'trial')}" if tables.get("trials", 1) > 1 else ""
    yield "slots", f"{tables['slots']:,}{seconds}{trials}, seed {tables['seed']}"
    yield "process", _process(tables["process"], n)
    yield "scheme", _named(tables["encoding"], "scheme")
    for name, table in {"legitimate": tables["legitimate"], **tables.get("eavesdroppers", {})}.items():
        links = [table["link"]] if "link" in table else table.get("links", [])
        others = {key: value for key, value in table.items() if key not in {"link", "links"}}
        contents = [*([_named(others, "strategy")] if others else []), *(f"link {_words(link)}" for link in links)]
        yield name, ", ".join(contents)
    if also := [name for name in tables if name not in _SHOWN]:
        yield "also given", ", ".join(also)


def _process(table: Mapping[str, Any], n: int) -> str:
    units = [f"({unit})" if unit else "" for unit in table.get("units", [""] * n)]
    names = [" ".join(filter(None, pair)) for pair in zip(table.get("states", [""] * n), units, strict=True)]
    return counted(n, "state") + (f": {', '.join(names)}" if any(names) else "")


def _named(entries: Mapping[str, Any], key: str) -> str:
    """The name that an entry gives, if it does, and the other entries in parentheses."""
    words = _words({name: value for name, value in entries.items() if name != key})
    return " ".join([*([entries[key]] if key in entries else []), *([f"({words})"] if words else [])])


def _words(entries: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {_value(value)}" for key, value in entries.items())


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return _named(value, "model")
    if isinstance(value, list) and len(value) > _MOST_VALUES:
        return f"of {len(value):,} values"
    return value if isinstance(value, str) else as_toml(value)


def _shortened(text: str) -> str:
    return text if len(text) <= _MOST else f"{text[: _MOST - 1]}…"
