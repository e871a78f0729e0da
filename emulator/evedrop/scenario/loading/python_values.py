"""Values of Python as the tables of a scenario file: numpy arrays, tuples, paths, tables that were checked before, and classes.

Source: docs/python.md.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import numpy as np
from pydantic import BaseModel

from evedrop.errors import ScenarioError
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.links import LOSS_MODELS
from evedrop.model.registry import Registry
from evedrop.model.schemes import SCHEMES

_PLAIN = (str, bool, int, float)
_REGISTRIES: tuple[Registry[Any], ...] = (SCHEMES, STRATEGIES, LOSS_MODELS, DELAY_MODELS)
_MAIN = "__main__"


def plain_tables(values: Mapping[str, Any], source: str, modules: str | None = None) -> dict[str, Any]:
    """The same values as tables that a file could have, with the folder of the classes in them as `modules`.

    modules: the folder of modules, if it is known already. Entries whose value is None are left out.

    Raises ScenarioError with every value that cannot be in a scenario.
    """
    reader = _Reader()
    tables = {name: plain for name, value in values.items() if (plain := reader.plain(name, value)) is not None}
    given = tables.get("modules", modules)
    if reader.folders and not reader.mistakes and isinstance(given, (str, Path, type(None))):
        folders = dict.fromkeys(reader.folders) if given is None else {str(Path(given).absolute()): None}
        folders |= dict.fromkeys(reader.folders)
        if len(folders) > 1:
            both = " and ".join(folders)
            reader.mistakes.append(
                f"modules: the classes are in modules of several folders, {both}; put the modules into one folder"
            )
        tables["modules"] = next(iter(folders))
    if reader.mistakes:
        raise ScenarioError(source, reader.mistakes)
    return tables


@final
@dataclass
class _Reader:
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
