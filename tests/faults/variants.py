"""The scenarios that the campaign disturbs: short runs, one for each way in which a live run is put together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from evedrop.scenario.loading import load
from evedrop.scenario.tables import Scenario
from tests.disturbed import ACKNOWLEDGED, LOOP, SCHEDULED, disturbed

_NAIVE = """
[eavesdroppers.naive]
strategy = "naive"
link = { quality = 0.9 }
"""
_LOOP = LOOP.format("period = 3")
_EVENTS = """
[[event]]
at = 100
link = "smart"
set = { loss = { model = "bernoulli", quality = 0.6 } }
[[event]]
from = 150
to = 220
kill = "smart"
state = "last"
[[event]]
from = 180
to = 244
pause = "naive"
[[event]]
from = 250
to = 300
cut = "legitimate"
"""


def _rich(more: str, **given: Any) -> str:
    return disturbed(400, pace=0.004, entries="record_trials = 2", more=_NAIVE + more, **given)


@dataclass(frozen=True)
class Variant:
    """A scenario, and the processes of its live run."""

    name: str
    source: str
    """A shipped scenario, or the text of one."""
    changes: Mapping[str, object]
    receivers: tuple[str, ...]
    more: tuple[str, ...] = ()
    """`relay` and `controller`, where there are such processes."""
    shards: int = 1
    view: str = "off"
    hosts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Host → its processes, where a run is over ssh; the others are here."""

    @property
    def processes(self) -> tuple[str, ...]:
        """All that the launcher starts, for each shard."""
        return ("router", "sensor", "recorder", *self.receivers, *self.more)

    def path(self, folder: Path) -> str:
        """What is typed for it: the name of a shipped scenario, or a file written into a folder."""
        if "\n" not in self.source:
            return self.source
        path = folder / f"{self.name}.toml"
        path.write_text(self.source, encoding="utf-8")
        return str(path)

    def scenario(self, folder: Path) -> Scenario:
        """The scenario itself."""
        return load(self.path(folder), self.changes)

    @property
    def options(self) -> list[str]:
        """Of `evedrop run`."""
        return [
            "--view",
            self.view,
            *(word for key, value in self.changes.items() for word in ("--set", f"{key}={value}")),
        ]


_EVES = ("legitimate", "naive", "suspicious", "smart")
_TWO = ("legitimate", "naive", "smart")
_SHORT: Mapping[str, object] = {"slots": 400, "pace": 0.004}

VARIANTS: Mapping[str, Variant] = {
    one.name: one
    for one in (
        Variant("plain", "eavesdroppers", _SHORT, _EVES),
        Variant("fast", "eavesdroppers", {"slots": 6000}, _EVES),
        Variant("batch", "eavesdroppers", {**_SHORT, "trials": 60, "record_trials": 3}, _EVES),
        Variant("viewed", "eavesdroppers", _SHORT, _EVES, view="web"),
        Variant("events", _rich(_EVENTS), {}, _TWO),
        Variant("acknowledged", _rich(ACKNOWLEDGED, encoding=SCHEDULED, strategy="naive"), {}, _TWO),
        Variant("loop", _rich(_LOOP, more_of_legitimate="knows_input = true"), {}, _TWO, ("controller",)),
        Variant(
            "relayed", _rich(_LOOP + "[network]\nrouters = 2\n"), {}, _TWO, ("controller", "relay")
        ),
        Variant("shards", "eavesdroppers", {**_SHORT, "trials": 20, "record_trials": 12, "shards": 2}, _EVES, shards=2),
    )
}  # fmt: skip

HOSTED: Mapping[str, Variant] = {
    variant.name: variant
    for variant in (
        Variant(
            "hosts", "eavesdroppers", _SHORT, _EVES,
            hosts={"alpha": ("router", "sensor", "legitimate"), "beta": ("naive", "smart")},
        ),
        Variant(
            "sites", VARIANTS["relayed"].source, {}, _TWO, ("controller", "relay"),
            hosts={"alpha": ("router", "sensor", "controller"), "beta": ("relay", "legitimate", "naive")},
        ),
    )
}  # fmt: skip
"""Runs over ssh, each with some processes here: on two hosts, and at two sites with a router each."""
