"""The first of the two phases of a check: every table by itself. The second phase compares the tables that are valid.

Source: docs/architecture.md, how a scenario is checked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Self, TypeVar

from pydantic import TypeAdapter, ValidationError

from evedrop.model.schemes import SCHEMES
from evedrop.model.schemes.scheme import Scheme
from evedrop.names import LEGITIMATE
from evedrop.scenario.acknowledgements import AcknowledgementsTable
from evedrop.scenario.application import Application, applications_in
from evedrop.scenario.encoding import EncodingTable
from evedrop.scenario.events.event import EventKind
from evedrop.scenario.events.table import event_of
from evedrop.scenario.expect import ExpectTable
from evedrop.scenario.link_table import LinkTable
from evedrop.scenario.nemesis import NemesisTable
from evedrop.scenario.plant import ControllerTable, PlantTable
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.receivers import EavesdropperTable, LegitimateTable
from evedrop.scenario.table import Table
from evedrop.scenario.tables import (
    Scenario,
)
from evedrop.scenario.wire_table import WireTable

K = TypeVar("K")
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class ValidTables:
    """The tables and values of a scenario that are valid by themselves; None, or left out, where there is a mistake."""

    scenario: Scenario | None
    """All of them, if there is no mistake."""
    given: tuple[str, ...]
    """The names of everything that is given, valid or not."""
    receivers: tuple[str, ...]
    """All receivers, the legitimate estimator first."""
    all_receivers: bool
    """Whether `receivers` is complete; it is not if `eavesdroppers` is not a table."""
    links: Mapping[str, LinkTable]
    """Receiver → its link, even if other entries of the receiver have mistakes; without pooled links."""
    applications: Mapping[str, type[Application]]
    """Those whose tables are given, valid or not."""
    application_tables: Mapping[str, Table]
    eavesdroppers: Mapping[str, EavesdropperTable]
    event: tuple[tuple[int, EventKind], ...]
    """Each with its number."""
    expect: tuple[tuple[int, ExpectTable], ...]
    """Each with its number; an entry with a mistake is None."""
    slots: int | None
    trials: int | None
    record_trials: int | None
    shards: int | None
    slot_seconds: float | None
    secret_file: str | None
    process: ProcessTable | None
    encoding: EncodingTable | None
    legitimate: LegitimateTable | None
    plant: PlantTable | None
    controller: ControllerTable | None
    acknowledgements: AcknowledgementsTable | None
    nemesis: NemesisTable | None
    wire: WireTable | None

    @property
    def scheme(self) -> type[Scheme] | None:
        """The scheme's class."""
        return None if self.encoding is None else SCHEMES[self.encoding.scheme]

    @classmethod
    def of(cls, tables: Mapping[str, Any], scenario: Scenario | None) -> Self:
        """The valid ones of these tables. scenario: the same tables as a scenario, if all are known to be valid."""
        given = tuple(name for name, value in tables.items() if value is not None)
        applications = applications_in(given, Scenario.model_fields)
        if scenario is not None:
            everybody: dict[str, LegitimateTable | EavesdropperTable] = {LEGITIMATE: scenario.legitimate}
            everybody |= scenario.eavesdroppers
            return cls(
                scenario=scenario,
                given=given,
                receivers=scenario.receivers,
                all_receivers=True,
                links={name: one.link for name, one in everybody.items() if one.link is not None},
                applications=applications,
                application_tables=scenario.applications,
                eavesdroppers=scenario.eavesdroppers,
                event=tuple(enumerate(scenario.event)),
                expect=tuple(enumerate(scenario.expect)),
                **{name: getattr(scenario, name) for name in _SINGLE},
            )
        eavesdroppers = tables.get("eavesdroppers", {})
        all_receivers = isinstance(eavesdroppers, Mapping)
        eavesdroppers = eavesdroppers if all_receivers else {}
        receivers = {LEGITIMATE: tables.get(LEGITIMATE), **eavesdroppers}
        links = {name: one["link"] for name, one in receivers.items() if isinstance(one, Mapping) and "link" in one}
        return cls(
            scenario=None,
            given=given,
            receivers=tuple(receivers),
            all_receivers=all_receivers,
            links=_valid(LinkTable.model_validate, links.items()),
            applications=applications,
            application_tables={
                name: table
                for name, kind in applications.items()
                for table in _valid(kind.table.model_validate, [(name, tables[name])]).values()
            },
            eavesdroppers=_valid(EavesdropperTable.model_validate, eavesdroppers.items()),
            event=_numbered(event_of, tables.get("event")),
            expect=_numbered(_expectation, tables.get("expect")),
            **{name: _single(Scenario, name, tables.get(name)) for name in _SINGLE},
        )


_SINGLE = tuple(
    name
    for name in ValidTables.__dataclass_fields__
    if name in Scenario.model_fields and name not in ("eavesdroppers", "event", "expect")
)
"""The entries of a scenario that are one value or one table."""


def _numbered(check: Callable[[Any], T], tables: object) -> tuple[tuple[int, T], ...]:
    """The valid ones in a list of tables, each with its number."""
    return tuple(_valid(check, enumerate(tables)).items()) if isinstance(tables, list) else ()


def _valid(check: Callable[[Any], T], entries: Iterable[tuple[K, object]]) -> dict[K, T]:
    """The result of a check for each entry, without the entries that it refuses."""
    made = {}
    for key, entry in entries:
        with suppress(ValidationError):
            made[key] = check(entry)
    return made


def _expectation(value: object) -> ExpectTable:
    """An expectation with the entries that are valid by themselves: it may lack some, or have too many."""
    entries = value if isinstance(value, Mapping) else {}
    return ExpectTable.model_construct(
        **{name: _single(ExpectTable, name, entries.get(name)) for name in ExpectTable.model_fields}
    )


def _single(table: type[Table], name: str, value: object) -> Any:
    """One entry of a table; its default if it is not given, None if it has a mistake."""
    field = table.model_fields[name]
    if value is None:
        return None if field.is_required() else field.default
    return _valid(_adapter(table, name).validate_python, [(name, value)]).get(name)


@cache
def _adapter(table: type[Table], name: str) -> TypeAdapter[Any]:
    field = table.model_fields[name]
    kind: Any = Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
    return TypeAdapter(kind)
