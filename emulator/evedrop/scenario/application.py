"""The hook for applications: uses of a closed loop's plant.

An application has a table of its own in a scenario, metrics in the summary and in expectations, lines in the closing report,
panels in the view and a picture of a sweep. Nothing else names an application: it asks those whose tables a scenario contains.

Source: docs/your-own/application.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np

from evedrop.model.controllers import Assignment, Controller
from evedrop.model.integrity.monitor import MonitorPlan
from evedrop.model.metrics import error_column
from evedrop.model.metrics.standard_error import standard_error
from evedrop.model.metrics.text import estimate, percent_estimate
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Process
from evedrop.model.registry import Registry
from evedrop.model.slot.records import SensorSlots
from evedrop.scenario.table import Table

if TYPE_CHECKING:
    import pyarrow as pa

Summary = Mapping[str, Any]
"""An application's entry of the summary: its metrics by name, and under `receivers` those of each receiver."""
Kind = Literal["inputs", "disturbances", "states"]
"""A kind of quantity that has names."""
RECEIVERS, STANDARD_ERRORS = "receivers", "standard_errors"


@dataclass(frozen=True)
class ControlledPlant:
    """A plant with its controller, as an application sees it."""

    assignment: Assignment
    """What the controller knows, process and plant included."""
    strategy: type[Controller]
    around: Floats
    """The reference of the states, (n,): states and estimates are deviations from it."""
    disturbances: Floats
    """The disturbances of every slot, (slots, q)."""
    states: tuple[str, ...]
    """Names of the n states; empty if the scenario gives none."""
    inputs: tuple[str, ...]
    """Names of the m inputs."""
    disturbance_names: tuple[str, ...]
    disturbance_labels: tuple[str, ...]
    """The same with their units, if the scenario gives units."""
    receivers: tuple[str, ...]
    """The legitimate estimator first."""
    on_truth: bool = False
    """Whether the controller acts on the true state."""
    spoofed: tuple[tuple[int, int], ...] = ()
    """The slots [from, to) of events in which the measurements are attacked; without such events an attack lasts all run."""

    def flow(self, inputs: Mapping[str, float], disturbances: Mapping[str, float]) -> tuple[float, ...]:
        """Factors of the disturbances, then of the inputs; those that are not named have 0."""
        given = [disturbances.get(name, 0.0) for name in self.disturbance_names]
        return (*given, *(inputs.get(name, 0.0) for name in self.inputs))

    @property
    def largest_flow(self) -> float:
        """The largest disturbance of the run, or limit of an input, if any is above 0; otherwise 1."""
        limits = np.abs(np.concatenate([self.plant.input_lower, self.plant.input_upper]))
        values = np.concatenate([limits[np.isfinite(limits)], np.abs(self.disturbances).ravel()])
        return float(values.max(initial=0.0)) or 1.0

    @property
    def process(self) -> Process:
        """The process."""
        return self.assignment.process

    @property
    def plant(self) -> Plant:
        """The plant."""
        return self.assignment.plant

    @property
    def period(self) -> int:
        """Slots between two decisions."""
        return self.assignment.period

    @property
    def slot_seconds(self) -> float:
        """The duration of a slot in seconds."""
        return self.assignment.slot_seconds

    @property
    def slots(self) -> int:
        """Slots of the run."""
        return len(self.disturbances)

    def state(self, name: str) -> int:
        """The index of a state."""
        return self.states.index(name)

    def input(self, name: str) -> int:
        """The index of an input."""
        return self.inputs.index(name)

    def disturbance(self, name: str) -> int:
        """The index of a disturbance."""
        return self.disturbance_names.index(name)


def nested(values: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    """A table, with tables in it, of values at places."""
    table: dict[str, Any] = {}
    for (*outer, name), value in values.items():
        inner = table
        for part in outer:
            inner = inner.setdefault(part, {})
        inner[name] = value
    return table


class ApplicationTally(ABC):
    """An application's tally over a set of trials, whose slots come in order. Pickled between processes."""

    @abstractmethod
    def add(self, x: Floats, u: Floats, estimates: Mapping[str, Floats]) -> None:
        """Add the next c slots: true states (c, n, R), inputs with the watermark (c, m, R), and all estimates, (c, n, R)."""

    def add_monitored(self, x: Floats, u: Floats, sensor: SensorSlots) -> None:
        """Add watermark and detector of the next c slots, before these go to `add`; by default nothing. u: as decided."""
        del x, u, sensor

    @classmethod
    @abstractmethod
    def merged(cls, parts: Sequence[Self]) -> Self:
        """The tally of several sets of trials, in order."""

    @abstractmethod
    def summary(self) -> Summary:
        """The summary's entry: every metric, a number or None; under `receivers`, each receiver's metrics by its name."""

    @property
    def of_trials(self) -> Mapping[tuple[str, ...], Floats]:
        """The place of a metric in the summary's entry → what it is the mean of, for every trial, (R,); by default none.

        These metrics have standard errors, at the same places of `standard_errors` in the entry.
        """
        return {}

    def entry(self) -> Summary:
        """The summary's entry, with the standard errors of its metrics if there are any."""
        errors = nested({place: standard_error(values) for place, values in self.of_trials.items()})
        return {**self.summary(), **({STANDARD_ERRORS: errors} if errors else {})}


@dataclass(frozen=True)
class PanelCurve:
    """One curve of a panel."""

    name: str
    """Its name in the recording; a receiver's name for a curve of its beliefs."""
    colour: tuple[int, int, int] | None = None
    """None: the colour of the receiver of this name."""
    drawn: Literal["line", "steps", "points"] = "line"
    width: float = 1.8
    label: str | None = None
    """What the view calls it. None: its name."""


@dataclass(frozen=True)
class Panel:
    """A panel of the view. Its curves are drawn over the slots of the run."""

    path: str
    """Its path in the recording, one word."""
    title: str
    curves: tuple[PanelCurve, ...]
    span: tuple[float, float] | None = None
    """Lowest and highest value shown; None: fitted to the curves."""
    with_beliefs: bool = False
    """Whether it is placed with the panels of the receivers' beliefs, rather than with those of the plant."""


Spot = tuple[float, float]
"""A place in a drawing: to the right, and downwards."""


@dataclass(frozen=True)
class DrawnLevel:
    """A state in a drawing: an upright bar, filled up to it, with its name and value below."""

    name: str
    state: int
    low: float
    """The value of an empty bar."""
    high: float
    """The value of a full one."""
    foot: Spot
    """The middle of its lower end."""
    top: float
    """How far down its upper end is."""
    marks: tuple[float, ...] = ()
    """Values with a mark beside the bar, such as limits."""


@dataclass(frozen=True)
class DrawnFlow:
    """A power in a drawing: an arrow as wide as it is large."""

    positive: str
    """The words before its value where it is positive; with no words there is no value."""
    negative: str
    weights: tuple[float, ...]
    """It is the sum of disturbances, then inputs, with these factors."""
    start: Spot
    """The other end where it is negative."""
    end: Spot
    label: Spot
    signed: bool = False
    """Whether the value has a sign."""


@dataclass(frozen=True)
class Sketch:
    """A drawing of a plant: what never changes, its states, and the powers that move it."""

    size: Spot
    lines: tuple[tuple[Spot, ...], ...]
    levels: tuple[DrawnLevel, ...]
    flows: tuple[DrawnFlow, ...]
    most: float
    """The power in kW whose arrow is the widest."""


class PanelFeed(ABC):
    """The values of an application's panels in one trial, whose slots come in order."""

    @abstractmethod
    def take(self, first: int, u: Floats, estimates: Mapping[str, Floats]) -> Mapping[str, Floats]:
        """Add slots from `first` on: inputs and watermark, within their limits, (c, m); estimates as deviations, (c, n).

        Returns PATH/CURVE → slots and values of its g new points, (2, g).
        """

    def take_monitored(self, first: int, sensor: SensorSlots) -> Mapping[str, Floats]:
        """The points of curves from watermark and detector of these slots, of one trial; by default none."""
        del first, sensor
        return {}


class PowerFeed(ABC):
    """The power that an application takes from the grid in a set of trials, whose slots come in order."""

    def take_monitored(self, sensor: SensorSlots) -> None:
        """Take watermark and detector of the next c slots, before these go to `take`; by default nothing."""
        del sensor

    @abstractmethod
    def take(self, x: Floats, u: Floats) -> tuple[Floats, Floats]:
        """Add the next c slots: true states (c, n, R), and inputs with the watermark (c, m, R).

        Returns its power in each of them, and that of a controller that sees the truth, in kW, (c, R) each; negative if sold.
        """


class Application(ABC):
    """A use of a plant with a controller. A class, never an instance, is registered.

    The name of its entry point is also the name of its table in a scenario, and of its entry in the summary.
    """

    table: ClassVar[type[Table]]
    """The entries of its table."""
    names: ClassVar[Mapping[str, Kind]]
    """The entries of its table that name an input or a disturbance of the plant, or a state of the process."""
    powers: ClassVar[tuple[str, ...]] = ()
    """Those of `names` that are powers in kW: its metrics are energies, which need the duration of a slot."""
    metrics: ClassVar[tuple[str, ...]]
    """Its metrics in the summary that expectations and sweeps can use."""
    receiver_metrics: ClassVar[tuple[str, ...]] = ()
    """Its metrics for each receiver, likewise."""
    served_metrics: ClassVar[tuple[str, ...]] = ()
    """Those of `metrics` that `evedrop run --metrics` serves."""
    has_monitor: ClassVar[bool] = False
    """Whether it can have a monitor."""
    has_power: ClassVar[bool] = False
    """Whether it has a `power`, so that `evedrop cost` can compute the energy that secrecy costs it."""
    example: ClassVar[str | None] = None
    """A shipped scenario that has it, for messages; None for an application of a package."""

    @classmethod
    def objections(cls, loop: ControlledPlant, table: Table) -> list[str]:
        """Mistakes that only show with a valid process, plant and controller: "ENTRY: what is wrong"; by default none."""
        del loop, table
        return []

    @classmethod
    def monitor(cls, loop: ControlledPlant, table: Table) -> MonitorPlan | None:
        """The watermark, the detector for the sensor's filter and the attack that it wants; by default none."""
        del loop, table
        return None

    @classmethod
    def power(cls, loop: ControlledPlant, table: Table, trials: int) -> PowerFeed | None:
        """The power that it takes, from slot 0 on; by default none. trials: R."""
        del loop, table, trials
        return None

    @classmethod
    @abstractmethod
    def tally(cls, loop: ControlledPlant, table: Table, trials: int) -> ApplicationTally:
        """A new tally, of no slots yet; table: an instance of `cls.table`; trials: R."""

    @classmethod
    def lines(cls, summary: Summary) -> list[str]:
        """Its lines in the closing report; by default none."""
        del summary
        return []

    @classmethod
    def panels(cls, loop: ControlledPlant, table: Table) -> tuple[Panel, ...]:
        """Its panels in the view; by default none."""
        del loop, table
        return ()

    @classmethod
    def drawing(cls, loop: ControlledPlant, table: Table) -> Sketch | None:
        """A drawing of its plant, which the view shows as what happens; by default none, so that curves take its place."""
        del loop, table
        return None

    @classmethod
    def feed(cls, loop: ControlledPlant, table: Table) -> PanelFeed | None:
        """The source of its panels' values; None if it has no panels."""
        del loop, table
        return None

    @classmethod
    def draw_sweep(cls, path: Path, table: pa.Table, key: str) -> None:
        """Draw its metrics in a sweep over the entry `key`, as the new files `path`.png and `path`.pdf; by default nothing."""
        del path, table, key

    @classmethod
    def metric(cls, summary: Summary, path: Sequence[str]) -> float | None:
        """A metric by its path, as in an expectation but without the application's name: METRIC, or RECEIVER and METRIC."""
        inner: Any = summary
        for part in _place(path):
            inner = inner[part]
        return None if inner is None else float(inner)

    @classmethod
    def standard_error(cls, summary: Summary, path: Sequence[str]) -> float | None:
        """The standard error of a metric by its path, as above; None if it has none."""
        inner: Any = summary.get(STANDARD_ERRORS, {})
        for part in _place(path):
            inner = {} if inner is None else inner.get(part)
        return None if inner is None else float(inner)

    @classmethod
    def text(cls, summary: Summary, path: Sequence[str], how: str = ".4g") -> str:
        """A metric by its path, as above, with its standard error: 0.0123 ± 0.0004; how: its format without one."""
        return estimate(cls.metric(summary, path), cls.standard_error(summary, path), how)

    @classmethod
    def percent(cls, summary: Summary, name: str) -> str:
        """A metric of the run that is a fraction, in per cent, with its standard error: 12.3 ± 0.4 %."""
        return percent_estimate(cls.metric(summary, [name]), cls.standard_error(summary, [name]), ".3g")

    @classmethod
    def sweep_columns(cls, summary: Summary, receiver: str) -> dict[str, float | None]:
        """Its columns in a receiver's row of a sweep's table: column → value."""
        paths = {name: [name] for name in cls.metrics} | {name: [receiver, name] for name in cls.receiver_metrics}
        columns = {name: cls.metric(summary, path) for name, path in paths.items()}
        return columns | {error_column(name): cls.standard_error(summary, path) for name, path in paths.items()}


def _place(path: Sequence[str]) -> Sequence[str]:
    """The place of a metric in its application's entry of the summary."""
    return (RECEIVERS, *path) if len(path) > 1 else path


APPLICATIONS: Registry[Application] = Registry(
    "application",
    Application,  # type: ignore[type-abstract]
    "evedrop.applications",
    {},
)
"""By the name of the table. All are found by entry points; those of Evedrop are in its own pyproject.toml."""


def is_own(application: type[Application]) -> bool:
    """Whether an application comes with Evedrop, so that its failure is a bug."""
    return application.__module__.startswith("evedrop.")


def applications_in(tables: Iterable[str], besides: Container[str] = ()) -> dict[str, type[Application]]:
    """Name → application, for those of these names that are applications and can be loaded.

    besides: names that cannot be applications.
    """
    return {name: APPLICATIONS[name] for name in tables if name not in besides and name in APPLICATIONS}
