"""The base class of all tables of a scenario file: it checks each entry and all together, and reports the mistakes together.

Values that no entry can have are found before any other check: too deep, too large, or with control characters. Pydantic's errors
about a table become sentences, a line for each mistake, with path, value found, value expected and an example.

Source: docs/scenario.md, the scenario file.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, Self, Union, get_args, get_origin

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticCustomError

from evedrop.counting import counted
from evedrop.errors import NotRegistered
from evedrop.model.registry import Registry, asked
from evedrop.names import RESERVED
from evedrop.scenario.words import as_toml, listed, no_entry
from evedrop.system.hints import near
from evedrop.system.output import escaped

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
            raise PydanticCustomError("expected", "one value", {"ending": why})
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
    return checked_name(name)


def checked_name(name: str) -> str:
    """The name, if it has the form `NAME`; otherwise raises the error of a check."""
    if not NAME.fullmatch(name):
        raise expected("a name of a lower-case letter, then up to 31 of a-z 0-9 _ -")
    return name


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Probability = Annotated[float, Field(strict=True), AfterValidator(_probability)]
ProcessName = Annotated[str, AfterValidator(_process_name)]
Matrix = list[list[Number]]
Labels = list[Annotated[str, Field(strict=True, min_length=1)]]
Mistake = tuple[str, str]
"""A mistake in a table: the entry and a description."""


class Table(BaseModel):
    """A table of a scenario file."""

    model_config = ConfigDict(extra="forbid", frozen=True, serialize_by_alias=True, defer_build=True)

    @classmethod
    def entries(cls) -> list[str]:
        """The names of its entries."""
        return [field.alias or name for name, field in cls.model_fields.items()]

    @classmethod
    def all_entries(cls) -> list[str]:
        """The same with those that only some kinds of the table have, such as parameters of schemes."""
        return cls.entries()

    @classmethod
    def _example(cls, entry: str) -> str:
        """A value of an entry, as in a file."""
        return as_toml((cls.model_fields[entry].examples or [0])[0])

    @classmethod
    def inner(cls, entry: str) -> type[Table] | None:
        """The class of the table, or of the tables in a list or by name, in an entry; None if the entry holds no table."""
        field = cls.model_fields.get(entry)
        return None if field is None else _table_in(field.annotation)

    def mistakes(self) -> Iterable[Mistake]:
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


def refuse(mistakes: Iterable[Mistake]) -> None:
    """Raise the error of a check that finds these mistakes below the checked value, if there are any."""
    if given := list(mistakes):
        raise PydanticCustomError("mistakes", "several", {"mistakes": given})


def parameter_mistakes(kind: str, name: str, model: Any, given: Mapping[str, Any]) -> Iterator[Mistake]:
    """Missing and unknown parameters of a class; kind, name: the class in messages, such as scheme innovation."""
    for entry, example in model.parameters.items():
        if entry not in given and entry not in getattr(model, "optional", ()):
            yield entry, f"is missing; the {kind} {name} needs it; expected {entry} = {as_toml(example)}"
    names = {*model.parameters, *(("file",) if getattr(model, "recorded", None) is not None else ())}
    choice = f"expected {listed(sorted(names))}" if names else "remove the line"
    for entry in given:
        if entry not in model.parameters:
            yield entry, f"is set, but the {kind} {name} has no such parameter; {choice}"


def model_mistakes(table: Mapping[str, Any], models: Registry[Any]) -> list[Mistake]:
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
    mistakes = [*parameter_mistakes(models.kind, str(table["model"]), model, given)]
    return mistakes + asked(model, {name: value for name, value in given.items() if name in model.parameters})


_EXPECTED: Mapping[str, str] = {
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "a string",
    "string_too_short": "a string of at least one character",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "bool_type": "true or false",
    "finite_number": "a finite number",
}


def sentences(error: ValidationError, root: type[Table]) -> list[str]:
    """One line for each mistake: path, found, expected, example. root: the class that was checked."""
    lines = []
    for detail in error.errors(include_url=False):
        path = ".".join(str(part) for part in detail["loc"] if part != "[key]")
        if detail["type"] == "mistakes":
            inner: list[Mistake] = detail["ctx"]["mistakes"]
            lines += [f"{'.'.join(filter(None, (path, name)))}: {sentence}" for name, sentence in inner]
        else:
            lines.append(f"{path}: {_sentence(detail, root)}")
    return lines


def _sentence(detail: ErrorDetails, root: type[Table]) -> str:
    kind, value, context = detail["type"], detail["input"], detail.get("ctx", {})
    table, field = _field(detail["loc"], root)
    name = str(detail["loc"][-1]) if detail["loc"] else ""
    example = f", such as {as_toml(field.examples[0])}" if field is not None and field.examples else ""
    if kind == "missing":
        return f"is missing; expected {name}" + (f" = {example.removeprefix(', such as ')}" if example else "")
    if kind == "extra_forbidden":
        places = _places(root, name) if table is root and not near(name, table.entries()) else []
        return no_entry(name, table.entries(), places[:_MOST_PLACES])
    if kind == "expected":
        ending = context.get("ending") or f"; expected {context['expected']}{context['hint'] or example}"
        return f"is {as_toml(value)}{ending}"
    if kind in {"greater_than", "greater_than_equal", "less_than_equal", "less_than"}:
        words = {"gt": "above", "ge": "at least", "le": "at most", "lt": "less than"}
        bound = " and ".join(f"{words[name]} {context[name]}" for name in words if name in context)
        return f"is {as_toml(value)}; expected a number {bound}{example}"
    if kind in {"too_long", "too_short", "string_too_long"}:
        things = "characters" if kind == "string_too_long" else "entries"
        few = kind == "too_short"
        limit = f"fewer than {context['min_length']}" if few else f"more than {context['max_length']}"
        return f"has {limit} {things}; expected {'at least' if few else 'at most'} that many"
    expected = context["expected"].replace("'", "") if kind == "literal_error" else _EXPECTED.get(kind, detail["msg"])
    return f"is {as_toml(value)}; expected {expected}{example}"


def _places(table: type[Table], name: str, within: str = "") -> list[str]:
    """The dotted keys of a table, at most two tables deep, that end in an entry of this name."""
    places = [f"{within}{name}"] if within and name in table.all_entries() else []
    if within.count(".") == 2:
        return places
    for outer, field in table.model_fields.items():
        plain = get_args(field.annotation) if get_origin(field.annotation) in {Union, UnionType} else [field.annotation]
        inner = table.inner(outer)
        if inner is not None and inner in plain:  # rather than in a list of such tables, or in a table of them
            places += _places(inner, name, f"{within}{outer}.")
    return places


def _field(location: Sequence[int | str], root: type[Table]) -> tuple[type[Table], FieldInfo | None]:
    """The table that contains an error, and the field's description if it is a field; root: the table that was checked."""
    table, field = root, None
    for i, part in enumerate(location):
        last = i == len(location) - 1
        inner = table.inner(str(part)) if not last else None
        if inner is not None:
            table, field = inner, None
        elif part in table.model_fields:
            field = table.model_fields[str(part)]
        elif last:
            field = None
    return table, field


_DEEPEST = 16  # levels of nested tables and lists; scenarios use about half as many
_LARGEST_BITS = 4096  # of a whole number; a seed has 256
_LONGEST_NAME = 200
_PLAIN = {"\n", "\t"}
_MOST_TOLD = 20
_MOST_PLACES = 3
MOST_EAVESDROPPERS = 64


def unusable(tables: Any) -> Iterator[str]:
    """A sentence with a path for each unusable value, up to 20 of them."""
    for number, sentence in enumerate(_unusable(tables)):
        if number == _MOST_TOLD:
            yield f"and more such mistakes: {_MOST_TOLD} are listed"
            return
        yield sentence


def _unusable(tables: Any) -> Iterator[str]:
    eavesdroppers = tables.get("eavesdroppers")
    if isinstance(eavesdroppers, dict) and len(eavesdroppers) > MOST_EAVESDROPPERS:
        # Otherwise each of them would be checked and reported.
        yield f"eavesdroppers: has {counted(len(eavesdroppers), 'entry')}; expected at most {MOST_EAVESDROPPERS}"
        return
    # An explicit stack: dotted keys can nest tables deeper than Python's recursion limit.
    waiting: list[tuple[tuple[str, ...], Any]] = [((), tables)]
    while waiting:
        path, value = waiting.pop()
        kind = type(value)
        if kind is dict or kind is list:
            if len(path) >= _DEEPEST:
                yield f"{_dotted(path)}: is more than {_DEEPEST} tables deep; expected entries as docs/scenario.md lists them"
                continue
            entries = list(value.items()) if kind is dict else [(str(i), inner) for i, inner in enumerate(value)]
            if kind is dict:
                yield from _name_mistakes(path, entries)
            waiting += [
                ((*path, str(name)), inner) for name, inner in reversed(entries) if type(inner) not in (float, bool)
            ]
        elif kind is int:
            if value.bit_length() > _LARGEST_BITS:
                yield f"{_dotted(path)}: is a whole number of {value.bit_length()} bits; expected at most {_LARGEST_BITS}"
        elif kind is str and not (value.isascii() and value.isprintable()):
            strange = next((character for character in value if _is_strange(character)), None)
            if strange is not None:
                yield (
                    f"{_dotted(path)}: is {as_toml(value)} with the character U+{ord(strange):04X} in it; expected text "
                    "without control characters"
                )


def _name_mistakes(path: tuple[str, ...], entries: list[tuple[Any, Any]]) -> Iterator[str]:
    for name, _ in entries:
        if not isinstance(name, str) or len(name) > _LONGEST_NAME or any(map(_is_strange, name)):
            yield (
                f"{_dotted((*path, str(name)))}: is a name with a control character, or of more than {_LONGEST_NAME} "
                "characters; expected an entry as docs/scenario.md lists them"
            )


def _is_strange(character: str) -> bool:
    """Whether a character moves the cursor, ends a string, changes the direction of text, or is half of a surrogate pair."""
    strange = unicodedata.category(character) in ("Cc", "Cs") or escaped(character) != character
    return strange and character not in _PLAIN


def _dotted(path: tuple[str, ...]) -> str:
    """A dotted path of bounded length, with plain characters only."""
    names = [name if len(name) <= _LONGEST_NAME else f"{name[:20]}…" for name in path[: _DEEPEST + 1]]
    return (
        "".join("?" if _is_strange(character) or character in _PLAIN else character for character in ".".join(names))
        or "the scenario"
    )
