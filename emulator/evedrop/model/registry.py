"""Classes by their name in a scenario: built in, of an installed package, or custom, named PACKAGE.MODULE:CLASS.

Source: docs/your-own/overview.md.
"""

from __future__ import annotations

import importlib
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar, final

from evedrop.errors import NoAnswer, NotRegistered
from evedrop.system.hints import near

T = TypeVar("T")

_OWN = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")
_NOT_IN_CHILDREN = "__main__"
_NO_MODULES: ContextVar[bool] = ContextVar("no_modules", default=False)


@contextmanager
def no_modules() -> Iterator[None]:
    """In the block no registry imports PACKAGE.MODULE:CLASS, or asks it anything: such a name raises NotRegistered."""
    before = _NO_MODULES.set(True)
    try:
        yield
    finally:
        _NO_MODULES.reset(before)


def is_own(name: object) -> bool:
    """Whether a name has the form MODULE:CLASS, rather than being a registered name."""
    return isinstance(name, str) and ":" in name


CLASS_ERRORS = (Exception, SystemExit)
"""What a class that is not built in may raise, instead of doing what it is asked for; also if it means to end the interpreter."""


def place_of(error: BaseException, file: str | None = None) -> str:
    """A short description of an error in a custom module: the error, and the last line of that file, or of any, before it."""
    if isinstance(error, NoAnswer):
        return str(error)
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if frame.filename == file] or [
        frame for frame in frames if "importlib" not in frame.filename and frame.filename != __file__
    ]
    if isinstance(error, SyntaxError) and error.filename:
        where = f", {Path(error.filename).name} line {error.lineno}"
        return f"{type(error).__name__}: {error.msg}{where}"
    where = f", {Path(own[-1].filename).name} line {own[-1].lineno}" if own else ""
    message = " ".join(str(error).split())
    return f"{type(error).__name__}: {message}{where}" if message else f"{type(error).__name__}{where}"


def asked(model: Any, given: Mapping[str, Any]) -> list[tuple[str, str]]:
    """A class's own mistakes in the given parameters, as (entry, sentence); the class may be custom."""
    return answered(model, next(iter(given), "parameters"), lambda: model.mistakes(given))


def answered(model: Any, entry: str, ask: Callable[[], Any]) -> list[tuple[str, str]]:
    """The mistakes that a class finds itself when asked; entry: where it is reported that a custom class cannot answer."""
    wanted = "expected it to return a list of (entry, what is wrong)"
    try:
        answer = ask()
    except CLASS_ERRORS as error:
        file = getattr(sys.modules.get(model.__module__), "__file__", None)
        return [(entry, f"cannot be checked: {model.__name__}.mistakes raised {place_of(error, file)}; {wanted}")]
    if not isinstance(answer, list) or not all(isinstance(mistake, tuple) and len(mistake) == 2 for mistake in answer):
        return [(entry, f"cannot be checked: {model.__name__}.mistakes returned {answer!r}; {wanted}")]
    return [(str(name), str(sentence)) for name, sentence in answer]


@final
class Registry(Mapping[str, type[T]], Generic[T]):
    """Name → class, for one kind of class. Iteration covers only the built-in classes; any other can be looked up.

    kind: its name in messages; base: the base class; group: the entry points of installed packages; reserved: entries that a
    scenario's table has besides the class's parameters; remote_class: makes the remote class of one that is not built in, which
    is itself loaded only by `imported`.

    `[name]` raises NotRegistered, which is a KeyError.
    """

    def __init__(
        self,
        kind: str,
        base: type[T],
        group: str,
        built_in: Mapping[str, type[T]],
        reserved: tuple[str, ...] = (),
        remote_class: Callable[[str], type[T]] | None = None,
    ) -> None:
        self.kind, self.base, self.group = kind, base, group
        self._remote_class = remote_class
        self._built_in = built_in
        self._reserved = reserved

    def __iter__(self) -> Iterator[str]:
        return iter(self._built_in)

    def __len__(self) -> int:
        return len(self._built_in)

    def __getitem__(self, name: str) -> type[T]:
        if name in self._built_in or self._remote_class is None:
            return self.imported(name)
        self._target(name)
        return self._with_free_parameters(name, self._remote_class(name), "")

    def imported(self, name: str) -> type[T]:
        """The class itself, imported into this process with its module. Raises NotRegistered."""
        if name in self._built_in:
            return self._built_in[name]
        target, origin = self._target(name)
        return self._checked(name, *_imported(name, target, origin))

    def foreign(self, name: str) -> bool:
        """Whether a class of this name would not be built in; the class need not exist."""
        return name not in self._built_in

    @property
    def names(self) -> list[str]:
        """All short names: of built-in classes and of those in installed packages."""
        return sorted({*self._built_in, *_entry_points(self.group, tuple(sys.path))})

    def _target(self, name: str) -> tuple[str, str]:
        """The PACKAGE.MODULE:CLASS that a name stands for, and the beginning of messages about it."""
        if is_own(name):
            if _NO_MODULES.get():
                raise NotRegistered(name, ", and results are only looked at; expected a name without a module")
            return _importable(name, name, ""), ""
        targets = _entry_points(self.group, tuple(sys.path)).get(name, ())
        if not targets:
            raise NotRegistered(name)
        if len(targets) > 1:
            both = " and ".join(targets)
            raise NotRegistered(name, f", a name that two installed packages use; expected one of {both} itself")
        origin = f", which an installed package says is {targets[0]}"
        return _importable(name, targets[0], origin), origin

    def _checked(self, name: str, kind: Any, origin: str) -> type[T]:
        wanted = f"a class that inherits from evedrop.extend.{self.base.__name__}"
        if not isinstance(kind, type) or not issubclass(kind, self.base):
            raise NotRegistered(name, f"{origin}, which is not a {self.base.__name__}; expected {wanted}")
        lacking = sorted(getattr(kind, "__abstractmethods__", ()))
        if lacking:
            # The class that its author inherited from describes more than the base of all of this kind.
            ours = next((parent for parent in kind.__mro__ if parent.__module__.startswith("evedrop.")), self.base)
            these, them = ("these methods", "them") if len(lacking) > 1 else ("this method", "it")
            raise NotRegistered(
                name,
                f"{origin}, which lacks {', '.join(lacking)}; expected a class with {these}, as "
                f"evedrop.extend.{ours.__name__} describes {them}",
            )
        parameters = getattr(kind, "parameters", {})
        if not isinstance(parameters, Mapping) or not all(isinstance(parent, str) for parent in parameters):
            raise NotRegistered(
                name,
                f"{origin}, whose parameters are not a table; expected the entries it takes, each with an example, "
                'such as parameters = {"threshold": 3}',
            )
        return self._with_free_parameters(name, kind, origin)

    def _with_free_parameters(self, name: str, kind: type[T], origin: str) -> type[T]:
        taken = sorted(set(getattr(kind, "parameters", ())) & set(self._reserved))
        if taken:
            raise NotRegistered(
                name, f"{origin}, one of whose parameters is called {taken[0]}, as an entry of every {self.kind} is"
            )
        return kind


def _importable(name: str, target: str, origin: str) -> str:
    """The PACKAGE.MODULE:CLASS, if every process can import it. Raises NotRegistered otherwise."""
    if not _OWN.fullmatch(target):
        raise NotRegistered(name, f"{origin}; expected PACKAGE.MODULE:CLASS, such as mine:Masked")
    if target.partition(":")[0] == _NOT_IN_CHILDREN:
        raise NotRegistered(
            name, f"{origin}, which other processes cannot import; expected a class in a module, a file of its own"
        )
    return target


def _imported(name: str, target: str, origin: str) -> tuple[Any, str]:
    module_name, _, class_name = target.partition(":")
    try:
        module = importlib.import_module(module_name)
    except CLASS_ERRORS as error:
        missing = isinstance(error, ModuleNotFoundError) and module_name.startswith(str(error.name))
        wanted = (
            "a module in the scenario's folder (or in its `modules`), or an installed one"
            if missing
            else "one that can be imported"
        )
        reason = str(error) if missing else place_of(error)
        raise NotRegistered(
            name, f"{origin}, and the module {module_name} cannot be imported ({reason}); expected {wanted}"
        ) from error
    kind = getattr(module, class_name, None)
    if kind is None:
        there = [
            candidate
            for candidate, value in vars(module).items()
            if isinstance(value, type) and value.__module__ == module_name
        ]
        choice = near(class_name, there, f"{module_name}:") or f"; expected one of {', '.join(there) or 'none'}"
        file = getattr(module, "__file__", None)
        where = f" ({file})" if file else ""
        raise NotRegistered(name, f"{origin}, and the module {module_name}{where} has no {class_name}{choice}")
    return kind, origin


@lru_cache(maxsize=32)
def _entry_points(group: str, path: tuple[str, ...]) -> Mapping[str, tuple[str, ...]]:
    """Name → targets of the entry points of this name; path: `sys.path`, part of the cache's key."""
    del path
    from importlib import metadata  # noqa: PLC0415 - a process that needs no entry points starts faster

    values_of: dict[str, set[str]] = {}
    for point in metadata.entry_points(group=group):
        values_of.setdefault(point.name, set()).add(point.value)
    return {name: tuple(sorted(values)) for name, values in values_of.items()}
