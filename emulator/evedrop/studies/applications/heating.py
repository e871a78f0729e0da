"""The comfort of a heated room: how long it is too cold or too warm, how much the heater heats, and whether receivers can tell.

Source: docs/scenario.md, comfort.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from typing import Annotated, ClassVar, Self, final

import numpy as np
from pydantic import Field

from evedrop.model.process import Floats
from evedrop.scenario.application import (
    RECEIVERS,
    Application,
    ApplicationTally,
    ControlledPlant,
    DrawnFlow,
    DrawnLevel,
    Kind,
    Panel,
    PanelCurve,
    PanelFeed,
    Sketch,
    Summary,
)
from evedrop.scenario.table import Mistake, Number, Table
from evedrop.show.view.palette import PLANT
from evedrop.studies.applications.house_outline import HEIGHT, OUTLINE, RADIATOR, WIDTH

_HOUR = 3600.0
_ENERGY, _DISCOMFORT = "heating", "discomfort"

Name = Annotated[str, Field(strict=True, min_length=1)]


class ComfortTable(Table):
    """`[comfort]`: the room's temperature in °C, the heater's power in kW, and the temperatures that are comfortable."""

    temperature: Annotated[Name, Field(examples=["T_room"])]
    """The state that is the room's temperature, in °C."""
    heater: Annotated[Name, Field(examples=["P_heat"])]
    """The input that is the heater's power, in kW."""
    lowest: Annotated[Number, Field(examples=[20.0])]
    """The lowest comfortable temperature."""
    highest: Annotated[Number, Field(examples=[23.0])]
    """The highest comfortable temperature."""

    def mistakes(self) -> Iterator[Mistake]:
        """A range without temperatures."""
        if self.lowest >= self.highest:
            yield "lowest", f"is {self.lowest}, and highest is {self.highest}; expected lowest < highest"


@final
class _Range:
    """The comfortable temperatures, for deviations of the state from the reference."""

    def __init__(self, loop: ControlledPlant, table: ComfortTable) -> None:
        self.state = loop.state(table.temperature)
        around = float(loop.around[self.state])
        self._lowest, self._highest = table.lowest - around, table.highest - around

    def outside(self, temperature: Floats) -> Floats:
        """By how much temperatures are too low or too high, in K; 0 for comfortable ones."""
        return np.maximum(self._lowest - temperature, 0.0) + np.maximum(temperature - self._highest, 0.0)


@final
class ComfortTally(ApplicationTally):
    """A room's tally over a set of trials, whose slots come in order."""

    def __init__(self, loop: ControlledPlant, table: ComfortTable, trials: int) -> None:
        self._range, self._plant = _Range(loop, table), loop.plant
        self._heater, self._hours = loop.input(table.heater), loop.slot_seconds / _HOUR
        self._outside: Floats = np.zeros(trials)
        self._power: Floats = np.zeros(trials)
        self._known = {name: np.zeros(trials, np.int64) for name in loop.receivers}
        self._slots = np.zeros(trials, np.int64)

    def add(self, x: Floats, u: Floats, estimates: Mapping[str, Floats]) -> None:
        """Add the next slots."""
        state = self._range.state
        outside = self._range.outside(x[:, state])
        self._slots += len(x)
        for row, inputs in zip(outside, u, strict=True):  # slot by slot: the same bits however the slots are divided
            self._outside = self._outside + row
            self._power = self._power + self._plant.limited(inputs)[self._heater]
        for name, count in self._known.items():
            estimated = self._range.outside(estimates[name][:, state])
            self._known[name] = count + np.count_nonzero((estimated > 0.0) == (outside > 0.0), axis=0)

    @classmethod
    def merged(cls, parts: Sequence[Self]) -> Self:
        """The tally of several sets of trials, in order."""
        whole = copy(parts[0])
        for name in ("_outside", "_power", "_slots"):
            setattr(whole, name, np.concatenate([getattr(part, name) for part in parts]))
        whole._known = {name: np.concatenate([part._known[name] for part in parts]) for name in parts[0]._known}
        return whole

    @property
    def of_trials(self) -> Mapping[tuple[str, ...], Floats]:
        """Every metric of every trial, (R,); none where trials were cut short at different slots."""
        slots = int(self._slots[0])
        if not slots or (self._slots != slots).any():
            return {}
        return {
            ("discomfort",): self._outside * self._hours,
            ("heating_energy",): self._power * self._hours,
            **{(RECEIVERS, name, "known_fraction"): counts / slots for name, counts in self._known.items()},
        }

    def summary(self) -> Summary:
        """The summary's entry: means over trials; None before the first slot, and totals of trials that are not equally long."""
        slots, alike = int(self._slots.sum()), bool(self.of_trials)
        return {
            "discomfort": float(self._outside.mean()) * self._hours if alike else None,
            "heating_energy": float(self._power.mean()) * self._hours if alike else None,
            "receivers": {
                name: {"known_fraction": int(count.sum()) / slots if slots else None}
                for name, count in self._known.items()
            },
        }


@final
class ComfortFeed(PanelFeed):
    """The heating energy and the discomfort as each receiver estimates it, since slot 0, in one trial."""

    def __init__(self, loop: ControlledPlant, table: ComfortTable) -> None:
        self._range = _Range(loop, table)
        self._heater, self._hours = loop.input(table.heater), loop.slot_seconds / _HOUR
        self._sums: dict[str, float] = {}

    def take(self, first: int, u: Floats, estimates: Mapping[str, Floats]) -> Mapping[str, Floats]:
        """Add the next slots."""
        rates = {f"{_ENERGY}/energy": u[:, self._heater]}
        for name, x_hat in estimates.items():
            rates[f"{_DISCOMFORT}/{name}"] = self._range.outside(x_hat[:, self._range.state])
        slots = np.arange(first, first + len(u), dtype=np.float64)
        curves = {}
        for path, values in rates.items():
            sums = self._sums.get(path, 0.0) + np.cumsum(values)
            self._sums[path] = float(sums[-1])
            curves[path] = np.stack([slots, sums * self._hours])
        return curves


@final
class Comfort(Application):
    """A room with a heater."""

    table = ComfortTable
    names: ClassVar[Mapping[str, Kind]] = {"temperature": "states", "heater": "inputs"}
    powers = ("heater",)
    metrics = ("discomfort", "heating_energy")
    receiver_metrics = ("known_fraction",)

    @classmethod
    def tally(cls, loop: ControlledPlant, table: Table, trials: int) -> ComfortTally:
        """A tally over no slots yet."""
        return ComfortTally(loop, _room(table), trials)

    @classmethod
    def lines(cls, summary: Summary) -> list[str]:
        """The discomfort, the energy, and how often receivers know whether the room is comfortable."""
        if any(receiver["known_fraction"] is None for receiver in summary["receivers"].values()):
            return []
        fractions = ", ".join(
            f"{name} {cls.text(summary, (name, 'known_fraction'), '.3f')}" for name in summary["receivers"]
        )
        lines = [f"fraction of slots in which each knows whether the room is comfortable: {fractions}"]
        if summary["discomfort"] is None:
            return lines
        return [
            f"the room is uncomfortable by {cls.text(summary, ('discomfort',), '.3g')} K h, and the heater gives "
            f"{cls.text(summary, ('heating_energy',), '.3g')} kWh",
            *lines,
        ]

    @classmethod
    def panels(cls, loop: ControlledPlant, table: Table) -> tuple[Panel, ...]:
        """The heater's energy, and the discomfort as each receiver estimates it."""
        del table
        return (
            Panel(_ENERGY, "Heating energy (kWh)", (PanelCurve("energy", PLANT[0]),)),
            Panel(
                _DISCOMFORT,
                "Discomfort as each estimates it (K h)",
                tuple(PanelCurve(name, width=1.2) for name in loop.receivers),
                with_beliefs=True,
            ),
        )

    @classmethod
    def drawing(cls, loop: ControlledPlant, table: Table) -> Sketch:
        """The room with the heater, and beside it the first other state, such as the temperature of the wall."""
        comfort = _room(table)
        room, wanted = loop.state(comfort.temperature), (comfort.lowest, comfort.highest)
        margin = 2.0 * (comfort.highest - comfort.lowest)
        ends = comfort.lowest - margin, comfort.highest + margin
        levels = [DrawnLevel("room", room, *ends, (6.9, 6.1), 3.5, wanted)]
        for state in [i for i in range(len(loop.states)) if i != room][:1]:
            levels.append(DrawnLevel(loop.states[state].removeprefix("T_"), state, *ends, (10.6, 6.1), 3.5))
        heat = loop.flow({comfort.heater: 1.0}, {})
        flow = DrawnFlow("heating", "heating", heat, (4.2, 4.9), (6.2, 4.9), (4.4, 5.6), signed=True)
        return Sketch((WIDTH, HEIGHT), (*OUTLINE, *RADIATOR), tuple(levels), (flow,), loop.largest_flow)

    @classmethod
    def feed(cls, loop: ControlledPlant, table: Table) -> ComfortFeed:
        """What fills its panels."""
        return ComfortFeed(loop, _room(table))


def _room(table: Table) -> ComfortTable:
    assert isinstance(table, ComfortTable)  # noqa: S101 - the hook gives each application its own table
    return table
