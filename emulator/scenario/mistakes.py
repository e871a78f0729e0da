"""The mistakes of a scenario in words: a line each, with path, what was found, what was expected, an example."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import (
    BaseModel,
    ValidationError,
)
from pydantic_core import ErrorDetails

from emulator.model.horizon import horizon
from emulator.model.process import Process
from emulator.network.access import LEGITIMATE
from emulator.scenario.tables import (
    FIGURES,
    SECRET_BYTES,
    EavesdropperTable,
    EncodingTable,
    ExpectTable,
    Found,
    LegitimateTable,
    LinkTable,
    ProcessTable,
    Scenario,
)
from emulator.scenario.words import as_toml

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


def sentences(error: ValidationError) -> list[str]:
    """One line for each mistake: path, found, expected, example."""
    lines = []
    for detail in error.errors(include_url=False):
        path = ".".join(str(part) for part in detail["loc"] if part != "[key]")
        if detail["type"] == "mistakes":
            inner: list[Found] = detail["ctx"]["mistakes"]
            lines += [f"{path}.{name}: {what}" if path else f"{name}: {what}" for name, what in inner]
        else:
            lines.append(f"{path}: {_sentence(detail)}")
    return lines


def _sentence(detail: ErrorDetails) -> str:
    kind, found, context = detail["type"], detail["input"], detail.get("ctx", {})
    table, field = _field(detail["loc"])
    name = str(detail["loc"][-1]) if detail["loc"] else ""
    example = f", such as {as_toml(field.examples[0])}" if field is not None and field.examples else ""
    if kind == "missing":
        return f"is missing; expected {name}" + (f" = {as_toml(field.examples[0])}" if example else "")
    if kind == "extra_forbidden":
        known = [known for known in table.model_fields if known != "made_with"] if table is not None else []
        near = difflib.get_close_matches(name, known, 1)
        hint = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(known)}"
        return f"is no entry of this table; {hint}"
    if kind == "expected":
        return f"is {as_toml(found)}; expected {context['expected']}{example}"
    if kind in {"greater_than_equal", "less_than_equal", "less_than"}:
        words = {"ge": "at least", "le": "at most", "lt": "less than"}
        bound = " and ".join(f"{words[name]} {context[name]}" for name in words if name in context)
        return f"is {as_toml(found)}; expected a number {bound}{example}"
    if kind == "too_long":
        return f"has more than {context['max_length']} entries; expected at most so many"
    expected = _EXPECTED.get(kind, detail["msg"])
    return f"is {as_toml(found)}; expected {expected}{example}"


def _field(location: Sequence[int | str]) -> tuple[type[BaseModel] | None, Any]:
    """The table an error is in, and the field's description if it is a field."""
    table: type[BaseModel] | None = Scenario
    field = None
    inner: Mapping[str, type[BaseModel]] = {
        "process": ProcessTable,
        "encoding": EncodingTable,
        "legitimate": LegitimateTable,
        "link": LinkTable,
        "eavesdroppers": EavesdropperTable,
        "expect": ExpectTable,
    }
    for i, part in enumerate(location):
        if table is not None and part in table.model_fields:
            field = table.model_fields[str(part)]
            if part in inner and i < len(location) - 1:
                table, field = inner[str(part)], None
        elif i == len(location) - 1:
            field = None
    return table, field


def across_tables(tables: Mapping[str, Any], beyond_horizon: bool) -> list[str]:
    """What only shows across tables, asked as far as a faulty file allows it: horizon, trials, figures."""
    found: list[str] = []
    slots, trials, recorded = (tables.get(name, 1) for name in ("slots", "trials", "record_trials"))
    try:
        process = ProcessTable.model_validate(tables.get("process")).process
    except ValidationError:
        process = None
    if process is not None and not beyond_horizon and type(slots) is int and 1 <= slots <= 100_000_000:
        found += _horizon_mistakes(process, slots)
    if type(trials) is int and type(recorded) is int and recorded > trials > 0:
        found.append(f"record_trials: is {recorded}; expected at most trials, which is {trials}")
    eavesdroppers, expectations = tables.get("eavesdroppers", {}), tables.get("expect", [])
    if isinstance(eavesdroppers, dict) and isinstance(expectations, list):
        available = [f"{receiver}.{figure}" for receiver in (LEGITIMATE, *eavesdroppers) for figure in FIGURES]
        for i, expectation in enumerate(expectations):
            figure = expectation.get("figure") if isinstance(expectation, dict) else None
            if isinstance(figure, str) and figure not in available:
                near = difflib.get_close_matches(figure, available, 1)
                hint = f"; did you mean {near[0]}?" if near else ""
                names = f"RECEIVER ({', '.join((LEGITIMATE, *eavesdroppers))}).FIGURE ({', '.join(FIGURES)})"
                found.append(f"expect.{i}.figure: is {as_toml(figure)}; expected {names}{hint}")
            elif isinstance(figure, str) and figure.endswith(".expected_trace_covariance"):
                receiver = figure.partition(".")[0]
                if not _has_theory(tables.get(LEGITIMATE) if receiver == LEGITIMATE else eavesdroppers[receiver]):
                    why = f"there is no theory for the losses of {receiver}'s link"
                    found.append(f"expect.{i}.figure: is {as_toml(figure)}, but {why}; expected another figure")
    if isinstance(tables.get("secret_file"), str):
        found += _secret_mistakes(tables["secret_file"])
    return found


def _has_theory(receiver: Any) -> bool:
    """Whether there is a theory for a receiver's link, as far as it is one."""
    try:
        return LinkTable.model_validate(receiver["link"]).model.chain is not None
    except (TypeError, KeyError, ValidationError):
        return True


def _secret_mistakes(file: str) -> list[str]:
    """Why a file cannot hold a secret."""
    try:
        size = len(Path(file).read_bytes())
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        return [f"secret_file: {file} cannot be read ({why}); expected a file of {SECRET_BYTES} or more random bytes"]
    if size < SECRET_BYTES:
        return [f"secret_file: {file} has {size} bytes; expected {SECRET_BYTES} or more, random ones"]
    return []


def _horizon_mistakes(process: Process, slots: int) -> list[str]:
    """Why so many slots are too many, if they are (docs/mathematics.md, horizon)."""
    last = horizon(process, slots)
    if last is None:
        return []
    return [
        f"slots: is {slots}; this process (spectral radius {process.spectral_radius:.4g}) can be followed up to slot "
        f"{last}: beyond it float64 rounds off more than 1 % of the process noise inside a state this large. Ways out: "
        f"slots = {last + 1} or fewer; a smaller initial_covariance or a larger Q; an A with a smaller spectral radius"
    ]
