"""Pydantic's errors about a table, in words: a line for each mistake, with path, value found, value expected and an example."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pydantic import ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from evedrop.scenario.table import Found, Table
from evedrop.scenario.words import as_toml, no_entry

_EXPECTED: Mapping[str, str] = {
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "a string",
    "string_too_short": "a string of at least one character",
    "list_type": "a list",
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
            inner: list[Found] = detail["ctx"]["mistakes"]
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
        return no_entry(name, table.entries())
    if kind == "expected":
        ending = context.get("said") or f"; expected {context['expected']}{context['hint'] or example}"
        return f"is {as_toml(value)}{ending}"
    if kind in {"greater_than_equal", "less_than_equal", "less_than"}:
        words = {"ge": "at least", "le": "at most", "lt": "less than"}
        bound = " and ".join(f"{words[name]} {context[name]}" for name in words if name in context)
        return f"is {as_toml(value)}; expected a number {bound}{example}"
    if kind in {"too_long", "too_short", "string_too_long"}:
        things = "characters" if kind == "string_too_long" else "entries"
        few = kind == "too_short"
        limit = f"fewer than {context['min_length']}" if few else f"more than {context['max_length']}"
        return f"has {limit} {things}; expected {'at least' if few else 'at most'} that many"
    expected = _EXPECTED.get(kind, detail["msg"])
    return f"is {as_toml(value)}; expected {expected}{example}"


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
