"""`[plant]` and `[controller]`: the inputs and disturbances that move the true states, and the strategy that decides the inputs.

Source: docs/scenario.md, plant and controller.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field

from evedrop.counting import counted
from evedrop.model.controllers import CONTROLLERS, LONGEST_PERIOD, Assignment
from evedrop.model.kernels.elementary import semidefinite_factor
from evedrop.model.plant import Plant
from evedrop.model.process import MOST_STATES, Floats, Process
from evedrop.model.slot.cores import LARGEST
from evedrop.scenario.process import row_mistake, word_mistake
from evedrop.scenario.table import Labels, Matrix, Mistake, Number, Table, one_of, parameter_mistakes
from evedrop.scenario.words import as_toml

Numbers = list[Number]


class PlantTable(Table):
    """`[plant]`: inputs, disturbances, limits and noise of the true states."""

    inputs: Annotated[Labels, Field(examples=[["P_H", "P_grid"]])] = Field(default_factory=list)
    """The names of the m inputs u, which the controller decides."""
    input_matrix: Annotated[Matrix | None, Field(examples=[[[0.00156, 0.00156], [-0.00566, 0.0]]])] = None
    """B, n × m."""
    input_units: Annotated[Labels | None, Field(examples=[["kW", "kW"]])] = None
    """The units of the inputs."""
    input_lower: Annotated[Numbers | None, Field(examples=[[-1.5, -3.0]])] = None
    """Lower limits of the inputs. An input beyond its limits is clipped, and counted."""
    input_upper: Annotated[Numbers | None, Field(examples=[[1.5, 3.0]])] = None
    """Upper limits of the inputs."""
    disturbances: Annotated[Labels, Field(examples=[["P_solar", "P_load"]])] = Field(default_factory=list)
    """The names of the q disturbances d, which also move the plant."""
    disturbance_matrix: Annotated[Matrix | None, Field(examples=[[[0.00156, -0.00156], [0.0, 0.0]]])] = None
    """B_d, n × q."""
    disturbance_units: Annotated[Labels | None, Field(examples=[["kW", "kW"]])] = None
    """The units of the disturbances. Those of `disturbance_file` must be the same, except that W and kW are converted."""
    disturbance_file: Annotated[str | None, Field(strict=True, examples=["day.csv"])] = None
    """A CSV file, or a built-in one: a line of names, each with its unit, such as `P_load [kW]`, then a line for each slot."""
    disturbance_values: Annotated[Matrix | None, Field(examples=[[[0.0, 0.4], [0.0, 0.4]]])] = None
    """The same numbers in place of a file: a row for each slot."""
    noise: Annotated[Matrix | None, Field(examples=[[[1e-6, 0.0], [0.0, 1e-6]]])] = None
    """The covariance of the plant's own noise, n × n, semidefinite; 0 by default. It is not Q."""
    output_matrix: Annotated[Matrix | None, Field(examples=[[[1.0, 0.0]]])] = None
    """C, p × n: the sensor measures y = C x + v, and transmits the estimate of its Kalman filter."""
    measurement_noise: Annotated[Matrix | None, Field(examples=[[[0.01]]])] = None
    """The covariance of v, p × p."""
    start: Annotated[Numbers | None, Field(examples=[[55.0, 50.0]])] = None
    """The mean of the first state, as levels. `process.reference` by default."""
    state_lower: Annotated[Numbers | None, Field(examples=[[20.0, 10.0]])] = None
    """Lower limits within which a controller should keep the states, if its strategy uses them."""
    state_upper: Annotated[Numbers | None, Field(examples=[[90.0, 90.0]])] = None
    """Upper limits of the states."""

    def mistakes(self) -> Iterator[Mistake]:
        """Entries that do not fit each other; whether they fit the process is checked later."""
        yield from _named_mistakes("input", self.inputs, self.input_matrix, self.input_units)
        yield from _named_mistakes("disturbance", self.disturbances, self.disturbance_matrix, self.disturbance_units)
        count = len(self.inputs)
        yield from limit_mistakes("input", self.input_lower, self.input_upper, count, "one for each of inputs", {})
        for entry, other in (("output_matrix", "measurement_noise"), ("measurement_noise", "output_matrix")):
            if getattr(self, entry) is not None and getattr(self, other) is None:
                example = f"{other} = {self._example(other)}"
                yield other, f"is missing, but {entry} is given; expected {example}, or neither"
        rows, disturbances = self.disturbance_values, len(self.disturbances)
        if disturbances and rows is None:
            yield "disturbance_file", 'is missing; expected disturbance_file = "day.csv", or disturbance_values'
        elif rows is not None and not disturbances:
            yield "disturbances", 'is missing; expected the names of the disturbances, such as ["P_solar", "P_load"]'
        elif rows is not None and (sentence := row_mistake(rows, disturbances, "of disturbances")) is not None:
            yield "disturbance_values", sentence
        for entry, words in (("disturbances", self.disturbances), ("disturbance_units", self.disturbance_units or [])):
            if (sentence := word_mistake(words)) is not None:
                yield entry, sentence
        large = next((value for value in self.start or () if abs(value) > LARGEST), None)
        if large is not None:
            yield "start", f"has {large:g}; expected numbers of up to {LARGEST:g}"


def _named_mistakes(
    kind: str, names: list[str], matrix: list[list[float]] | None, units: list[str] | None
) -> Iterator[Mistake]:
    """Mistakes in the inputs, or in the disturbances; kind: the first word of their entries."""
    if len(names) > MOST_STATES:
        yield f"{kind}s", f"has {len(names)} names; expected at most {MOST_STATES}"
        return
    twice = sorted(name for name, count in Counter(names).items() if count > 1)
    yield from ((f"{kind}s", f"has {as_toml(name)} twice") for name in twice)
    if names and matrix is None:
        yield f"{kind}_matrix", f"is missing; expected a row for each state, a number for each of {kind}s"
    wrong = next((row for row in matrix or () if len(row) != len(names)), None)
    if wrong is not None:
        few = f"has a row of {counted(len(wrong), 'number')}; expected {len(names)}, one for each of {kind}s"
        yield f"{kind}_matrix", few
    if units is not None and len(units) != len(names):
        yield f"{kind}_units", f"has {counted(len(units), 'entry')}; expected {len(names)}, one for each of {kind}s"


def limit_mistakes(
    kind: str,
    lower: Numbers | None,
    upper: Numbers | None,
    count: int,
    why: str,
    within: Mapping[str, Sequence[float]],
) -> Iterator[Mistake]:
    """Mistakes in the lower and upper limits of `kind`, and in values outside them.

    count: how many limits there must be; why: the reason for that number; within: name → values that must lie between them.
    """
    for name, limits in ((f"{kind}_lower", lower), (f"{kind}_upper", upper)):
        if limits is not None and len(limits) != count:
            yield name, f"has {counted(len(limits), 'entry')}; expected {count}, {why}"
    least = [-math.inf] * count if lower is None or len(lower) != count else lower
    most = [math.inf] * count if upper is None or len(upper) != count else upper
    for i in range(count):
        if least[i] > most[i]:
            above = f"entry {i} is {least[i]}, above that of {kind}_upper, which is {most[i]}; swap them"
            yield f"{kind}_lower", above
    for name, values in within.items():
        for i, value in enumerate(values):
            if not least[i] <= value <= most[i]:
                span = " to ".join(
                    str(limit).replace("-", "−").replace("inf", "∞") if math.isinf(limit) else str(limit)
                    for limit in (least[i], most[i])
                )
                yield name, f"entry {i} is {value}, outside its limits, {span}; change one of them"


class ControllerTable(Table):
    """`[controller]`: the strategy that decides the inputs, how often and from what, with the strategy's own parameters."""

    model_config = ConfigDict(extra="allow")

    strategy: Annotated[str, Field(strict=True, examples=["lqr"]), AfterValidator(one_of(CONTROLLERS))]
    """How the controller decides. Its parameters are further entries."""
    period: Annotated[int, Field(strict=True, ge=1, le=LONGEST_PERIOD, examples=[60])] = 1
    """Slots between two decisions; inputs are held in between."""
    acts_on: Annotated[Literal["estimate", "truth"], Field(examples=["estimate"])] = "estimate"
    """The legitimate estimate, or, for comparison, the true state."""
    state_weights: Annotated[Numbers, Field(examples=[[1.0, 0.3]])]
    """Weights of the squared deviations of the states in the cost, one for each state."""
    input_weights: Annotated[Numbers, Field(examples=[[0.02, 0.05]])]
    """Weights of the squared inputs, one for each input."""
    rate_weights: Annotated[Numbers | None, Field(examples=[[1.0, 0.02]])] = None
    """Weights of the squared changes of the inputs between decisions; 0 by default."""
    rate_limits: Annotated[Numbers | None, Field(examples=[[0.05, 3.0]])] = None
    """How much each input may change per slot; no limit by default."""

    def mistakes(self) -> Iterator[Mistake]:
        """Weights and limits below 0, and missing, unknown or wrong parameters of the strategy."""
        for name in ("state_weights", "input_weights", "rate_weights", "rate_limits"):
            values = getattr(self, name)
            if values and min(values) < 0.0:
                yield name, f"has {min(values)}; expected numbers of 0 or more"
        strategy, given = CONTROLLERS[self.strategy], self.model_extra or {}
        yield from parameter_mistakes("strategy", self.strategy, strategy, given)
        yield from strategy.mistakes({name: value for name, value in given.items() if name in strategy.parameters})

    @property
    def parameters(self) -> dict[str, Any]:
        """The strategy's parameters, with defaults for those that are left out."""
        return {**CONTROLLERS[self.strategy].optional, **(self.model_extra or {})}


def noise_mistakes(table: PlantTable, n: int) -> list[str]:
    """Mistakes in `noise`, for n states."""
    if table.noise is None:
        return []
    if len(table.noise) != n:
        return [f"plant.noise: has {counted(len(table.noise), 'row')}; expected {n}, one for each state"]
    if any(len(row) != n for row in table.noise):
        return [f"plant.noise: has a row that is not of {n} numbers; expected {n} × {n}, as A is"]
    noise = np.array(table.noise, np.float64)
    if not np.array_equal(noise, noise.T):
        return ["plant.noise: is not symmetric; expected a covariance, such as 1e-6 times the identity, or 0"]
    try:
        semidefinite_factor(noise)
    except ValueError:
        return ["plant.noise: has an eigenvalue below 0; expected a covariance, such as 1e-6 times the identity, or 0"]
    return []


def plant_of(table: PlantTable, reference: Sequence[float]) -> Plant:
    """The plant that a table describes, in deviations from the reference; the table must fit its process."""
    around, n, m = np.array(reference), len(reference), len(table.inputs)

    def limits(values: Sequence[float] | None, without: float, count: int) -> Floats:
        return np.full(count, without) if values is None else np.array(values)

    return Plant(
        np.array(table.input_matrix or [[]] * n).reshape(n, m),
        np.array(table.disturbance_matrix or [[]] * n).reshape(n, len(table.disturbances)),
        np.zeros((n, n)) if table.noise is None else np.array(table.noise),
        limits(table.start, 0.0, n) - (around if table.start is not None else 0.0),
        limits(table.input_lower, -np.inf, m),
        limits(table.input_upper, np.inf, m),
        limits(table.state_lower, -np.inf, n) - around,
        limits(table.state_upper, np.inf, n) - around,
        None if table.output_matrix is None else np.array(table.output_matrix),
        None if table.measurement_noise is None else np.array(table.measurement_noise),
    )


def assignment_of(table: ControllerTable, process: Process, plant: Plant, slot_seconds: float) -> Assignment:
    """The assignment of the controller that a table describes; the table must fit its plant."""
    m = plant.inputs
    per_slot = np.full(m, np.inf) if table.rate_limits is None else np.array(table.rate_limits)
    return Assignment(
        process,
        plant,
        table.period,
        slot_seconds,
        np.array(table.state_weights),
        np.array(table.input_weights),
        np.zeros(m) if table.rate_weights is None else np.array(table.rate_weights),
        per_slot * table.period,
        table.parameters,
    )
