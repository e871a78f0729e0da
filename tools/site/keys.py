"""The page of scenario keys, from the schema that checks scenarios."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from evedrop.model.controllers import CONTROLLERS
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.integrity import POLICIES, SENSOR_ATTACKS
from evedrop.model.links import LOSS_MODELS
from evedrop.model.metrics import METRICS
from evedrop.model.schemes import SCHEMES
from evedrop.scenario.events import EVENTS
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import as_toml

Schema = Mapping[str, Any]

_HEAD = """# Scenario keys

All keys of a scenario, with their types, limits, defaults and examples. This page is made from the schema that checks scenarios.
[The scenario file](../scenario.md) says what each key means.
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
    schema = Scenario.model_json_schema()
    parts = [_HEAD, "## Top level", "", *_rows(schema)]
    for name, table in sorted(schema["$defs"].items()):
        parts += ["", f"## {_title(name)}", "", table.get("description", ""), "", *_rows(table)]
    for title, key, classes in _REGISTRIES:
        parts += ["", f"## Built-in {title}", "", f"| {key} | parameters, with an example of each | |", "|---|---|---|"]
        parts += [
            f"| `{name}` | {_parameters(classes[name])} | {_cell(_summary(classes[name]))} |"
            for name in sorted(classes)
        ]
    return "\n".join(parts) + "\n"


def _rows(table: Schema) -> Iterator[str]:
    yield "| key | type | default | example |"
    yield "|---|---|---|---|"
    required = table.get("required", ())
    for name, field in table["properties"].items():
        default = "required" if name in required else _default(field)
        example = _code(as_toml(field["examples"][0])) if field.get("examples") else ""
        yield f"| `{name}` | {_cell(_type(field))} | {default} | {example} |"


def _type(field: Schema) -> str:
    """The type in words, with its limits; None, which means that the key is left out, is not one."""
    if "$ref" in field:
        name = field["$ref"].rpartition("/")[2]
        return f"[table](#{_title(name).lower().replace(' ', '-')})"
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
    limits = [f"{sign} {_number(field[name])}" for name, sign in _LIMITS if name in field]
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


def _title(name: str) -> str:
    """The heading of a table, from the name of its class."""
    words = "".join(f" {letter.lower()}" if letter.isupper() else letter for letter in name.removesuffix("Table"))
    return words.strip().capitalize()


def _parameters(of: Any) -> str:
    return ", ".join(_code(f"{name} = {as_toml(value)}") for name, value in getattr(of, "parameters", {}).items())


def _summary(of: Any) -> str:
    return (of.__doc__ or "").partition("\n")[0]


def _code(text: str) -> str:
    return f"`{_cell(text)}`" if text else ""


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
