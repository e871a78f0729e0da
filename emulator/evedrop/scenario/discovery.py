"""Finds scenario files. Every TOML file of a folder is examined, so this reads as little as possible and imports little.

Source: docs/testing.md.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

from evedrop.system.files import Unreadable, contents

_HEADINGS = tuple(re.compile(rf"^\s*\[{name}\]", re.MULTILINE) for name in ("process", "encoding"))
_MOST_BYTES = 2**28  # as for every scenario
OF_RESULTS = ("summary.json", "slots.parquet", "unfinished", "shards", "sweep.json", "compare.json", "finished_tasks")
"""Files and folders that show that a folder is a results folder, of a study in progress, too."""


def is_scenario(path: Path) -> bool:
    """Whether a file looks like a user's scenario: TOML with the tables `process` and `encoding`.

    False for a name that begins with an underscore, and for the copies in a results folder. True for a file that is not
    valid TOML, or not in UTF-8, but has both headings: a scenario with a mistake to report.
    """
    if path.suffix != ".toml" or path.name.startswith("_") or _is_copy(path):
        return False
    try:
        content = contents(path, _MOST_BYTES)
    except Unreadable:
        return False
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:  # in Latin-1, or in UTF-16 as some editors of Windows save it: `load` says what is wrong
        text = content.replace(b"\0", b"").decode("latin-1")
        return all(heading.search(text) for heading in _HEADINGS)
    if "process" not in text or "encoding" not in text:
        return False
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError):
        return all(heading.search(text) for heading in _HEADINGS)
    return all(isinstance(tables.get(name), dict) for name in ("process", "encoding"))


def _is_copy(path: Path) -> bool:
    if path.name == "scenario.toml" and any(path.with_name(name).exists() for name in OF_RESULTS):
        return True
    return path.parent.name == "scenarios" and (path.parent.parent / "compare.json").exists()


def scenarios_in(folder: Path) -> Iterator[Path]:
    """The scenarios in a folder and its subfolders, in order of their names; hidden folders are left out."""
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        yield from (path for name in sorted(files) if is_scenario(path := Path(place) / name))
