"""The base class of all tables of a scenario file: it checks each entry and all together, and reports the mistakes together."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Self, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    model_validator,
)
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from evedrop.errors import NotRegistered
from evedrop.model.checks import is_number
from evedrop.model.registry import Registry, asked
from evedrop.names import RESERVED
from evedrop.scenario.words import as_toml, listed
from evedrop.system.hints import near

MOST = 2**1023
"""The largest whole number that is sure to fit a float."""
NAME = re.compile(r"[a-z][a-z0-9_-]{0,31}")


def expected(words: str, hint: str = "") -> PydanticCustomError:
    """The error about one value, to be raised in a check. what: the expected value; hint: what to add, such as a similar name.

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

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Mistakes that only show in several entries together. The table is unchecked: any entry may be missing or malformed."""
        del table
        return []

    @model_validator(mode="wrap")
    @classmethod
    def _all_at_once(cls, entries: Any, check: ModelWrapValidatorHandler[Self]) -> Self:
        """Check each entry and all entries together, so that one mistake does not hide another."""
        together = cls.mistakes(entries) if isinstance(entries, Mapping) else []
        mistakes = PydanticCustomError("mistakes", "several", {"mistakes": together})
        try:
            table = check(entries)
        except ValidationError as error:
            if not together:
                raise
            lines = [again(detail) for detail in error.errors(include_url=False)]
            lines.append(InitErrorDetails(type=mistakes, input=entries))
            raise ValidationError.from_exception_data(cls.__name__, lines) from None
        if together:
            raise mistakes
        return table


def _table_in(annotation: Any) -> type[Table] | None:
    """The first class of tables in a type such as `list[LinkTable] | None`."""
    if isinstance(annotation, type) and issubclass(annotation, Table):
        return annotation
    return next((table for argument in get_args(annotation) if (table := _table_in(argument)) is not None), None)


def again(detail: ErrorDetails, *above: str) -> InitErrorDetails:
    """An error of one check in the form in which it can be reported with others; above: the entries that contain its table."""
    kind, context = detail["type"], detail.get("ctx", {})
    own = PydanticCustomError(kind, detail["msg"], context) if kind in {"expected", "mistakes"} else kind
    return InitErrorDetails(type=own, loc=(*above, *detail["loc"]), input=detail["input"], ctx=context)


def numbers(rows: Any) -> bool:
    """Whether these are rows of numbers, of any lengths; they may be infinite, or NaN."""
    return isinstance(rows, list) and all(
        isinstance(row, list) and all(isinstance(element, float) or is_number(element, -MOST, MOST) for element in row)
        for row in rows
    )


def model_mistakes(entry: str, found: Any, models: Registry[Any]) -> list[Found]:
    """Mistakes in `{model = "…", …}`: a missing or unknown model; missing, unknown or wrong parameters.

    models: a registry of classes with `parameters`, `optional` and `mistakes`.
    """
    if not isinstance(found, Mapping):
        return []
    model = models.get(str(found.get("model")))
    if model is None:
        if "model" not in found:
            return [(f"{entry}.model", f"is missing; expected model = {as_toml(models.names[0])}, or another")]
        name = found["model"]
        problem = _no_class(name, models) or f"; expected {listed(models.names)}{near(name, models.names)}"
        return [(f"{entry}.model", f"is {as_toml(name)}{problem}")]
    given = {name: value for name, value in found.items() if name != "model"}
    mistakes = [
        (f"{entry}.{name}", f"is missing; expected {name} = {as_toml(example)}")
        for name, example in model.parameters.items()
        if name not in given and name not in model.optional
    ]
    names = {*model.parameters, *(("file",) if getattr(model, "recorded", None) is not None else ())}
    mistakes += [
        (f"{entry}.{name}", f"is not a parameter of {found['model']}; expected {listed(sorted(names))}")
        for name in given
        if name not in model.parameters
    ]
    known = {name: value for name, value in given.items() if name in model.parameters}
    return mistakes + [(f"{entry}.{name}", sentence) for name, sentence in asked(model, known)]
