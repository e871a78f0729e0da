"""The recordings that a scenario names: read when it is loaded, so that whoever gets the scenario needs no file.

Source: docs/links.md, traces.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from emulator.errors import TraceError
from emulator.scenario.words import as_toml
from emulator.traces import Recording

_STAND_IN = "1"  # for a recording that cannot be read: it is complained of once


def beside(tables: Mapping[str, Any], folder: Path) -> None:
    """Change the name of every recording to where it is, for a scenario in this folder."""
    for _, loss in _traces(tables):
        if isinstance(loss.get("file"), str):
            loss["file"] = str(folder / loss["file"])


def read_recordings(tables: Mapping[str, Any]) -> list[str]:
    """Put `outcomes` in the place of every recording's `file` and `column`; the mistakes, with their paths."""
    mistakes = []
    slots = tables.get("slots")
    for path, loss in _traces(tables):
        source = "outcomes" if "outcomes" in loss else "file"
        wrong = [f"{path}.{entry}: {what}" for entry, what in _replace(loss)]
        mistakes += wrong
        outcomes = loss["outcomes"]
        if wrong:
            loss.pop("once", None)
        elif loss.get("once") is True and isinstance(outcomes, str) and type(slots) is int and len(outcomes) < slots:
            few = f"has {len(outcomes)} outcomes and is read once; expected slots, which is {slots}, or more"
            mistakes.append(f"{path}.{source}: {few}")
    return mistakes


def _traces(tables: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Path and table of every loss model that is a trace, wherever a link may be described."""
    entries = tables.items() if isinstance(tables, dict) else enumerate(tables) if isinstance(tables, list) else ()
    for name, inner in entries:
        if name == "loss" and isinstance(inner, dict) and inner.get("model") == "trace":
            yield f"{path}{name}", inner
        else:
            yield from _traces(inner, f"{path}{name}.")


def _replace(loss: dict[str, Any]) -> list[tuple[str, str]]:
    """One recording's; what is wrong, as (entry, what)."""
    file, column = loss.pop("file", None), loss.pop("column", None)
    if "outcomes" in loss:
        extra = "file" if file is not None else "column" if column is not None else None
        return [(extra, "is there beside outcomes; expected one of them")] if extra else []
    loss["outcomes"] = _STAND_IN
    if file is None:
        return [("file", 'is missing; expected file = "walk.csv"')]
    wrong = [
        (name, f"is {as_toml(value)}; expected a string")
        for name, value in (("file", file), ("column", column))
        if value is not None and not isinstance(value, str)
    ]
    if wrong:
        return wrong
    try:
        loss["outcomes"] = (Recording(Path(file)).outcomes(column) + ord("0")).tobytes().decode()
    except TraceError as error:
        return [(error.entry, f"{file} {error.what}" if error.entry == "file" else error.what)]
    return []
