"""The scenarios that the campaign disturbs: short runs, one for each way in which a live run is put together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from evedrop.loading import load
from evedrop.scenario import Scenario

_RICH = """
title = "Disturbed by the campaign"
slots = {slots}
seed = 20
trials = {trials}
record_trials = {recorded}
pace = {pace}
[process]
A = [[1.0, 0.1], [0.0, 0.98]]
Q = [[0.01, 0.0], [0.0, 0.01]]
initial_covariance = [[1.0, 0.0], [0.0, 1.0]]
[encoding]
{encoding}
[legitimate]
window = 3
{more_of_legitimate}
link = {{ quality = 0.8, delay = {{ model = "normal", mean = 1.0, deviation = 1.0 }}, duplicate = 0.1, corrupt = 0.02 }}
[eavesdroppers.smart]
strategy = "{strategy}"
link = {{ loss = {{ model = "gilbert-elliott", p = 0.05, r = 0.3 }} }}
[eavesdroppers.naive]
strategy = "naive"
link = {{ quality = 0.9 }}
{more}
"""
_INNOVATION = 'scheme = "innovation"\nstate_probability = 0.5'
_SCHEDULED = 'scheme = "scheduled"\nthreshold = 3'
_ACKNOWLEDGEMENTS = """
[acknowledgements]
link = { quality = 0.8 }
attack = "critical"
jammer = "smart"
"""
_LOOP = """
[plant]
inputs = ["heater"]
input_matrix = [[0.1], [0.0]]
input_lower = [-2.0]
input_upper = [2.0]
noise = [[1e-4, 0.0], [0.0, 1e-4]]
[controller]
strategy = "lqr"
period = 3
state_weights = [1.0, 1.0]
input_weights = [0.1]
"""
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
to = 240
pause = "naive"
[[event]]
from = 250
to = 300
cut = "legitimate"
"""


def _rich(**given: str | int | float) -> str:
    entries: dict[str, str | int | float] = {
        "slots": 400,
        "trials": 3,
        "recorded": 2,
        "pace": 0.004,
        "encoding": _INNOVATION,
        "strategy": "smart",
        "more_of_legitimate": "",
        "more": "",
    }
    return _RICH.format(**{**entries, **given})


@dataclass(frozen=True)
class Variant:
    """A scenario, and who takes part in its live run."""

    name: str
    source: str
    """A shipped scenario, or the text of one."""
    changes: Mapping[str, object]
    receivers: tuple[str, ...]
    more: tuple[str, ...] = ()
    """`relay` and `controller`, where there are such processes."""
    shards: int = 1
    view: str = "off"

    @property
    def processes(self) -> tuple[str, ...]:
        """All that the launcher starts, for each shard, but the viewer."""
        return ("router", "sensor", "observer", *self.receivers, *self.more)

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
        Variant("events", _rich(more=_EVENTS), {}, _TWO),
        Variant("acknowledged", _rich(encoding=_SCHEDULED, strategy="naive", more=_ACKNOWLEDGEMENTS), {}, _TWO),
        Variant("loop", _rich(more=_LOOP, more_of_legitimate="knows_input = true"), {}, _TWO, ("controller",)),
        Variant(
            "relayed", _rich(more=_LOOP + "[network]\nrouters = 2\n"), {}, _TWO, ("controller", "relay")
        ),
        Variant("shards", "eavesdroppers", {**_SHORT, "trials": 20, "record_trials": 12, "shards": 2}, _EVES, shards=2),
    )
}  # fmt: skip
