"""The household: a house with a battery and solar cells, its energies, and what receivers can infer about its activity.

Totals over a run are the energy bought and sold, the change by perfect knowledge, and how much an estimate of the battery
reveals about the house: when people are at home and active. A day is divided into windows. In some of them the house is
*active*: its mean load is at or above a threshold, which hardly happens unless somebody cooks or washes. A receiver that has
guessed the load of every window takes the larger guesses for activity. The measure of success is the area under the curve of
detections over false alarms: 1 if the guess for every active window is above that for every quiet one, ½ for a coin.

Source: docs/scenario.md, household; docs/microgrid.md, energy and privacy; docs/metrics.md, household.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self, final

import numpy as np
from pydantic import Field

from evedrop.model.controllers import Assignment, Controller, held
from evedrop.model.metrics.text import percent_estimate
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Process, product
from evedrop.model.receiver import Flags
from evedrop.model.slot.records import SensorSlots
from evedrop.results.folder import private_pictures
from evedrop.scenario.application import (
    RECEIVERS,
    STANDARD_ERRORS,
    Application,
    ApplicationTally,
    ControlledPlant,
    DrawnFlow,
    DrawnLevel,
    Kind,
    Panel,
    PanelCurve,
    PanelFeed,
    PowerFeed,
    Sketch,
    Spot,
    Summary,
    nested,
)
from evedrop.scenario.table import Table
from evedrop.score.energy import Meter, energy
from evedrop.show.view.palette import PLANT, TRUTH_CURVE
from evedrop.studies.applications.house_outline import GRID, HEIGHT, OUTLINE, SUN, WIDTH

if TYPE_CHECKING:
    import pyarrow as pa


def means(values: Floats, window: int) -> Floats:
    """Means over each window, (windows, …), of values (slots, …). An incomplete last window is left out."""
    windows = len(values) // window
    mean: Floats = values[: windows * window].reshape(windows, window, *values.shape[1:]).mean(axis=1)
    return mean


def active(load: Floats, window: int, threshold: float) -> Flags:
    """Whether the house is active in each window, (windows,); load: (slots,), in kW like the threshold."""
    return np.greater_equal(means(load, window), threshold)


def area(score: Floats, truth: Flags) -> float:
    """Area under the curve: how often an active window scores above a quiet one, ties counted half; NaN without both kinds.

    score: (windows,), the larger the likelier active; truth: (windows,).
    """
    on, off = score[truth], np.sort(score[~truth])
    if not len(on) or not len(off):
        return float("nan")
    below = np.searchsorted(off, on, side="left") + np.searchsorted(off, on, side="right")
    return float(0.5 * below.sum() / (len(on) * len(off)))


def detection_rate(score: Floats, truth: Flags, false_alarms: float) -> float:
    """Fraction of active windows that are detected if the fraction `false_alarms` of the quiet ones is taken for active.

    A coin decides between windows with equal scores at the threshold, so that a receiver without knowledge detects the
    fraction `false_alarms`. NaN without both kinds of windows.
    """
    on, off = score[truth], np.sort(score[~truth])[::-1]
    if not len(on) or not len(off):
        return float("nan")
    allowed = false_alarms * len(off)
    threshold = off[min(int(allowed), len(off) - 1)]
    above, alike = int(np.sum(off > threshold)), int(np.sum(off == threshold))
    fraction = min(1.0, (allowed - above) / alike)
    return float(np.mean(on > threshold) + fraction * np.mean(on == threshold))


Name = Annotated[str, Field(strict=True, min_length=1)]


class HouseholdTable(Table):
    """`[household]`: which inputs, disturbances and states of the plant are those of a house. Powers are in kW."""

    grid: Annotated[Name, Field(examples=["P_grid"])]
    """The input that is the power taken from the grid; power given to it is negative."""
    load: Annotated[Name, Field(examples=["P_load"])]
    """The disturbance that is the power which the house draws."""
    battery: Annotated[Name, Field(examples=["SOC"])]
    """The state that is the level which the load moves."""
    sun: Annotated[Name | None, Field(examples=["P_solar"])] = None
    """The disturbance that is the power of the solar panels. The neighbour knows it."""
    window_seconds: Annotated[float, Field(strict=True, gt=0.0, le=1e6, examples=[60.0])] = 60.0
    """The length of the windows in which the house is active or not, rounded to whole periods of the controller."""
    active_above: Annotated[float, Field(strict=True, gt=0.0, le=1e6, examples=[0.7])] = 0.7
    """The mean load of a window from which on the house counts as active."""
    false_alarms: Annotated[float, Field(strict=True, gt=0.0, lt=1.0, examples=[0.05])] = 0.05
    """The fraction of the quiet windows that may be taken for active."""

    def window(self, period_seconds: float) -> int:
        """The number of decisions in a window, at least 1; a decision lasts period_seconds."""
        return max(1, round(self.window_seconds / period_seconds))


def guesses_of(loop: ControlledPlant, table: HouseholdTable, trials: int) -> dict[str, LoadGuess]:
    """Receiver → the guess of the load from its estimates."""
    sun = None if table.sun is None else loop.disturbance(table.sun)
    house = HousePlaces(loop.state(table.battery), loop.disturbance(table.load), sun)
    shone = np.zeros(loop.slots) if sun is None else loop.disturbances[:, sun]
    assignment, strategy = loop.assignment, loop.strategy
    return {name: LoadGuess(assignment, strategy(assignment, trials), house, shone) for name in loop.receivers}


@final
class HousePower(PowerFeed):
    """A house's grid power over a set of trials, and that of a controller that sees the truth."""

    def __init__(self, loop: ControlledPlant, table: HouseholdTable, trials: int) -> None:
        own = loop.strategy(loop.assignment, trials)
        self._plant, self._grid = loop.plant, loop.input(table.grid)
        self._perfect = PerfectLoop(loop.process, loop.plant, own, loop.period, loop.disturbances)
        self._watermark: Floats | None = None

    def take_monitored(self, sensor: SensorSlots) -> None:
        """Both loops have the watermark."""
        self._watermark = sensor.watermark

    def take(self, x: Floats, u: Floats) -> tuple[Floats, Floats]:
        """Add the next slots."""
        return self._plant.limited(u)[:, self._grid], self._perfect.follow(x, u, self._watermark)[:, self._grid]


@final
class HouseholdTally(ApplicationTally):
    """A house's tally over a set of trials, whose slots come in order."""

    def __init__(self, loop: ControlledPlant, table: HouseholdTable, trials: int) -> None:
        self._table = table
        self._slot_seconds = loop.slot_seconds
        self._disturbances = loop.disturbances
        self._period = loop.period
        self._window = table.window(self._period * self._slot_seconds)
        self._power = HousePower(loop, table, trials)
        self._load = loop.disturbance(table.load)
        self._guesses = guesses_of(loop, table, trials)
        self._guessed: dict[str, list[Floats]] = {name: [] for name in loop.receivers}
        self.meter = Meter.zero(trials)
        self.done = 0
        self._alike = True
        """Whether all trials have the same slots: otherwise their energies have no common mean."""

    def add_monitored(self, x: Floats, u: Floats, sensor: SensorSlots) -> None:
        """The grid gives the watermark, too."""
        del x, u
        self._power.take_monitored(sensor)

    def add(self, x: Floats, u: Floats, estimates: Mapping[str, Floats]) -> None:
        """Add the next slots: states (c, n, R), inputs with the watermark (c, m, R), and all estimates, (c, n, R)."""
        self.meter = self.meter.then(*self._power.take(x, u))
        for row in range(-self.done % self._period, len(x), self._period):
            for name, guess in self._guesses.items():
                load = guess.take(self.done + row, estimates[name][row])
                if load is not None:
                    self._guessed[name].append(load)
        self.done += len(x)

    def __getstate__(self) -> dict[str, Any]:
        """The state without the controllers, which may hold objects bound to their process: a copy takes no further slots."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_power", "_guesses")}

    @classmethod
    def merged(cls, parts: Sequence[Self]) -> Self:
        """The tally of several sets of trials, in order. If some have fewer slots, guesses cover the slots that all have."""
        whole = copy(parts[0])
        whole.meter = Meter.of_all([part.meter for part in parts])
        whole.done = min(part.done for part in parts)
        whole._alike = all(part._alike and part.done == whole.done for part in parts)
        fewest = min(len(loads) for part in parts for loads in part._guessed.values())
        whole._guessed = {}
        for name in parts[0]._guessed:
            rows = zip(*(part._guessed[name][:fewest] for part in parts), strict=True)
            whole._guessed[name] = [np.concatenate(row) for row in rows]
        return whole

    @property
    def of_trials(self) -> Mapping[tuple[str, ...], Floats]:
        """Every metric of every trial, (R,); NaN or infinite where it does not exist."""
        meter, seconds = self.meter, self._slot_seconds if self._alike else math.nan
        apart = meter.difference
        detected = self._detected(self._active)
        return {
            ("bought_energy",): energy(meter.bought, seconds),
            ("sold_energy",): energy(meter.sold, seconds),
            ("knowing_truth", "bought_energy"): energy(meter.other_bought, seconds),
            ("knowing_truth", "sold_energy"): energy(meter.other_sold, seconds),
            ("net_difference",): apart.net,
            ("total_difference",): apart.total,
            ("summed_difference",): apart.summed,
            **{(RECEIVERS, name, "activity_area"): areas for name, (areas, _) in detected.items()},
            **{(RECEIVERS, name, "detection_rate"): rates for name, (_, rates) in detected.items()},
        }

    def summary(self) -> dict[str, Any]:
        """The summary's entry: means over trials, and the number of windows; None for metrics that do not exist."""
        told = nested({place: _mean(values) for place, values in self.of_trials.items()})
        receivers, active = told.pop(RECEIVERS), self._active
        return {**told, "windows": len(active), "active_windows": int(active.sum()), RECEIVERS: receivers}

    @property
    def _active(self) -> Flags:
        """Whether the house was active, for each window that has ended, (windows,)."""
        load = means(self._disturbances[:, self._load], self._period)
        return active(load[: self._periods], self._window, self._table.active_above)

    @property
    def _periods(self) -> int:
        return min(len(loads) for loads in self._guessed.values())

    def _detected(self, active: Flags) -> dict[str, Floats]:
        """Receiver → the area and the rate of its detection, for each trial, (2, R); NaN before a window has ended, (2, 1)."""
        told = {}
        for name, loads in self._guessed.items():
            told[name] = np.full((2, 1), np.nan)
            if len(active):
                guesses = means(np.stack(loads[: self._periods]), self._window).T
                told[name] = np.array(
                    [
                        [area(guess, active) for guess in guesses],
                        [detection_rate(guess, active, self._table.false_alarms) for guess in guesses],
                    ]
                )
        return told


def _mean(values: Floats) -> float | None:
    """The mean over trials; None if a trial has no value."""
    mean = float(np.mean(values))
    return mean if np.isfinite(mean) else None


@final
class PerfectLoop:
    """The other loop; slots come in order from 0.

    controller: a new one, used by nothing else; period: slots between its decisions; disturbances: (slots, q).
    """

    def __init__(
        self, process: Process, plant: Plant, controller: Controller, period: int, disturbances: Floats
    ) -> None:
        self._process = process
        self._plant, self._controller, self._period = plant, controller, period
        self._disturbances = disturbances
        self._next = 0
        self._e: Floats = np.zeros((process.n, controller.trials))
        self._u: Floats = np.zeros((plant.inputs, controller.trials))
        self._decided = self._u
        self._moved = self._e

    def follow(self, x: Floats, u: Floats, e: Floats | None = None) -> Floats:
        """The other loop's inputs of the next slots, (c, m, R), within their limits.

        x (c, n, R), u (c, m, R): of this loop; e (c, m, R): the watermark, which is in u, and which the other loop gets, too.
        """
        others, moved = np.empty(u.shape), self._plant.moved(u)
        for row, state in enumerate(x):
            if self._next % self._period == 0:
                decided = self._controller.decide(self._next, state - self._e, self._disturbances[self._next])
                self._u, self._moved = self._plant.limited(decided), self._plant.moved(decided)
                self._decided = decided
            if e is not None:
                asked = self._decided + e[row]
                self._u, self._moved = self._plant.limited(asked), self._plant.moved(asked)
            others[row] = self._u
            self._e = self._process.predict(self._e) + (moved[row] - self._moved)
            self._next += 1
        return others


_TRUSTED_FRACTION = 0.9
"""The fraction of a guess that the copy of the controller is told. A controller that compensates the load at once leaves no
trace in the level, and a copy that is told all of a wrong guess would confirm that guess forever."""


@dataclass(frozen=True)
class HousePlaces:
    """The places of a house's quantities in its plant: indices of a state and of disturbances."""

    battery: int
    load: int
    sun: int | None


@final
class LoadGuess:
    """Guesses, one for each decision; decisions come in order from slot 0.

    controller: a new copy of the house's; sun: known power in every slot, (slots,).
    """

    def __init__(self, assignment: Assignment, controller: Controller, house: HousePlaces, sun: Floats) -> None:
        self._assignment, self._controller, self._house, self._sun = assignment, controller, house, sun
        self._power, self._driven = held(assignment)
        self._disturbed = held(assignment, assignment.plant.disturbance_matrix)[1]
        self._u: Floats = np.zeros((assignment.plant.inputs, controller.trials))
        self._level: Floats | None = None
        """The level that would be reached without load, (R,)."""

    def take(self, k: int, x_hat: Floats) -> Floats | None:
        """Mean load in kW of the period that ends with slot k, (R,); None at slot 0. x_hat: estimate of the state, (n, R)."""
        house, assignment = self._house, self._assignment
        guess = None
        d = np.zeros((assignment.plant.disturbance_matrix.shape[1], x_hat.shape[1]))
        if self._level is not None:
            guess = (x_hat[house.battery] - self._level) / self._disturbed[house.battery, house.load]
            d[house.load] = _TRUSTED_FRACTION * np.maximum(guess, 0.0)
        shone = self._sun[k : k + assignment.period]
        if house.sun is not None and len(shone):
            d[house.sun] = shone[0]
        self._u = assignment.plant.limited(self._controller.decide(k, x_hat, d))
        level = product(self._power, x_hat) + product(self._driven, self._u)
        if house.sun is not None and len(shone):
            level += self._disturbed[:, house.sun, None] * shone.mean()
        self._level = level[house.battery]
        return guess


ENERGY, GUESSES = "energy", "guesses"
"""Paths of panels."""


@final
class Household(Application):
    """A house behind a meter."""

    table = HouseholdTable
    names: ClassVar[Mapping[str, Kind]] = {
        "grid": "inputs",
        "load": "disturbances",
        "sun": "disturbances",
        "battery": "states",
    }
    powers = ("grid", "load", "sun")
    metrics = ("bought_energy", "sold_energy", "net_difference", "total_difference", "summed_difference")
    receiver_metrics = ("activity_area", "detection_rate")
    has_power = True
    example = "microgrid"

    @classmethod
    def power(cls, loop: ControlledPlant, table: Table, trials: int) -> HousePower:
        """The grid power."""
        return HousePower(loop, _house(table), trials)

    @classmethod
    def tally(cls, loop: ControlledPlant, table: Table, trials: int) -> HouseholdTally:
        """A tally over no slots yet."""
        return HouseholdTally(loop, _house(table), trials)

    @classmethod
    def lines(cls, summary: Summary) -> list[str]:
        """Energy bought and sold, the cost of secrecy and losses, and what activity receivers detect."""
        seen = {
            **summary["knowing_truth"],
            STANDARD_ERRORS: summary.get(STANDARD_ERRORS, {}).get("knowing_truth", {}),
        }
        lines = (
            []
            if summary["bought_energy"] is None
            else [
                f"the house buys {_kwh(summary, 'bought')} kWh and sells {_kwh(summary, 'sold')} kWh; a "
                f"controller that sees the truth, {_kwh(seen, 'bought')} and {_kwh(seen, 'sold')} kWh"
            ]
        )
        fractions = [summary[f"{name}_difference"] for name in ("net", "total", "summed")]
        if None not in fractions:
            errors = [cls.standard_error(summary, (f"{name}_difference",)) for name in ("net", "total", "summed")]
            net, total, summed = (percent_estimate(*pair) for pair in zip(fractions, errors, strict=True))
            lines.append(
                f"grid power differs from that controller's by {net} in net energy, {total} in total, "
                f"{summed} summed slot by slot"
            )
        areas = {name: receiver["activity_area"] for name, receiver in summary["receivers"].items()}
        if None not in areas.values():
            told = ", ".join(f"{name} {cls.text(summary, (name, 'activity_area'), '.3f')}" for name in areas)
            windows = f"{summary['active_windows']} active windows of {summary['windows']}"
            lines.append(f"detection of the {windows} (1 is certainty, 0.5 is guessing): {told}")
        return lines

    @classmethod
    def panels(cls, loop: ControlledPlant, table: Table) -> tuple[Panel, ...]:
        """The energies, and the load with every receiver's guess of it."""
        house = _house(table)
        load = means(loop.disturbances[:, loop.disturbance(house.load)], min(loop.period, loop.slots))
        most = float(load.max())  # the panel need not be as high as wrong guesses
        # Points: a guess that jumps appears as a cloud, and hides no other.
        guesses = tuple(PanelCurve(name, drawn="points", width=1.6) for name in loop.receivers)
        return (
            Panel(
                ENERGY, "Energy bought and sold (kWh)", (PanelCurve("bought", PLANT[0]), PanelCurve("sold", PLANT[1]))
            ),
            Panel(
                GUESSES,
                f"{loop.disturbance_labels[loop.disturbance(house.load)]}, and what each would guess from its estimate",
                (PanelCurve("Truth", TRUTH_CURVE, "steps", 1.4, "truth"), *guesses),
                (-0.1 * most, 1.15 * most),
                with_beliefs=True,
            ),
        )

    @classmethod
    def drawing(cls, loop: ControlledPlant, table: Table) -> Sketch:
        """Sun, load and grid with the power that each gives or takes, the battery, and the first other store."""
        house, plant = _house(table), loop.plant
        battery = loop.state(house.battery)
        levels = [_store(loop, "battery", battery, (4.0, 5.4))]
        load = DrawnFlow("load", "load", loop.flow({}, {house.load: 1.0}), (6.0, 4.8), (6.0, 6.3), (6.0, 6.4))
        grid = loop.flow({house.grid: 1.0}, {})
        flows = [load, DrawnFlow("from grid", "to grid", grid, (11.0, 4.4), (8.9, 4.4), (10.2, 3.3))]
        lines = (*OUTLINE, *GRID)
        if house.sun is not None:
            flows.append(DrawnFlow("sun", "sun", loop.flow({}, {house.sun: 1.0}), (1.6, 0.8), (3.7, 1.85), (1.6, 1.65)))
            lines += SUN
        rows = np.hstack([plant.disturbance_matrix, plant.input_matrix])
        moved = rows[:, len(loop.disturbance_names) + loop.input(house.grid)]
        if moved[battery]:
            charge = tuple((rows[battery] / moved[battery]).tolist())
            flows.append(DrawnFlow("", "", charge, (5.8, 4.4), (4.6, 4.4), (5.2, 4.0)))
        for state in [i for i in range(len(loop.states)) if i != battery][:1]:
            name = loop.states[state]
            levels.append(_store(loop, _STORES.get(name, name), state, (8.0, 5.4)))
            movers = [i for i, name in enumerate(loop.inputs) if name != house.grid and plant.input_matrix[state, i]]
            for i in movers[:1]:
                words = _CONVERTERS.get(loop.states[state], (loop.inputs[i],) * 2)
                own = loop.flow({loop.inputs[i]: 1.0}, {})
                flows.append(DrawnFlow(*words, own, (7.4, 4.4), (6.2, 4.4), (6.9, 2.4)))
        return Sketch((WIDTH, HEIGHT), lines, tuple(levels), tuple(flows), loop.largest_flow)

    @classmethod
    def feed(cls, loop: ControlledPlant, table: Table) -> PanelFeed:
        """What fills its panels."""
        return HouseholdFeed(loop, _house(table))

    @classmethod
    def draw_sweep(cls, path: Path, table: pa.Table, key: str) -> None:
        """Draw energies, differences and detection."""
        from evedrop.studies.applications.microgrid.sweep_picture import draw  # noqa: PLC0415 - matplotlib takes half a second

        draw(private_pictures(path), table, key)


@final
class HouseholdFeed(PanelFeed):
    """The energies since slot 0, the load, and the guesses of it, in one trial."""

    def __init__(self, loop: ControlledPlant, table: HouseholdTable) -> None:
        self._period, self._seconds = loop.period, loop.slot_seconds
        self._grid = loop.input(table.grid)
        self._load = loop.disturbances[:, loop.disturbance(table.load)]
        self._guesses = guesses_of(loop, table, 1)
        self._sums: Floats = np.zeros(2)

    def take(self, first: int, u: Floats, estimates: Mapping[str, Floats]) -> Mapping[str, Floats]:
        """Add the next slots."""
        grid, slots = u[:, self._grid], np.arange(first, first + len(u), dtype=np.float64)
        sums = self._sums + np.cumsum(np.stack([np.maximum(grid, 0.0), np.maximum(-grid, 0.0)], axis=1), axis=0)
        self._sums = sums[-1]
        bought, sold = energy(sums, self._seconds).T
        load = self._load[first : first + len(u)]
        return {
            f"{ENERGY}/bought": np.stack([slots, bought]),
            f"{ENERGY}/sold": np.stack([slots, sold]),
            f"{GUESSES}/Truth": np.stack([slots, load]),
            **{f"{GUESSES}/{name}": self._guessed(name, first, estimates[name]) for name in self._guesses},
        }

    def _guessed(self, name: str, first: int, estimates: Floats) -> Floats:
        """Guesses, shown from the beginning of the period that they are for, which has ended."""
        pairs = []
        for row in range(-first % self._period, len(estimates), self._period):
            load = self._guesses[name].take(first + row, estimates[row, :, None])
            if load is not None:
                pairs.append((float(first + row - self._period), float(load[0])))
        return np.array(pairs).reshape(-1, 2).T


_STORES = {"LOH": "hydrogen"}
_CONVERTERS = {"LOH": ("fuel cell", "electrolyser")}
"""The paper's names of a store, and of what takes power from it and gives power to it."""


def _store(loop: ControlledPlant, name: str, state: int, foot: Spot) -> DrawnLevel:
    """A store in per cent, with marks at its limits."""
    limits = (float(limit[state]) for limit in (loop.plant.state_lower, loop.plant.state_upper))
    return DrawnLevel(name, state, 0.0, 100.0, foot, 3.2, tuple(limit for limit in limits if np.isfinite(limit)))


def _house(table: Table) -> HouseholdTable:
    assert isinstance(table, HouseholdTable)  # noqa: S101 - the hook gives each application its own table
    return table


def _kwh(summary: Summary, way: str) -> str:
    return Household.text(summary, (f"{way}_energy",), ".3f")
