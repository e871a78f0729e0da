"""Modules of anybody's own: which ones a scenario or a brief names, and the folder in which they are looked for first.

A class in such a module is code that every process of a run imports; nothing is imported but what somebody has named.

Source: docs/your-own.md.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Mapping
from hashlib import sha256
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

from emulator.model.registry import is_own

_ENTRIES = ("scheme", "strategy", "reads_as", "model")
"""Entries, of any table, that name a class."""


def names_in(tables: Any) -> Iterator[str]:
    """Every name of a class that tables give, in their order, whatever it stands for."""
    if isinstance(tables, Mapping):
        for entry, inner in tables.items():
            if entry in _ENTRIES and isinstance(inner, str):
                yield inner
            elif isinstance(inner, (Mapping, list, tuple)):
                yield from names_in(inner)
    elif isinstance(tables, (list, tuple)):
        for inner in tables:
            if isinstance(inner, (dict, Mapping, list, tuple)):
                yield from names_in(inner)


def named_in(tables: Any) -> Iterator[str]:
    """Every PACKAGE.MODULE:CLASS among them."""
    return (name for name in names_in(tables) if is_own(name))


def sources_of(tables: Any) -> dict[str, str]:
    """`module NAME` → the SHA-256 of its file, of every module that tables name and that is imported."""
    found = {}
    for name in named_in(tables):
        module = name.partition(":")[0]
        file = getattr(sys.modules.get(module), "__file__", None)
        if file is not None and Path(file).is_file():
            found[f"module {module}"] = f"sha256 {sha256(Path(file).read_bytes()).hexdigest()}"
    return found


def look_in(folder: str) -> None:
    """Have modules looked for in this folder before all others, as Python does with the folder of a script."""
    if sys.path[:1] != [folder]:
        sys.path[:] = [folder, *(one for one in sys.path if one != folder)]
    importlib.invalidate_caches()


def elsewhere(folder: str, tables: Any) -> Iterator[str]:
    """A sentence for every module that tables name, that is in this folder, and that this process has from another place."""
    for top in dict.fromkeys(name.partition(":")[0].partition(".")[0] for name in named_in(tables)):
        there = PathFinder.find_spec(top, [folder])
        loaded = getattr(sys.modules.get(top), "__spec__", None)
        if there is not None and loaded is not None and _home(there) != _home(loaded):
            yield (
                f"has a module {top} ({_home(there)}), and another one of this name is loaded already "
                f"({_home(loaded)}); give one of them another name"
            )


def _home(spec: ModuleSpec) -> str:
    """Where a module or a package is."""
    if spec.origin is not None:
        return str(Path(spec.origin).resolve()) if Path(spec.origin).is_absolute() else spec.origin
    return ", ".join(spec.submodule_search_locations or ())
