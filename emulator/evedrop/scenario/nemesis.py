"""`[nemesis]`: random faults with a seed; they become ordinary events before the run.

Source: docs/scenario.md, nemesis.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from evedrop.model.registry import is_own
from evedrop.scenario.events import EVENTS
from evedrop.scenario.events.event import Fault, Slot
from evedrop.scenario.table import Mistake, Table, expected
from evedrop.scenario.words import listed
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
    """The kinds of fault that are drawn: `kill` (with a restart), `pause`, `cut`, `set`, `partition`."""
    targets: Annotated[
        list[Annotated[str, Field(strict=True)]] | None, Field(min_length=1, examples=[["legitimate"]])
    ] = None
    """The receivers that faults hit; all by default."""
    every: Annotated[Mean, Field(examples=[200])]
    """The mean number of slots from the end of a receiver's fault to its next one, and of a partition to the next one."""
    lasting: Annotated[Mean, Field(examples=[50])]
    """The mean duration of a fault, in slots."""
    start: Annotated[Slot, Field(alias="from", examples=[100])] = 0
    """The first slot in which a fault may begin."""
    to: Annotated[Slot | None, Field(examples=[1800])] = None
    """The slot by which all faults are over; `slots` by default."""
    seed: Annotated[int | None, Field(ge=0, lt=2**256, strict=True, examples=[3])] = None
    """The seed of the faults; that of the scenario by default."""
    state: Annotated[Literal["prior", "last"] | None, Field(examples=["last"])] = None
    """The state with which a killed receiver is restarted: `prior` (default), or its `last` estimate."""
    set: Annotated[dict[str, Any] | None, Field(min_length=1, examples=[{"quality": 0.2}])] = None
    """What the fault `set` changes on a link."""

    def mistakes(self) -> Iterator[Mistake]:
        """Entries that a fault lacks or that no fault uses, a span that ends before it begins, and names that appear twice."""
        drawn = {name: fault for name in self.faults if (fault := fault_of(name)) is not None}
        for name, fault in drawn.items():
            for entry, words in fault.needs.items():
                if getattr(self, entry) is None:
                    example = f"{entry} = {self._example(entry)}"
                    yield entry, f"is missing, but the fault {name} is drawn; expected {words}: {example}"
        used = {entry for fault in drawn.values() for entry in fault.entries}
        for name, kind in EVENTS.items():
            for entry in kind.fault.entries if kind.fault is not None else ():
                if entry not in used and getattr(self, entry) is not None:
                    yield entry, f'is given, but "{name}" is not among faults; add it, or remove the line'
        for entry, names in (("faults", self.faults), ("targets", self.targets or [])):
            if len({*names}) < len(names):
                yield entry, "has a name twice; expected each once"
        if self.to is not None and self.to <= self.start:
            yield "to", f"is {self.to}, not after from, which is {self.start}; expected a later slot"
