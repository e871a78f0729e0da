"""Users' own modules: finds those that a scenario or a brief names, and makes their folder importable.

The processes of a run import these modules for the classes in them. No other file of the folder is imported, unless a named
module imports it.

Source: docs/your-own/overview.md.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from hashlib import sha256
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from pathlib import Path
from typing import Any, final

from evedrop.model.eavesdroppers import REMOTE_CALLS
from evedrop.model.registry import is_own

_TRUSTED = ("scheme", "model")
_ENTRIES = (*_TRUSTED, "strategy", "reads_as")
"""The entries of tables that name a class."""


def names_in(tables: Any, entries: tuple[str, ...] = _ENTRIES) -> Iterator[str]:
    """Every class name in these entries of tables, at any depth, in order; whether the class exists or not."""
    if isinstance(tables, Mapping):
        for entry, inner in tables.items():
            if entry in entries and isinstance(inner, str):
                yield inner
            elif isinstance(inner, (Mapping, list, tuple)):
                yield from names_in(inner, entries)
    elif isinstance(tables, (list, tuple)):
        for inner in tables:
            if isinstance(inner, (dict, Mapping, list, tuple)):
                yield from names_in(inner, entries)


def named_in(tables: Any) -> Iterator[str]:
    """Every class name of the form PACKAGE.MODULE:CLASS in tables."""
    return (name for name in names_in(tables) if is_own(name))


def trusted_in(tables: Any) -> Iterator[str]:
    """Those names of schemes and links, whose classes hold the secret or see all packets; not those of eavesdroppers."""
    return (name for name in names_in(tables, _TRUSTED) if is_own(name))


def sources_of(tables: Any) -> dict[str, str]:
    """`module NAME` → `sha256 …` of its file, for every module that tables name and that can be found. Imports none of them."""
    sources = {}
    folder = tables.get("modules") if isinstance(tables, Mapping) else None
    for name in named_in(tables):
        module = name.partition(":")[0]
        file = getattr(sys.modules.get(module), "__file__", None) or _file_of(module, folder)
        if file is not None and Path(file).is_file():
            sources[f"module {module}"] = f"sha256 {sha256(Path(file).read_bytes()).hexdigest()}"
    return sources


def _file_of(module: str, folder: str | None) -> str | None:
    """The path of a module's file, found without importing the module."""
    top, *inner = module.split(".")
    spec = _installed(top) or PathFinder.find_spec(top, [folder] if folder is not None else [])
    for name in inner:
        if spec is None:
            return None
        spec = PathFinder.find_spec(f"{spec.name}.{name}", spec.submodule_search_locations or [])
    return None if spec is None else spec.origin


def _installed(top: str) -> ModuleSpec | None:
    """The spec of a top-level module on `sys.path`, or None."""
    with suppress(ValueError):  # raised for __main__ and the like
        return find_spec(top)
    return None


@final
class _Folder(str):
    """A folder that `look_in` has put on `sys.path`."""

    __slots__ = ()


def look_in(folder: str) -> None:
    """Put a folder on `sys.path`, after everything installed and before the folders that this function put there earlier.

    So its modules cannot replace a module of Evedrop, of Python or of a library.
    """
    if folder not in sys.path:
        first = next((i for i, place in enumerate(sys.path) if isinstance(place, _Folder)), len(sys.path))
        sys.path.insert(first, _Folder(folder))
    importlib.invalidate_caches()


def elsewhere(folder: str, tables: Any) -> Iterator[str]:
    """A sentence for every module that tables name and that is in this folder, but that this process would find elsewhere."""
    for name in dict.fromkeys(named_in(tables)):
        top = name.partition(":")[0].partition(".")[0]
        there = PathFinder.find_spec(top, [folder])
        asked_in = REMOTE_CALLS.folder_of(name)
        spec = getattr(sys.modules.get(top), "__spec__", None)
        if spec is None and asked_in is not None:
            spec = PathFinder.find_spec(top, [asked_in])
        if there is None:
            continue
        if spec is not None and _home(there) != _home(spec):
            yield (
                f"has a module {top} ({_home(there)}), and another one of this name is loaded already "
                f"({_home(spec)}); give one of them another name"
            )
            continue
        installed = None if spec is not None else _installed(top)
        if installed is not None and _home(there) != _home(installed) and not _put_there(installed):
            yield (
                f"has a module {top} ({_home(there)}), and another one of this name is installed ({_home(installed)}); "
                "give it another name"
            )


def _put_there(spec: ModuleSpec) -> bool:
    """Whether a module is in a folder that `look_in` put on `sys.path`: not loaded yet, it gives way to one in a newer folder."""
    return any(
        isinstance(place, _Folder) and _home(spec).startswith(f"{Path(place).resolve()}{os.sep}") for place in sys.path
    )


def _home(spec: ModuleSpec) -> str:
    """The file of a module, or the folders of a package without one."""
    if spec.origin is not None:
        return str(Path(spec.origin).resolve()) if Path(spec.origin).is_absolute() else spec.origin
    return ", ".join(spec.submodule_search_locations or ())
