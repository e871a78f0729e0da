"""`[nemesis]`: random faults with a seed; they become ordinary events before the run.

Source: docs/scenario.md, nemesis.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from evedrop.model.registry import is_own
from evedrop.scenario.events import EVENTS
from evedrop.scenario.events.event import Fault, Slot
from evedrop.scenario.table import Found, Table, expected
from evedrop.scenario.words import as_toml, listed
from evedrop.system.hints import near

NEMESIS = "nemesis"


def fault_of(name: object) -> Fault | None:
    """How a nemesis draws events of this name; None if it does not draw them."""
    kind = EVENTS.get(name) if isinstance(name, str) and not is_own(name) else None
    return None if kind is None else kind.fault


def _drawn(name: str) -> str:
    if fault_of(name) is None:
        faults = sorted(event for event in EVENTS.names if fault_of(event) is not None)
        raise expected(listed(faults), near(name, faults))
    return name


Mean = Annotated[float, Field(strict=True, ge=1.0, le=1e8)]
FaultName = Annotated[str, Field(strict=True), AfterValidator(_drawn)]


class NemesisTable(Table):
    """`[nemesis]`: which faults hit which receivers, how often and for how long."""

    faults: Annotated[list[FaultName], Field(min_length=1, examples=[["kill", "pause", "cut"]])]
    targets: Annotated[
        list[Annotated[str, Field(strict=True)]] | None, Field(min_length=1, examples=[["legitimate"]])
    ] = None
    every: Annotated[Mean, Field(examples=[200])]
    lasting: Annotated[Mean, Field(examples=[50])]
    start: Annotated[Slot, Field(alias="from", examples=[100])] = 0
    to: Annotated[Slot | None, Field(examples=[1800])] = None
    seed: Annotated[int | None, Field(ge=0, lt=2**256, strict=True, examples=[3])] = None
    state: Annotated[Literal["prior", "last"] | None, Field(examples=["last"])] = None
    set: Annotated[dict[str, Any] | None, Field(min_length=1, examples=[{"quality": 0.2}])] = None

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Entries that a fault lacks or that no fault uses, a span that ends before it begins, and names that appear twice."""
        mistakes: list[Found] = []
        faults = table.get("faults")
        if isinstance(faults, list):
            mistakes += cls._fault_mistakes(table, faults)
        for entry in ("faults", "targets"):
            names = table.get(entry)
            if isinstance(names, list) and len(set(map(str, names))) < len(names):
                mistakes.append((entry, "has a name twice; expected each once"))
        start, to = table.get("from", 0), table.get("to")
        if type(start) is int and type(to) is int and to <= start:
            mistakes.append(("to", f"is {to}, not after from, which is {start}; expected a later slot"))
        return mistakes

    @classmethod
    def _fault_mistakes(cls, table: Mapping[str, Any], faults: Sequence[object]) -> Iterator[Found]:
        """Entries that a fault needs, and entries that no fault uses."""
        drawn = {name: fault for name in dict.fromkeys(map(str, faults)) if (fault := fault_of(name)) is not None}
        for name, fault in drawn.items():
            for entry, entry_words in fault.needs.items():
                if table.get(entry) is None:
                    example = as_toml((cls.model_fields[entry].examples or [0])[0])
                    yield (
                        entry,
                        f"is missing, but the fault {name} is drawn; expected {entry_words}: {entry} = {example}",
                    )
        used = {entry for fault in drawn.values() for entry in fault.entries}
        for name, kind in EVENTS.items():
            for entry in kind.fault.entries if kind.fault is not None else ():
                if entry not in used and table.get(entry) is not None:
                    yield entry, f'is given, but "{name}" is not among faults; add it, or remove the line'


def nemesis_mistakes(table: NemesisTable, slots: int | None, receivers: Sequence[str]) -> Iterator[str]:
    """Slots outside the run, and targets that are not receivers; slots: None if they are not valid."""
    if slots is not None:
        if table.start >= slots:
            yield f"{NEMESIS}.from: is {table.start}, but the last slot is {slots - 1}; expected a slot of the run"
        if table.to is not None and table.to > slots:
            yield f"{NEMESIS}.to: is {table.to}; expected at most {slots}, the end of the run"
    for i, name in enumerate(table.targets or ()):
        if name not in receivers:
            yield f"{NEMESIS}.targets.{i}: is {as_toml(name)}; expected {listed(receivers)}"
