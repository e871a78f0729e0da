"""The page of scenario keys, from the schema that checks scenarios."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

from evedrop.model.controllers import CONTROLLERS
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.integrity import POLICIES, SENSOR_ATTACKS
from evedrop.model.links import LOSS_MODELS
from evedrop.model.metrics import METRICS
from evedrop.model.schemes import SCHEMES
from evedrop.scenario.events import EVENTS
from evedrop.scenario.events.table import EventTable
from evedrop.scenario.table import Table
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import as_toml

Schema = Mapping[str, Any]

_HEAD = """# Scenario keys

All keys of a scenario: what each means, its type and limits, its default and an example. This page is made from the classes that
check scenarios. [The scenario file](../scenario.md) explains the tables by examples.
"""
_LIMITS = (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
_TYPES = {
    "string": "string",
    "integer": "whole number",
    "number": "number",
    "boolean": "boolean",
    "object": "table",
    "array": "list",
}
_REGISTRIES = (
    ("schemes", "scheme", SCHEMES),
    ("strategies", "strategy", STRATEGIES),
    ("loss models", "model", LOSS_MODELS),
    ("delay models", "model", DELAY_MODELS),
    ("controllers", "strategy", CONTROLLERS),
    ("attacks on measurements", "model", SENSOR_ATTACKS),
    ("watermark policies", "policy", POLICIES),
    ("events", "event", EVENTS),
    ("metrics", "metric", METRICS),
)


def keys_page() -> str:
    """The page in Markdown: a section for each table, and one for each kind of class that a scenario names."""
    parts = [_HEAD, "## Top level", "", *_rows(Scenario)]
    for table in inner_tables(Scenario):
        title, _, words = _first_line(table).partition(": ")
        parts += [
            "",
            f"## {title} {{ #{_anchor(table.__name__)} }}",
            "",
            f"{words[0].upper()}{words[1:]}",
            "",
            *_rows(table),
        ]
    for title, key, classes in _REGISTRIES:
        parts += ["", f"## Built-in {title}", "", f"| {key} | parameters, with an example of each | |", "|---|---|---|"]
        parts += [
            f"| `{name}` | {_parameters(classes[name])} | {_cell(_first_line(classes[name]))} |"
            for name in sorted(classes)
        ]
    return "\n".join(parts) + "\n"


def inner_tables(table: type[Table]) -> list[type[Table]]:
    """The tables inside a table, each followed by those inside it; that of events with the entries of all kinds."""
    direct = [inner for entry in table.entries() if (inner := table.inner(entry)) is not None]
    return list(dict.fromkeys(below for inner in direct for below in (inner, *inner_tables(inner))))


def descriptions(table: type[Table]) -> dict[str, str]:
    """Key → the description of it, which is the string below its declaration in the class, or in one of its bases."""
    classes = [*reversed(table.__mro__)]
    if issubclass(table, EventTable):  # it is made from its kinds
        classes += table.kinds.values()
    described: dict[str, str] = {}
    for class_ in classes:
        if issubclass(class_, Table) and class_.__module__.startswith("evedrop."):
            described |= _described(class_)
    return {field.alias or name: described.get(name, "") for name, field in table.model_fields.items()}


def _described(class_: type[Table]) -> dict[str, str]:
    """Name of a field → the string below its declaration, for the fields that this class declares."""
    try:
        (declared,) = ast.parse(textwrap.dedent(inspect.getsource(class_))).body
    except OSError:  # it was made by a function
        return {}
    assert isinstance(declared, ast.ClassDef)  # noqa: S101
    return {
        field.target.id: " ".join(text.value.value.split())
        for field, text in pairwise(declared.body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant) and isinstance(text.value.value, str)
    }


def _rows(table: type[Table]) -> Iterator[str]:
    yield "| key | meaning | type | default | example |"
    yield "|---|---|---|---|---|"
    schema = table.model_json_schema()
    required = schema.get("required", ())
    for name, description in descriptions(table).items():
        field = schema["properties"][name]
        default = "required" if name in required else _default(field)
        example = _code(as_toml(field["examples"][0])) if field.get("examples") else ""
        yield f"| `{name}` | {_cell(description)} | {_cell(_type(field))} | {default} | {example} |"


def _type(field: Schema) -> str:
    """The type in words, with its limits; None, which means that the key is left out, is not one."""
    if "$ref" in field:
        return f"[table](#{_anchor(field['$ref'].rpartition('/')[2])})"
    if "anyOf" in field:
        return " or ".join(dict.fromkeys(_type(choice) for choice in field["anyOf"] if choice.get("type") != "null"))
    if "allOf" in field:
        return _type(field["allOf"][0])
    if "enum" in field or "const" in field:
        return ", ".join(f"`{choice}`" for choice in field.get("enum", [field.get("const")]))
    words = _TYPES.get(str(field.get("type")), "any value")
    if field.get("type") == "array" and field.get("items"):
        words = f"list of: {_type(field['items'])}"
    if field.get("type") == "object" and isinstance(field.get("additionalProperties"), dict):
        words = f"table of names, each: {_type(field['additionalProperties'])}"
    limits = [f"{sign}\u00a0{_number(field[name])}" for name, sign in _LIMITS if name in field]
    limits += [f"at most {_number(field[name])} {unit}" for name, unit in _MOST if name in field]
    return f"{words}, {', '.join(limits)}" if limits else words


_MOST = (("maxLength", "characters"), ("maxItems", "entries"), ("maxProperties", "entries"))


def _number(value: float) -> str:
    exponent = int(value).bit_length() - 1
    if value == 2**exponent and exponent > 20:
        return f"2^{exponent}"
    return f"{int(value) if value == int(value) else value:,}".replace(",", "\u202f")


def _default(field: Schema) -> str:
    value = field.get("default")
    return "" if value is None or value in ([], {}) else _code(as_toml(value))


def _anchor(name: str) -> str:
    """The anchor of the section of a table, from the name of its class."""
    return name.removesuffix("Table").lower()


def _parameters(of: Any) -> str:
    return ", ".join(_code(f"{name} = {as_toml(value)}") for name, value in getattr(of, "parameters", {}).items())


def _first_line(of: Any) -> str:
    return (inspect.getdoc(of) or "").partition("\n")[0]


def _code(text: str) -> str:
    return f"`{_cell(text)}`" if text else ""


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
