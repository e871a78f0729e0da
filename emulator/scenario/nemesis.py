"""`[nemesis]`: random faults with a seed; they become ordinary events before the run.

Source: docs/scenario.md, nemesis.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError

from evedrop.scenario.events import Slot
from evedrop.scenario.table import Found, Table, one_of
from evedrop.scenario.words import as_toml, listed

NEMESIS = "nemesis"
FAULTS = ("kill", "pause", "cut", "set", "partition")
"""The faults it can draw, each as in `[[event]]`."""

Mean = Annotated[float, Field(strict=True, ge=1.0, le=1e8)]
Fault = Annotated[str, Field(strict=True), AfterValidator(one_of(FAULTS))]


class NemesisTable(Table):
    """`[nemesis]`: which faults hit which receivers, how often and for how long."""

    faults: Annotated[list[Fault], Field(min_length=1, examples=[["kill", "pause", "cut"]])]
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
        """Entries that need a fault that is not drawn, a time that ends before it begins, and names that appear twice."""
        found: list[Found] = []
        faults = table.get("faults")
        if isinstance(faults, list):
            if "set" in faults and table.get("set") is None:
                found.append(
                    ("set", "is missing, but the fault set is drawn; expected what changes: set = { quality = 0.2 }")
                )
            for entry, fault in (("set", "set"), ("state", "kill")):
                if fault not in faults and table.get(entry) is not None:
                    found.append((entry, f'is given, but "{fault}" is not among faults; add it, or remove the line'))
        for entry in ("faults", "targets"):
            names = table.get(entry)
            if isinstance(names, list) and len(set(map(str, names))) < len(names):
                found.append((entry, "has a name twice; expected each once"))
        start, to = table.get("from", 0), table.get("to")
        if type(start) is int and type(to) is int and to <= start:
            found.append(("to", f"is {to}, not after from, which is {start}; expected a later slot"))
        return found


def nemesis_mistakes(tables: Mapping[str, Any], receivers: Sequence[str]) -> Iterator[str]:
    """Slots outside the run, and targets that are not receivers."""
    try:
        table = NemesisTable.model_validate(tables.get(NEMESIS))
    except ValidationError:
        return
    slots = tables.get("slots")
    if type(slots) is int and slots > 0:
        if table.start >= slots:
            yield f"{NEMESIS}.from: is {table.start}, but the last slot is {slots - 1}; expected a slot of the run"
        if table.to is not None and table.to > slots:
            yield f"{NEMESIS}.to: is {table.to}; expected at most {slots}, the end of the run"
    for i, name in enumerate(table.targets or ()):
        if name not in receivers:
            yield f"{NEMESIS}.targets.{i}: is {as_toml(name)}; expected {listed(receivers)}"
