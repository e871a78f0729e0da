"""Scenarios are made here: from a file, found by name or path, or in Python; changed by dotted keys, and checked.

A scenario from Python has the same checks as one from a file, and the same messages: numpy arrays, tuples, paths, tables that
were checked before, and classes become the tables of a file. Mistakes are reported together.

Source: docs/scenario.md; docs/python.md.
"""

from __future__ import annotations

import math
import re
import sys
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, final

import numpy as np
from pydantic import BaseModel, ValidationError

from evedrop.errors import NoAnswer, ScenarioError, UsageError
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.links import LOSS_MODELS
from evedrop.model.registry import CLASS_ERRORS, Registry, place_of
from evedrop.model.schemes import SCHEMES
from evedrop.scenario.across import mistakes_across
from evedrop.scenario.arguments import path_argument
from evedrop.scenario.drawn import with_faults
from evedrop.scenario.dry_run import dry_run, has_foreign
from evedrop.scenario.events import EVENTS
from evedrop.scenario.input_files import locate_recordings, locate_tables, read_recordings, read_tables
from evedrop.scenario.line_numbers import excerpt, given_twice, with_line_numbers
from evedrop.scenario.plugins import elsewhere, named_in
from evedrop.scenario.process_noise import replace_filter_noise
from evedrop.scenario.receivers import SHORT_FORMS
from evedrop.scenario.stream_keys import secret_in
from evedrop.scenario.table import sentences, unusable
from evedrop.scenario.tables import Builders
from evedrop.scenario.tables import Scenario as Scenario  # noqa: PLC0414 - exported with its builders, which are set here
from evedrop.scenario.theory import expectations_of
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
_REMOVED: Any = object()
"""An entry of a list that is removed, until all other changes are made."""
# Python's TOML reader takes time that grows with the square of the number of a key's parts.
_PART = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+"""
_DOTTED = re.compile(rf"""(?<![A-Za-z0-9_"'.-])(?:{_PART}){{{_MOST_DOTS}}}""")


def load(
    source: str | Path,
    changes: Mapping[str, Any] | None = None,
    *,
    beyond_horizon: bool = False,
    without: Collection[str] = (),
) -> Scenario:
    """Load a built-in scenario by name, or a file, with changes by dotted key.

    beyond_horizon: allow more slots than float64 can follow exactly, for commands that do not follow states; without: entries
    to leave out, by dotted key.

    Raises ScenarioError with every mistake, UsageError if there is no such scenario.
    """
    path = shipped().get(str(source), Path(source))
    # A built-in scenario names no files of its own, so the names in a change refer to the current folder.
    folder = Path() if str(source) in shipped() else path if is_folder(path) else path.parent
    text = read(source)
    return parse(text, shown(source), changes, beyond_horizon=beyond_horizon, folder=folder, without=without)


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
    without: Collection[str] = (),
) -> Scenario:
    """The scenario in a TOML text. Raises ScenarioError with every mistake.

    folder: where the files are that the text names; files that a change names are in the current folder.
    """
    tables = tables_in(text, source)
    if not tables and not changes:
        raise ScenarioError(source, ["has no entries; `evedrop new FILE` writes a scenario to start from"])
    locate_files(tables, folder)
    renumbered = [above for above, _, last in (key.rpartition(".") for key in without) if last.isdecimal()]
    with with_line_numbers(text, [*(changes or ()), *renumbered]):
        return checked(tables, source, changes, beyond_horizon=beyond_horizon, folder=folder, without=without)


def locate_files(tables: dict[str, Any], folder: Path) -> None:
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
        raise _no_toml(source, text, error) from None
    if mistakes := list(unusable(tables)):
        raise ScenarioError(source, mistakes)
    return tables


_PLACE = re.compile(r"\(at line (\d+), column (\d+)\)")


def _no_toml(source: str, text: str, error: Exception) -> ScenarioError:
    """The error that says why a text is not TOML, with the line and a caret if the place is known."""
    place, problem, where = _PLACE.search(str(error)), str(error), ""
    if place is not None:
        line, column = int(place[1]), int(place[2])
        where = excerpt(text.split("\n")[line - 1], line, column=column - 1)
        if problem.startswith(_TWICE):
            problem = given_twice(text, line) or problem
    return ScenarioError(source, [f"not TOML: {problem}"], [where])


def checked(
    tables: dict[str, Any],
    source: str,
    changes: Mapping[str, Any] | None = None,
    *,
    beyond_horizon: bool = False,
    folder: Path = Path(),
    without: Collection[str] = (),
) -> Scenario:
    """The scenario that tables describe, with changes made and recordings read. Raises ScenarioError with every mistake.

    folder: where custom modules are, if the tables name any and name no folder of modules; without: as for `load`.
    """
    shortened = _remove(tables, without)
    for key, value in (changes or {}).items():
        set_entry(tables, key, value)
    for entries in shortened:
        entries[:] = [entry for entry in entries if entry is not _REMOVED]
    if changes and (wrong := list(unusable(tables))):
        raise ScenarioError(source, wrong)
    if any(named_in(tables)):
        tables.setdefault("modules", str(folder))
    mistakes = [*read_recordings(tables), *read_tables(tables), *replace_filter_noise(tables)]
    if isinstance(tables.get("secret_file"), str):
        try:
            secret_in(tables["secret_file"])
            tables["secret_file"] = str(Path(tables["secret_file"]).absolute())
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
    foreign = has_foreign(scenario)
    try:
        mistakes = mistakes_across(scenario, beyond_horizon)
    except CLASS_ERRORS as error:
        if not foreign:
            raise
        if silent:
            return []
        return [f"modules: a class raised {place_of(error)} when it was asked about itself; expected no error"]
    return mistakes if mistakes or silent or not foreign else _untold(scenario)


def _untold(scenario: Scenario) -> list[str]:
    """Mistakes of classes that are not built in which only show when theory asks about all slots and links of this scenario."""
    try:
        for name, expectation in expectations_of(scenario).items():
            traces = expectation.traces(scenario.slots)
            if not isinstance(traces, np.ndarray) or traces.shape != (scenario.slots,):
                raise NoAnswer(f"the closed form of {name} has not one trace for each of the {scenario.slots} slots")
            math.isinf(expectation.limit)
    except CLASS_ERRORS as error:
        return [f"modules: theory cannot ask a class: {place_of(error)}; expected no error, or None: no closed form"]
    return []


def set_entry(tables: dict[str, Any], dotted: str, value: Any) -> None:
    """Put a value at a dotted key; a link's `quality` replaces its `loss`, and the other way round.

    Tables may be new; list entries are given by number, including the next one.
    """
    names = dotted.split(".")
    inner: Any = tables
    for i, name in enumerate(names):
        last = i == len(names) - 1
        new = _copied(value) if last else [] if names[i + 1] == "0" else {}
        if isinstance(inner, dict) and name:
            _drop_other_form(inner, names[: i + 1])
            if last or name not in inner:
                inner[name] = new
            inner = inner[name]
        elif isinstance(inner, list) and name.isdecimal() and int(name) <= len(inner):
            if last or int(name) == len(inner) or inner[int(name)] is _REMOVED:
                inner[int(name) : int(name) + 1] = [new]
            inner = inner[int(name)]
        else:
            raise _no_such_key(dotted, name, inner)


def _copied(value: Any) -> Any:
    """A value whose tables and lists later changes may change: it may be set in other tables, too."""
    if isinstance(value, dict):
        return {name: _copied(entry) for name, entry in value.items()}
    return [_copied(entry) for entry in value] if isinstance(value, list) else value


def _drop_other_form(table: dict[str, Any], names: list[str]) -> None:
    """Remove the other form of an entry of a link, or of a change of one, in place; names: the path of the entry."""
    tables, other = [name for name in names[:-1] if not name.isdecimal()], SHORT_FORMS.get(names[-1])
    if other is not None and tables and tables[-1] in ("link", "links", "set"):
        table.pop(other, None)


def undoes(later: str, earlier: str) -> bool:
    """Whether `set_entry` with one dotted key removes what it has put at another one before."""
    names, parts = earlier.split("."), later.split(".")
    other_forms = [[*names[:i], SHORT_FORMS[name]] for i, name in enumerate(names) if name in SHORT_FORMS]
    return names[: len(parts)] == parts or any(parts[: len(gone)] == gone for gone in other_forms)


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
    # The secret does not depend on events, and its file need not be on this host.
    tables = scenario.model_dump(mode="json", exclude_none=True, exclude={"secret_file"})
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
    if wrong := list(unusable({**event})):
        raise ScenarioError("event", wrong)
    tables["event"].append({**plain_tables(event, "event"), "at": at})
    try:
        # The horizon does not depend on events, and was checked when the run was started.
        changed = checked(tables, "event", beyond_horizon=True)
    except ScenarioError as error:
        mistakes = [line.removeprefix(f"event.{number}.") for line in error.mistakes]
        raise ScenarioError(error.source, mistakes) from None
    if scenario.secret_file is None:
        return changed
    return changed.model_copy(update={"secret_file": scenario.secret_file})


_PLAIN = (str, bool, int, float)
_REGISTRIES: tuple[Registry[Any], ...] = (SCHEMES, STRATEGIES, LOSS_MODELS, DELAY_MODELS)
_MAIN = "__main__"


def plain_tables(values: Mapping[str, Any], source: str, modules: str | None = None) -> dict[str, Any]:
    """The same values as tables that a file could have, with the folder of the classes in them as `modules`.

    modules: the folder of modules, if it is known already. Entries whose value is None are left out.

    Raises ScenarioError with every value that cannot be in a scenario.
    """
    plain_tables = _PlainTables()
    tables = {name: plain for name, value in values.items() if (plain := plain_tables.plain(name, value)) is not None}
    given = tables.get("modules", modules)
    if plain_tables.folders and not plain_tables.mistakes and isinstance(given, (str, Path, type(None))):
        named = [] if given is None else [str(Path(given).absolute())]
        folders = dict.fromkeys([*named, *plain_tables.folders])
        if len(folders) > 1:
            both = " and ".join(folders)
            plain_tables.mistakes.append(
                f"modules: the classes are in modules of several folders, {both}; put the modules into one folder"
            )
        tables["modules"] = next(iter(folders))
    if plain_tables.mistakes:
        raise ScenarioError(source, plain_tables.mistakes)
    return tables


@final
@dataclass
class _PlainTables:
    mistakes: list[str] = field(default_factory=list)
    folders: list[str] = field(default_factory=list)
    """The folders of the modules in which classes are."""

    def plain(self, path: str, value: Any) -> Any:
        """One value; None leaves out its entry."""
        made: Any
        if value is None or type(value) in _PLAIN:
            made = value
        elif isinstance(value, BaseModel):
            made = value.model_dump(mode="json", exclude_none=True, exclude_unset=True)
        elif isinstance(value, Mapping):
            inner = {name: self.plain(f"{path}.{name}", entry) for name, entry in value.items()}
            made = {name: entry for name, entry in inner.items() if entry is not None}
        elif isinstance(value, (list, tuple, range)):
            made = [self.plain(f"{path}.{i}", entry) for i, entry in enumerate(value)]
        elif isinstance(value, (Path, str)):  # strings of numpy, and members of an enumeration
            made = str(value)
        elif isinstance(value, type):
            made = self._name(path, value)
        elif hasattr(value, "__array__"):  # arrays and numbers of numpy, and what numpy can read, such as tensors
            made = self._numbers(path, value)
        else:
            made = None
            self._refuse(path, value)
        return made

    def _numbers(self, path: str, value: Any) -> Any:
        array = np.asarray(value)
        if array.dtype.kind in "biufU":
            return array.tolist()
        self._refuse(path, value, f" of {array.dtype}")
        return None

    def _refuse(self, path: str, value: Any, of: str = "") -> None:
        kind = f"{type(value).__module__}.{type(value).__name__}".removeprefix("builtins.")
        wanted = "a number, a text, a list, a dict, a numpy array of numbers, or a class"
        self.mistakes.append(f"{path}: is a {kind}{of}; expected {wanted}")

    def _name(self, path: str, kind: type) -> str | None:
        """The name of a class in a scenario: that of a built-in one, or MODULE:CLASS."""
        for registry in _REGISTRIES:
            for name in registry:
                if registry[name] is kind:
                    return name
        why = _not_importable(kind)
        if why is not None:
            self.mistakes.append(f"{path}: is the class {kind.__name__} {why}")
            return None
        folder = _folder_of(kind)
        if folder is not None:
            self.folders.append(folder)
        return f"{kind.__module__}:{kind.__name__}"


def _not_importable(kind: type) -> str | None:
    """Why other processes cannot import a class, in words that follow its name; None if they can."""
    if kind.__module__ == _MAIN:
        return (
            "of a notebook or of the program itself, which the processes of a run cannot import; write it to a file, such "
            f"as mine.py (in a notebook: %%writefile mine.py at the top of its cell), then: from mine import {kind.__name__}"
        )
    if getattr(sys.modules.get(kind.__module__), kind.__name__, None) is not kind:
        return (
            f"of {kind.__module__}, which the processes of a run cannot import by its name; define it at the top level "
            "of a module, and make the scenario with the class as it is in the module now"
        )
    return None


def _folder_of(kind: type) -> str | None:
    """The folder in which the module of a class is looked for; None if the module has no file."""
    file = getattr(sys.modules[kind.__module__], "__file__", None)
    if file is None:
        return None
    depth = kind.__module__.count(".") + (Path(file).stem == "__init__")
    return str(Path(file).absolute().parents[depth])


_SOURCE = "Scenario"


def built(values: Mapping[str, Any]) -> Scenario:
    """The scenario with these entries; files that it names are in the current folder.

    Whether double precision can follow the process for that many slots is checked when the scenario is used.

    Raises ScenarioError with every mistake.
    """
    tables = plain_tables(values, _SOURCE)
    if mistakes := list(unusable(tables)):
        raise ScenarioError(_SOURCE, mistakes)
    locate_files(tables, Path())
    return checked(tables, _SOURCE, beyond_horizon=True)


def prepared(scenario: str | Path | Scenario, changes: Mapping[str, Any], *, beyond_horizon: bool = False) -> Scenario:
    """The scenario that a call is about, with changes by dotted key, checked as `load` does; None removes an entry.

    beyond_horizon: as for `load`.

    Raises ScenarioError with every mistake, UsageError for what is neither a Scenario nor the name of one.
    """
    if isinstance(scenario, Scenario):
        return changed(scenario, changes, beyond_horizon=beyond_horizon)
    path_argument(
        "scenario", scenario, "a built-in name, a file, or a Scenario, which Scenario(entries) makes of a dict"
    )
    made, without = plain_tables(changes, str(scenario)), _without_value(changes)
    return load(scenario, made, beyond_horizon=beyond_horizon, without=without)


def changed(scenario: Scenario, changes: Mapping[str, Any], *, beyond_horizon: bool = True) -> Scenario:
    """The scenario with changes by dotted key; None removes an entry. Raises ScenarioError with every mistake."""
    made, without = plain_tables(changes, scenario.title, scenario.modules), _without_value(changes)
    return checked(scenario.as_tables(), scenario.title, made, beyond_horizon=beyond_horizon, without=without)


def _without_value(changes: Mapping[str, Any]) -> list[str]:
    """The keys of the entries that changes remove."""
    return [key for key, value in changes.items() if value is None]


def _remove(tables: dict[str, Any], keys: Collection[str]) -> list[list[Any]]:
    """Remove entries by dotted key, in place, those of lists by number; those that are not there, too.

    The lists that it returns have `_REMOVED` in place of entries, so that the others keep their numbers until it is taken out.
    """
    shortened = []
    for key in keys:
        *above, last = key.split(".")
        inner: Any = tables
        for name in above:
            inner = _entry(inner, name)
        if isinstance(inner, dict):
            inner.pop(last, None)
        elif _entry(inner, last) is not None:
            inner[int(last)] = _REMOVED
            shortened.append(inner)
    return shortened


def _entry(table: Any, name: str) -> Any:
    """An entry of a table, or of a list by its number; None if it is not there."""
    if isinstance(table, list):
        return table[int(name)] if name.isdecimal() and int(name) < len(table) else None
    return table.get(name) if isinstance(table, dict) else None


Scenario.builders = Builders(built, partial(prepared, beyond_horizon=True), changed)
