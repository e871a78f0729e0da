"""The mistakes of a scenario in words: a line each, with path, value found, value expected and an example."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import (
    BaseModel,
    ValidationError,
)
from pydantic_core import ErrorDetails

from evedrop.files import Unreadable, contents
from evedrop.model.eavesdroppers import READERS, STRATEGIES
from evedrop.model.outcomes import eavesdropper_outcomes, legitimate_outcomes
from evedrop.model.process import Process
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.slot.link import LinkSchedule
from evedrop.model.slot.link_law import law_of
from evedrop.model.theory.horizon import horizon
from evedrop.names import LEGITIMATE
from evedrop.scenario.across import acknowledgement_mistakes, away_in, event_mistakes, link_mistakes
from evedrop.scenario.application import APPLICATIONS, application_mistakes, applications_in
from evedrop.scenario.closed_loop import loop_mistakes
from evedrop.scenario.events import EventTable
from evedrop.scenario.expect import Around, ExpectTable
from evedrop.scenario.filter_noise import filter_mistakes
from evedrop.scenario.link_table import CorrelationTable, LinkTable
from evedrop.scenario.nemesis import NEMESIS, NemesisTable, nemesis_mistakes
from evedrop.scenario.plant import ControllerTable, PlantTable
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.table import Found
from evedrop.scenario.tables import (
    MOST_SECRET_BYTES,
    SECRET_BYTES,
    AcknowledgementsTable,
    EavesdropperTable,
    EncodingTable,
    LegitimateTable,
    Scenario,
)
from evedrop.scenario.words import as_toml, listed, no_entry
from evedrop.streams import MOST_SLOTS

_ANY_PROCESS = Process(np.eye(1), np.eye(1), np.eye(1))  # the existence of a theory does not depend on the process
_ROOTS: Mapping[str, type[BaseModel]] = {LinkTable.__name__: LinkTable}
"""Tables that are checked by themselves, by the name that their errors carry; all other errors are of a scenario."""
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
            lines.append(f"{path}: {_sentence(detail, _ROOTS.get(error.title, Scenario))}")
    return lines


def _sentence(detail: ErrorDetails, root: type[BaseModel]) -> str:
    kind, found, context = detail["type"], detail["input"], detail.get("ctx", {})
    table, field = _field(detail["loc"], root)
    name = str(detail["loc"][-1]) if detail["loc"] else ""
    example = f", such as {as_toml(field.examples[0])}" if field is not None and field.examples else ""
    if kind == "missing":
        return f"is missing; expected {name}" + (f" = {as_toml(field.examples[0])}" if example else "")
    if kind == "extra_forbidden":
        fields = table.model_fields if table is not None else {}
        known = [field.alias or known for known, field in fields.items() if known != "made_with"]
        if table is Scenario:
            known += APPLICATIONS.names
        return no_entry(name, known)
    if kind == "expected":
        said = context.get("said") or f"; expected {context['expected']}{context['hint'] or example}"
        return f"is {as_toml(found)}{said}"
    if kind in {"greater_than_equal", "less_than_equal", "less_than"}:
        words = {"ge": "at least", "le": "at most", "lt": "less than"}
        bound = " and ".join(f"{words[name]} {context[name]}" for name in words if name in context)
        return f"is {as_toml(found)}; expected a number {bound}{example}"
    if kind in {"too_long", "too_short", "string_too_long"}:
        things = "characters" if kind == "string_too_long" else "entries"
        few = kind == "too_short"
        limit = f"fewer than {context['min_length']}" if few else f"more than {context['max_length']}"
        return f"has {limit} {things}; expected {'at least' if few else 'at most'} that many"
    expected = _EXPECTED.get(kind, detail["msg"])
    return f"is {as_toml(found)}; expected {expected}{example}"


def _field(location: Sequence[int | str], root: type[BaseModel]) -> tuple[type[BaseModel] | None, Any]:
    """The table that contains an error, and the field's description if it is a field; root: the table that was checked."""
    table: type[BaseModel] | None = root
    field = None
    inner: Mapping[str, type[BaseModel]] = {
        "process": ProcessTable,
        "encoding": EncodingTable,
        "legitimate": LegitimateTable,
        "link": LinkTable,
        "links": LinkTable,
        "eavesdroppers": EavesdropperTable,
        "expect": ExpectTable,
        "event": EventTable,
        "correlation": CorrelationTable,
        "acknowledgements": AcknowledgementsTable,
        "plant": PlantTable,
        "controller": ControllerTable,
        NEMESIS: NemesisTable,
    }
    for i, part in enumerate(location):
        if table is not None and part in table.model_fields:
            field = table.model_fields[str(part)]
            if part in inner and i < len(location) - 1:
                table, field = inner[str(part)], None
        elif table is Scenario and i < len(location) - 1 and part in APPLICATIONS:
            table = APPLICATIONS[str(part)].table
        elif i == len(location) - 1:
            field = None
    return table, field


def across_tables(tables: Mapping[str, Any], beyond_horizon: bool, scenario: Scenario | None) -> list[str]:
    """Mistakes that only show across tables, as far as a faulty file can be checked: horizon, trials, figures.

    scenario: the tables as a scenario, if no table by itself has a mistake.
    """
    found: list[str] = []
    slots, trials, recorded = (tables.get(name, 1) for name in ("slots", "trials", "record_trials"))
    try:
        process = ProcessTable.model_validate(tables.get("process")).process
    except ValidationError:
        process = None
    if process is not None and not beyond_horizon and type(slots) is int and 1 <= slots <= MOST_SLOTS:
        found += _horizon_mistakes(process, slots)
    if type(trials) is int and type(recorded) is int and recorded > trials > 0:
        found.append(f"record_trials: is {recorded}; expected at most trials, which is {trials}")
    shards = tables.get("shards", 1)
    if type(trials) is int and type(shards) is int and shards > trials > 0:
        found.append(f"shards: is {shards}; expected at most trials, which is {trials}: a shard has one trial or more")
    if isinstance(tables.get("eavesdroppers", {}), dict):
        found += _strategy_mistakes(tables, slots)
    found += acknowledgement_mistakes(tables)
    found += loop_mistakes(tables)
    applications = applications_in(tables, Scenario.model_fields)
    found += application_mistakes(applications, tables)
    found += filter_mistakes(tables)
    links = _links(tables)
    found += link_mistakes(tables, links)
    found += event_mistakes(tables, links, sentences)
    if isinstance(tables.get("eavesdroppers", {}), dict):
        found += nemesis_mistakes(tables, (LEGITIMATE, *tables.get("eavesdroppers", {})))
    if scenario is not None and not found:
        try:
            _ = scenario.timeline
        except ValidationError as error:
            found += [f"event: several of them together result in an invalid link: {line}" for line in sentences(error)]
    if isinstance(tables.get("secret_file"), str):
        found += _secret_mistakes(tables["secret_file"])
    sound = scenario if not found else None
    eavesdroppers, expectations = tables.get("eavesdroppers", {}), tables.get("expect", [])
    if isinstance(eavesdroppers, dict) and isinstance(expectations, list):
        encoding = tables.get("encoding")
        around = Around(
            (LEGITIMATE, *eavesdroppers),
            slots if type(slots) is int and slots > 0 else None,
            trials if type(trials) is int and trials > 0 else None,
            lambda name: _no_theory(
                name, tables.get(LEGITIMATE) if name == LEGITIMATE else eavesdroppers[name], encoding, sound
            ),
            applications,
        )
        for i, expectation in enumerate(expectations):
            if isinstance(expectation, dict):
                found += [f"expect.{i}.{entry}: {what}" for entry, what in around.mistakes(expectation)]
    return found


def _links(tables: Mapping[str, Any]) -> dict[str, LinkTable]:
    """Receiver → its link, for each receiver whose link is valid."""
    eavesdroppers = tables.get("eavesdroppers")
    receivers = {LEGITIMATE: tables.get(LEGITIMATE), **(eavesdroppers if isinstance(eavesdroppers, dict) else {})}
    found = {}
    for name, receiver in receivers.items():
        with suppress(TypeError, KeyError, ValidationError):
            found[name] = LinkTable.model_validate(receiver["link"])
    return found


def _no_theory(name: str, receiver: Any, encoding: Any, sound: Scenario | None) -> str | None:
    """The reason why no theory covers a receiver; None if a theory does, or if the receiver's own table has mistakes.

    sound: the scenario, if it has no other mistakes: its events are then considered too.
    """
    try:
        scheme = scheme_of(_ANY_PROCESS, EncodingTable.model_validate(encoding).spec)
        if name == LEGITIMATE:
            link = LinkTable.model_validate(receiver["link"])
            if LEGITIMATE not in scheme.closed_forms and legitimate_outcomes(scheme) is None:
                return f"no closed form is known for the scheme {encoding['scheme']}"
        else:
            table = EavesdropperTable.model_validate(receiver)
            link = table.pool
            closed = table.strategy in scheme.closed_forms
            if not closed and eavesdropper_outcomes(scheme, table.strategy, table.parameters) is None:
                return f"no closed form is known for the strategy {table.strategy} of {name}"
        if law_of(LinkSchedule(link.settings(1.0), int(receiver.get("window", 0)))) is None:
            return f"there is no theory for {name}'s link"
        if sound is None:
            return None
        from evedrop.expected.expectations import expectations_of  # noqa: PLC0415 - for checked scenarios only

        known = expectations_of(sound)[name].known
        return None if known else f"there is no theory for {name} with these links, attacks and events together"
    except (TypeError, KeyError, ValidationError):
        return None


def _strategy_mistakes(tables: Mapping[str, Any], slots: Any) -> list[str]:
    """Strategies that need something the scheme lacks, or a slot that is beyond the run or in which they are away."""
    found = []
    eavesdroppers, encoding = tables.get("eavesdroppers", {}), tables.get("encoding")
    chosen = encoding.get("scheme") if isinstance(encoding, dict) else None
    scheme = SCHEMES.get(str(chosen))
    for name, entries in eavesdroppers.items():
        try:
            table = EavesdropperTable.model_validate(entries)
        except ValidationError:
            continue
        strategy = STRATEGIES[table.strategy]
        lacking = [] if scheme is None else lacking_streams(strategy.streams(table.parameters), scheme)
        if lacking:
            entry, value = ("reads_as", table.reads_as) if table.reads_as else ("strategy", table.strategy)
            able = [one for one in READERS if not READERS[one].streams({})]
            found.append(
                f"eavesdroppers.{name}.{entry}: is {as_toml(value)}, which is defined by its knowledge of the "
                f"{listed(lacking)}, and the scheme {chosen} has none; expected {listed(sorted(able))}"
            )
        betrayed = strategy.betrayed(table.parameters)
        if betrayed is not None and type(slots) is int and betrayed >= slots > 0:
            found.append(f"eavesdroppers.{name}.learns_at: is {betrayed}; expected a slot of the run, 0 to {slots - 1}")
        away = None if betrayed is None else away_in(tables, name, betrayed)
        if away is not None:
            found.append(
                f"eavesdroppers.{name}.learns_at: is {betrayed}, when {away}; expected a slot in which it is present"
            )
    return found


def lacking_streams(streams: Iterable[str], scheme: type[Scheme]) -> list[str]:
    """The streams whose keys a strategy must be given but that a scheme does not have."""
    return [stream for stream in streams if stream != "coin" and stream not in scheme.secret_streams]


def _secret_mistakes(file: str) -> list[str]:
    """Reasons why a file cannot hold a secret."""
    try:
        size = len(contents(Path(file), MOST_SECRET_BYTES))
    except Unreadable as error:
        return [f"secret_file: {file} cannot be read ({error}); expected a file of {SECRET_BYTES} or more random bytes"]
    if size < SECRET_BYTES:
        return [f"secret_file: {file} has {size} bytes; expected {SECRET_BYTES} or more, random ones"]
    return []


def _horizon_mistakes(process: Process, slots: int) -> list[str]:
    """A mistake if float64 cannot follow the process for that many slots (docs/mathematics.md, horizon)."""
    last = horizon(process, slots)
    if last is None:
        return []
    return [
        f"slots: is {slots}; this process (spectral radius {process.spectral_radius:.4g}) can be followed up to slot "
        f"{last}: beyond it float64 rounds off more than 1 % of the process noise inside a state this large. Ways out: "
        f"slots = {last + 1} or fewer; a smaller initial_covariance or a larger Q; an A with a smaller spectral radius"
    ]
