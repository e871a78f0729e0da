"""Scenario files: found by name or path, read, changed by dotted keys, checked.

Source: docs/scenario.md.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

from pydantic import (
    ValidationError,
)

from emulator.errors import ScenarioError, UsageError
from emulator.model.registry import place_of
from emulator.modules import named_in
from emulator.scenario.disturbances import disturbances_beside, disturbances_read
from emulator.scenario.drawn import with_faults
from emulator.scenario.dry_run import dry_run, foreign
from emulator.scenario.filter_noise import filter_noise_read
from emulator.scenario.mistakes import across_tables, sentences
from emulator.scenario.recordings import beside, read_recordings
from emulator.scenario.tables import Scenario


def shipped() -> dict[str, Path]:
    """The scenarios inside the package: name → file."""
    folder = Path(str(resources.files("scenarios")))
    return {path.stem: path for path in sorted(folder.glob("[a-z]*.toml"), key=lambda path: path.stem)}


def write_new(path: Path) -> None:
    """Write the commented scenario to start from. Raises UsageError if the file is there or cannot be written."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(Path(str(resources.files("scenarios"))).joinpath("_new.toml").read_text(encoding="utf-8"))
    except FileExistsError as error:
        raise UsageError(f"{path} is there already; give another name") from error
    except OSError as error:
        raise UsageError(f"{path} cannot be written ({error.strerror}); give another place") from error


def load(source: str | Path, changes: Mapping[str, Any] | None = None, *, beyond_horizon: bool = False) -> Scenario:
    """The scenario of a shipped name or a file, with changes by dotted key.

    beyond_horizon: allow more slots than float64 can follow exactly, for what does not follow states.

    Raises ScenarioError with every mistake, UsageError if there is no such scenario.
    """
    path = shipped().get(str(source), Path(source))
    # A shipped scenario names nothing in its folder: what a change names is in the current one.
    folder = Path() if str(source) in shipped() else path if path.is_dir() else path.parent
    return parse(read(source), str(source), changes, beyond_horizon=beyond_horizon, folder=folder)


def read(source: str | Path) -> str:
    """The text of a shipped scenario or a file."""
    path = shipped().get(str(source), Path(source))
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            raise UsageError(f"{source} is neither a file nor a folder; give a scenario's name or file")
        return path.read_text(encoding="utf-8-sig")
    except IsADirectoryError as error:
        inner = path / "scenario.toml"
        if inner.is_file():
            return inner.read_text(encoding="utf-8")
        raise UsageError(f"{source} is a folder without a scenario.toml; give a scenario's name or file") from error
    except OSError as error:
        near = difflib.get_close_matches(str(source), shipped(), 1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise UsageError(
            f"no scenario {source} ({error.strerror}); {hint}`evedrop list` shows the shipped ones"
        ) from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{source} is not text in UTF-8 ({error.reason}); a scenario is a TOML file") from error


def parse(
    text: str,
    source: str,
    changes: Mapping[str, Any] | None = None,
    *,
    beyond_horizon: bool = False,
    folder: Path = Path(),
) -> Scenario:
    """The scenario in a TOML text. Raises ScenarioError with every mistake.

    folder: where the files are that it names; those that a change names are in the current one.
    """
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, tables in tables without end
        raise ScenarioError(source, [f"not TOML: {error}"]) from error
    beside(tables, folder)
    disturbances_beside(tables, folder)
    for entry in ("secret_file", "modules"):
        if isinstance(tables.get(entry), str):
            tables[entry] = str((folder / tables[entry]).absolute())
    return checked(tables, source, changes, beyond_horizon=beyond_horizon, folder=folder)


def checked(
    tables: dict[str, Any],
    source: str,
    changes: Mapping[str, Any] | None = None,
    *,
    beyond_horizon: bool = False,
    folder: Path = Path(),
) -> Scenario:
    """The scenario that tables describe, changed, its recordings read. Raises ScenarioError with every mistake.

    folder: where modules of anybody's own are, if the tables name any and no folder of modules.
    """
    for key, value in (changes or {}).items():
        _set(tables, key, value)
    if any(named_in(tables)):
        tables.setdefault("modules", str(folder))
    if isinstance(tables.get("modules"), str):
        tables["modules"] = str(Path(tables["modules"]).absolute())
    recordings = [*read_recordings(tables), *disturbances_read(tables), *filter_noise_read(tables)]
    try:
        scenario = Scenario.model_validate(tables)
    except ValidationError as error:
        raise ScenarioError(source, [*sentences(error), *recordings, *_across(tables, beyond_horizon, None)]) from error
    mistakes = recordings + (dry_run(scenario) or _across(tables, beyond_horizon, scenario))
    if scenario.nemesis is not None:
        tables, found = with_faults(tables, scenario, sentences)
        mistakes += found
        if not mistakes:
            scenario = Scenario.model_validate(tables)
            mistakes = _across(tables, beyond_horizon, scenario)
    if mistakes:
        raise ScenarioError(source, mistakes)
    return scenario


def _across(tables: Mapping[str, Any], beyond_horizon: bool, scenario: Scenario | None) -> list[str]:
    """What only shows across tables; an error of somebody's class that is asked on the way is a mistake too."""
    try:
        return across_tables(tables, beyond_horizon, scenario)
    except Exception as error:
        if not foreign(tables):
            raise
        return [f"modules: a class raised {place_of(error)} when it was asked about itself; expected no error"]


def _set(tables: dict[str, Any], dotted: str, value: Any) -> None:
    """Put a value at a dotted key: names of tables that may be new, and numbers of list entries, the next one included."""
    names = dotted.split(".")
    inner: Any = tables
    for name, after in pairwise(names):
        new: Any = [] if after == "0" else {}
        if isinstance(inner, dict) and name:
            inner = inner.setdefault(name, new)
        elif isinstance(inner, list) and name.isdecimal() and int(name) <= len(inner):
            if int(name) == len(inner):
                inner.append(new)
            inner = inner[int(name)]
        else:
            raise _no_such_key(dotted, name, inner)
    last = names[-1]
    if isinstance(inner, dict) and last:
        inner[last] = value
    elif isinstance(inner, list) and last.isdecimal() and int(last) <= len(inner):
        inner[int(last) : int(last) + 1] = [value]
    else:
        raise _no_such_key(dotted, last, inner)


def _no_such_key(dotted: str, name: str, inner: Any) -> UsageError:
    if isinstance(inner, list):
        return UsageError(f"--set {dotted}: {name} is no entry of a list of {len(inner)}; give 0 to {len(inner)}")
    if isinstance(inner, dict):
        return UsageError(f"--set {dotted}: it has an empty part; give a dotted key such as legitimate.link.quality")
    return UsageError(f"--set {dotted}: {name} is not in a table or list; give the dotted key of a scenario entry")


def value_of(text: str) -> Any:
    """A value on the command line: as TOML, else as a string."""
    try:
        tables = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return tables["value"] if len(tables) == 1 else text
