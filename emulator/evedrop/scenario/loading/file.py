"""Scenario files: found by name or path, read, changed by dotted keys, and checked.

Source: docs/scenario.md.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from evedrop.errors import ScenarioError, UsageError
from evedrop.model.registry import place_of
from evedrop.scenario.drawn import with_faults
from evedrop.scenario.dry_run import dry_run, has_foreign
from evedrop.scenario.events import EVENTS
from evedrop.scenario.filter_noise import replace_filter_noise
from evedrop.scenario.input_files import (
    locate_recordings,
    locate_tables,
    read_recordings,
    read_tables,
)
from evedrop.scenario.loading.line_numbers import given_twice, with_line_numbers
from evedrop.scenario.loading.mistakes import mistakes_across
from evedrop.scenario.plugins import elsewhere, named_in
from evedrop.scenario.sentences import sentences
from evedrop.scenario.stream_keys import secret_in
from evedrop.scenario.tables import Scenario
from evedrop.scenario.values import unusable
from evedrop.scenario.words import listed
from evedrop.scenarios import shipped
from evedrop.system.files import Unreadable, is_folder, is_there, shown, text_of
from evedrop.system.hints import near

MOST_BYTES = 2**28
"""The largest scenario file: room for the outcomes of millions of packets."""
MOST_VALUES = 1_000_000
"""The most values in the lists of a scenario file: reading more would take too long."""
_TWICE = ("Cannot overwrite", "Cannot declare", "Cannot mutate", "Cannot redefine")
"""How Python's TOML reader begins to say that an entry is given twice."""
_MOST_DOTS = 32
# Python's TOML reader takes time that grows with the square of the number of a key's parts.
_PART = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+"""
_DOTTED = re.compile(rf"""(?<![A-Za-z0-9_"'.-])(?:{_PART}){{{_MOST_DOTS}}}""")


def load(source: str | Path, changes: Mapping[str, Any] | None = None, *, beyond_horizon: bool = False) -> Scenario:
    """Load a built-in scenario by name, or a file, with changes by dotted key.

    beyond_horizon: allow more slots than float64 can follow exactly, for commands that do not follow states.

    Raises ScenarioError with every mistake, UsageError if there is no such scenario.
    """
    path = shipped().get(str(source), Path(source))
    # A built-in scenario names no files of its own, so the names in a change refer to the current folder.
    folder = Path() if str(source) in shipped() else path if is_folder(path) else path.parent
    return parse(read(source), shown(source), changes, beyond_horizon=beyond_horizon, folder=folder)


def read(source: str | Path) -> str:
    """The text of a built-in scenario or a file."""
    path = shipped().get(str(source), Path(source))
    if is_folder(path):
        path = path / "scenario.toml"
        if not is_there(path):
            raise UsageError(f"{shown(source)} is a folder without a scenario.toml; give a scenario's name or file")
    try:
        return text_of(path, MOST_BYTES)
    except Unreadable as error:
        if is_there(path):
            raise UsageError(f"{shown(path)} cannot be read ({error}); a scenario is a TOML file") from error
        hint = near(source, shipped()) or ";"
        raise UsageError(
            f"no scenario {shown(source)} ({error}){hint} `evedrop list` shows the built-in ones"
        ) from error


def parse(
    text: str,
    source: str,
    changes: Mapping[str, Any] | None = None,
    *,
    beyond_horizon: bool = False,
    folder: Path = Path(),
) -> Scenario:
    """The scenario in a TOML text. Raises ScenarioError with every mistake.

    folder: where the files are that the text names; files that a change names are in the current folder.
    """
    tables = tables_in(text, source)
    if not tables and not changes:
        raise ScenarioError(source, ["has no entries; `evedrop new FILE` writes a scenario to start from"])
    located(tables, folder)
    with with_line_numbers(text, changes or ()):
        return checked(tables, source, changes, beyond_horizon=beyond_horizon, folder=folder)


def located(tables: dict[str, Any], folder: Path) -> None:
    """Replace the names of files in tables with their paths, in place; folder: that of the scenario."""
    locate_recordings(tables, folder)
    locate_tables(tables, folder)
    for entry in ("secret_file", "modules"):
        if isinstance(tables.get(entry), str):
            tables[entry] = str((folder / tables[entry]).absolute())


def tables_in(text: str, source: str) -> dict[str, Any]:
    """The tables of a TOML text, before their entries are checked.

    Raises ScenarioError if the text is not TOML, or a value cannot be used at all.
    """
    if (values := text.count(",")) > MOST_VALUES:
        large = f"has about {values} values; expected at most {MOST_VALUES}"
        raise ScenarioError(source, [f"{large}: put disturbances and recordings into files of their own"])
    if (dotted := _DOTTED.search(text)) is not None:
        line = text.count("\n", 0, dotted.start()) + 1
        long = f"line {line} has a key of {_MOST_DOTS} or more parts"
        raise ScenarioError(source, [f"{long}; expected one such as legitimate.link.quality"])
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, tables nested without end
        raise ScenarioError(source, [_no_toml(text, error)]) from None
    if mistakes := list(unusable(tables)):
        raise ScenarioError(source, mistakes)
    return tables


def _no_toml(text: str, error: Exception) -> str:
    """Why a text is not TOML, in words that name an entry that is given twice."""
    place = re.search(r"\(at line (\d+), column \d+\)", str(error))
    twice = None
    if place is not None and str(error).startswith(_TWICE):
        twice = given_twice(text, int(place[1]))
    return f"not TOML: {error if twice is None else twice}"


def checked(
    tables: dict[str, Any],
    source: str,
    changes: Mapping[str, Any] | None = None,
    *,
    beyond_horizon: bool = False,
    folder: Path = Path(),
) -> Scenario:
    """The scenario that tables describe, with changes made and recordings read. Raises ScenarioError with every mistake.

    folder: where custom modules are, if the tables name any and name no folder of modules.
    """
    for key, value in (changes or {}).items():
        set_entry(tables, key, value)
    if changes and (wrong := list(unusable(tables))):
        raise ScenarioError(source, wrong)
    if any(named_in(tables)):
        tables.setdefault("modules", str(folder))
    mistakes = [*read_recordings(tables), *read_tables(tables), *replace_filter_noise(tables)]
    if isinstance(tables.get("secret_file"), str):
        try:
            secret_in(tables["secret_file"])
        except UsageError as error:
            mistakes.append(str(error))
    if isinstance(tables.get("modules"), str):
        tables["modules"] = str(Path(tables["modules"]).absolute())
        mistakes += [f"modules: {sentence}" for sentence in elsewhere(tables["modules"], tables)]
    try:
        scenario = Scenario.read(tables)
    except ValidationError as error:
        raise ScenarioError(source, [*dict.fromkeys([*sentences(error, Scenario), *mistakes])]) from None
    if mistakes:
        raise ScenarioError(source, mistakes)
    broken = dry_run(scenario)
    # A class that breaks in a dry run breaks again when it is asked about itself: report that only once.
    mistakes = broken + _across(scenario, beyond_horizon, silent=bool(broken))
    if scenario.nemesis is not None:
        tables, of_nemesis = with_faults(tables, scenario)
        mistakes += of_nemesis
        if not mistakes:
            scenario = Scenario.read(tables)
            mistakes = _across(scenario, beyond_horizon)
    if mistakes:
        raise ScenarioError(source, mistakes)
    return scenario


def _across(scenario: Scenario, beyond_horizon: bool, silent: bool = False) -> list[str]:
    """Mistakes across tables; an error that a custom class raises when asked is a mistake too, unless silent."""
    try:
        return mistakes_across(scenario, beyond_horizon)
    except Exception as error:
        if not has_foreign(scenario):
            raise
        if silent:
            return []
        return [f"modules: a class raised {place_of(error)} when it was asked about itself; expected no error"]


_SHORT_FORMS = {"quality": "loss", "loss": "quality"}
"""Entry of a link → the other form of it, which a change replaces."""


def set_entry(tables: dict[str, Any], dotted: str, value: Any) -> None:
    """Put a value at a dotted key; a link's `quality` replaces its `loss`, and the other way round.

    Tables may be new; list entries are given by number, including the next one.
    """
    names = dotted.split(".")
    inner: Any = tables
    for name, after in pairwise(names):
        new: Any = [] if after == "0" else {}
        if isinstance(inner, dict) and name:
            inner.pop(_SHORT_FORMS.get(name), None)
            inner = inner.setdefault(name, new)
        elif isinstance(inner, list) and name.isdecimal() and int(name) <= len(inner):
            if int(name) == len(inner):
                inner.append(new)
            inner = inner[int(name)]
        else:
            raise _no_such_key(dotted, name, inner)
    last = names[-1]
    if isinstance(inner, dict) and last:
        inner.pop(_SHORT_FORMS.get(last), None)
        inner[last] = value
    elif isinstance(inner, list) and last.isdecimal() and int(last) <= len(inner):
        inner[int(last) : int(last) + 1] = [value]
    else:
        raise _no_such_key(dotted, last, inner)


def _no_such_key(dotted: str, name: str, inner: Any) -> UsageError:
    if isinstance(inner, list):
        return UsageError(f"{dotted}: {name} is not an entry of a list of {len(inner)}; give 0 to {len(inner)}")
    if isinstance(inner, dict):
        return UsageError(f"{dotted}: it has an empty part; give a dotted key such as legitimate.link.quality")
    return UsageError(f"{dotted}: {name} is not in a table or list; give the dotted key of a scenario entry")


def value_of(text: str) -> Any:
    """A value on the command line, read as TOML, or otherwise as a string."""
    try:
        tables = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return tables["value"] if len(tables) == 1 else text


def with_event(scenario: Scenario, event: Mapping[str, Any], at: int) -> Scenario:
    """The scenario with the event added at a slot, after everything else in that slot; the event itself states no time.

    Raises ScenarioError with every mistake, worded as for the events of a file but without the new event's number.
    """
    tables = scenario.model_dump(mode="json", exclude_none=True)
    number = len(tables["event"])
    kinds = [kind for kind in EVENTS.values() if kind.by_operator]
    strange = [name for name in event if not any(name in kind.own_entries() for kind in kinds)]
    if strange:
        choices = listed([" with ".join(kind.own_entries()) for kind in kinds])
        raise ScenarioError("event", [f"{name}: cannot be done now; expected {choices}" for name in strange])
    if scenario.modules is None and any(named_in(event)):
        name = next(iter(named_in(event)))
        raise ScenarioError(
            "event", [f"set: names {name}, and the run was started without modules; expected a built-in class"]
        )
    tables["event"].append({**event, "at": at})
    try:
        # The horizon does not depend on events, and was checked when the run was started.
        return checked(tables, "event", beyond_horizon=True)
    except ScenarioError as error:
        mistakes = [line.removeprefix(f"event.{number}.") for line in error.mistakes]
        raise ScenarioError(error.source, mistakes) from None
