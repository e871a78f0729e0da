"""The base class of all tables of a scenario file: each entry is checked by itself, then the table as a whole."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Annotated, Any, Self, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    model_validator,
)
from pydantic_core import PydanticCustomError

from evedrop.errors import NotRegistered
from evedrop.model.registry import Registry, asked
from evedrop.names import RESERVED
from evedrop.scenario.words import as_toml, listed
from evedrop.system.hints import near

NAME = re.compile(r"[a-z][a-z0-9_-]{0,31}")


def expected(words: str, hint: str = "") -> PydanticCustomError:
    """The error about one value, to be raised in a check. words: the expected value; hint: what to add, such as a similar name.

    The message also says what was found.
    """
    return PydanticCustomError("expected", "one value", {"expected": words, "hint": hint})


def _probability(value: float) -> float:
    if not 0.0 <= value <= 1.0:
        raise expected("a number from 0 to 1")
    return value


def one_of(names: Iterable[str]) -> Callable[[str], str]:
    """A check that a value is one of the names."""

    def check(value: str) -> str:
        if value not in names:
            raise expected(listed(sorted(names)), near(value, names))
        return value

    return check


def registered(classes: Registry[Any]) -> Callable[[str], str]:
    """A check that a value is the name of a registered class."""

    def check(value: str) -> str:
        why = _no_class(value, classes)
        if why is None:
            return value
        if why:
            raise PydanticCustomError("expected", "one value", {"said": why})
        raise expected(listed(classes.names), near(value, classes.names))

    return check


def _no_class(name: Any, classes: Registry[Any]) -> str | None:
    """Why no class has this name, in words that follow `is NAME`; empty if the name is just unknown; None if a class has it."""
    try:
        classes[str(name)]
    except NotRegistered as error:
        return error.why
    return None


def _process_name(name: str) -> str:
    if name in RESERVED:
        raise expected(f"any name but {listed(RESERVED)}, which are reserved")
    if not NAME.fullmatch(name):
        raise expected("a name of a lower-case letter, then up to 31 of a-z 0-9 _ -")
    return name


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Probability = Annotated[float, Field(strict=True), AfterValidator(_probability)]
ProcessName = Annotated[str, AfterValidator(_process_name)]
Matrix = list[list[Annotated[float, Field(strict=True)]]]
Found = tuple[str, str]
"""A mistake in a table: the entry and a description."""


class Table(BaseModel):
    """A table of a scenario file."""

    model_config = ConfigDict(extra="forbid", frozen=True, serialize_by_alias=True)

    @classmethod
    def entries(cls) -> list[str]:
        """The names of its entries."""
        return [field.alias or name for name, field in cls.model_fields.items()]

    @classmethod
    def inner(cls, entry: str) -> type[Table] | None:
        """The class of the table, or of the tables in a list or by name, in an entry; None if the entry holds no table."""
        field = cls.model_fields.get(entry)
        return None if field is None else _table_in(field.annotation)

    def mistakes(self) -> Iterable[Found]:
        """Mistakes that only show in several entries together; each entry is valid by itself."""
        return ()

    @model_validator(mode="after")
    def _as_a_whole(self) -> Self:
        refuse(self.mistakes())
        return self


def _table_in(annotation: Any) -> type[Table] | None:
    """The first class of tables in a type such as `list[LinkTable] | None`."""
    if isinstance(annotation, type) and issubclass(annotation, Table):
        return annotation
    return next((table for argument in get_args(annotation) if (table := _table_in(argument)) is not None), None)


def refuse(mistakes: Iterable[Found]) -> None:
    """Raise the error of a check that finds these mistakes below the checked value, if there are any."""
    if given := list(mistakes):
        raise PydanticCustomError("mistakes", "several", {"mistakes": given})


def parameter_mistakes(kind: str, name: str, model: Any, given: Mapping[str, Any]) -> Iterator[Found]:
    """Missing and unknown parameters of a class; kind, name: the class in messages, such as scheme innovation."""
    for entry, example in model.parameters.items():
        if entry not in given and entry not in getattr(model, "optional", ()):
            yield entry, f"is missing; the {kind} {name} needs it, such as {entry} = {as_toml(example)}"
    choice = f"expected {listed(sorted(model.parameters))}" if model.parameters else "remove the line"
    for entry in given:
        if entry not in model.parameters:
            yield entry, f"is set, but the {kind} {name} has no such parameter; {choice}"


def model_mistakes(table: Mapping[str, Any], models: Registry[Any]) -> list[Found]:
    """Mistakes in `{model = "…", …}`: a missing or unknown model; missing, unknown or wrong parameters.

    models: a registry of classes with `parameters`, `optional` and `mistakes`.
    """
    model = models.get(str(table.get("model")))
    if model is None:
        if "model" not in table:
            return [("model", f"is missing; expected model = {as_toml(models.names[0])}, or another")]
        name = table["model"]
        problem = _no_class(name, models) or f"; expected {listed(models.names)}{near(name, models.names)}"
        return [("model", f"is {as_toml(name)}{problem}")]
    given = {name: value for name, value in table.items() if name != "model"}
    mistakes = [
        (name, f"is missing; expected {name} = {as_toml(example)}")
        for name, example in model.parameters.items()
        if name not in given and name not in model.optional
    ]
    names = {*model.parameters, *(("file",) if getattr(model, "recorded", None) is not None else ())}
    mistakes += [
        (name, f"is not a parameter of {table['model']}; expected {listed(sorted(names))}")
        for name in given
        if name not in model.parameters
    ]
    return mistakes + asked(model, {name: value for name, value in given.items() if name in model.parameters})
