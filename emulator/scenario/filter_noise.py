"""A sensor that measures and filters: the process noise that its filter gives the network, and mistakes in its entries.

Source: docs/scenario.md, plant; docs/mathematics.md, a filter at the sensor.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from pydantic import ValidationError

from evedrop.kernels.elementary import semidefinite_factor
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.local_filter import MOST_STATES, FilterStep, settled
from evedrop.model.process import Floats, Process
from evedrop.model.schemes import SCHEMES
from evedrop.scenario.plant import PlantTable, plant_of
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.table import numbers

FILTER = "filter"


def filter_noise_read(tables: Mapping[str, Any]) -> list[str]:
    """Replace `Q = "filter"` by the covariance of the filter's innovations. Returns the mistakes, with their paths."""
    process = tables.get("process")
    if not isinstance(process, dict) or process.get("Q") != FILTER:
        return []
    n = len(process["A"]) if isinstance(process.get("A"), list) else 1
    process["Q"] = np.eye(max(1, n) if n <= MOST_STATES else 1).tolist()  # a placeholder until Q is known
    plant = tables.get("plant")
    if not isinstance(plant, Mapping) or plant.get("output_matrix") is None:
        return [
            f'process.Q: is "{FILTER}", but the sensor has none; expected a matrix, or output_matrix and measurement_noise '
            "in [plant]"
        ]
    try:
        step = settled_of(process, plant)
    except ValueError:  # a mistake in process or plant, reported elsewhere
        return []
    process["Q"] = step.innovation.tolist()
    process["singular_noise"] = is_singular(step.innovation)
    return []


def settled_of(process: Mapping[str, Any], plant: Mapping[str, Any]) -> FilterStep:
    """The steady state of the tables' filter. Raises ValidationError or ValueError if it does not exist."""
    n = len(process["A"]) if isinstance(process.get("A"), list) else 1
    made = ProcessTable.model_validate({**process, "Q": np.eye(n).tolist(), "singular_noise": False})
    table = PlantTable.model_validate(without_disturbances(plant))
    A, n = np.array(made.A), len(made.A)
    if table.output_matrix is None or measured_mistakes(plant, n):
        raise ValueError("no filter")
    bare = plant_of(table, made.around)
    return settled(Process(A, np.eye(n), np.array(made.initial_covariance)), bare)


def without_disturbances(plant: Mapping[str, Any]) -> dict[str, Any]:
    """A plant without its disturbances, which may be numbers for a whole day."""
    return {name: value for name, value in plant.items() if not name.startswith("disturbance")}


def is_singular(Q: Floats) -> bool:
    """Whether a covariance has a direction without variance."""
    return bool(np.any(np.diag(semidefinite_factor(Q)) == 0.0))


def measured_mistakes(plant: Mapping[str, Any], n: int) -> list[str]:
    """Mistakes in the sensor's measurement of n states."""
    C, V = plant.get("output_matrix"), plant.get("measurement_noise")
    found = []
    if C is None or not numbers(C):
        return []
    if max(n, len(C)) > MOST_STATES:
        large = f"is of {len(C)} measurements of {n} states"
        return [
            f"plant.output_matrix: {large}; expected at most {MOST_STATES} of each, because the filter uses plain arithmetic"
        ]
    if not C or any(len(row) != n for row in C):
        wrong = next((len(row) for row in C if len(row) != n), 0)
        found.append(f"plant.output_matrix: has a row of {wrong} numbers; expected {n}, one for each state")
    if V is None or not numbers(V):
        return found
    noise, p = [*map(len, V)], len(C)
    if noise != [p] * p:
        found.append(
            f"plant.measurement_noise: has rows of {noise} numbers; expected {p} × {p}, as output_matrix has rows"
        )
        return found
    matrix = np.array(V, np.float64)
    try:
        semidefinite_factor(matrix)
    except ValueError:
        found.append("plant.measurement_noise: has an eigenvalue below 0; expected a covariance, such as [[0.01]]")
    if not np.array_equal(matrix, matrix.T):
        found.append("plant.measurement_noise: is not symmetric; expected a covariance, such as [[0.01]]")
    return found


def filter_mistakes(tables: Mapping[str, Any]) -> Iterator[str]:
    """Mistakes in the sensor's filter together with process, scheme and eavesdroppers."""
    process, plant = tables.get("process"), tables.get("plant")
    if not isinstance(process, Mapping):
        return
    if isinstance(plant, Mapping) and plant.get("output_matrix") is not None and isinstance(process.get("A"), list):
        wrong = measured_mistakes(plant, len(process["A"]))
        yield from wrong
        try:
            settled_of(process, plant)
        except ValidationError:
            pass
        except ValueError:
            if not wrong:
                yield (
                    "plant.output_matrix: does not let the sensor's filter settle: the measurements must show every state, "
                    "and plant.noise must move every state, or the filter ends up ignoring all measurements"
                )
        encoding = tables.get("encoding")
        name = str(encoding.get("scheme")) if isinstance(encoding, Mapping) else ""
        scheme = SCHEMES.get(name)
        if scheme is not None and scheme.decides_initial_state():
            yield f"plant.output_matrix: is given, but the scheme {name} decides x_0 itself; expected another scheme"
    if process.get("singular_noise") is True:
        eavesdroppers = tables.get("eavesdroppers")
        for name, table in (eavesdroppers if isinstance(eavesdroppers, Mapping) else {}).items():
            for entry in ("strategy", "reads_as"):
                if isinstance(table, Mapping) and _inverts_noise(table.get(entry)):
                    yield (
                        f"eavesdroppers.{name}.{entry}: is {table[entry]}, which uses the inverse of Q, and Q may be "
                        "singular; expected another strategy, or a Q that is not"
                    )


def _inverts_noise(strategy: object) -> bool:
    kind = STRATEGIES.get(strategy) if isinstance(strategy, str) else None
    return kind is not None and kind.inverts_noise
