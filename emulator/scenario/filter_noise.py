"""A sensor that measures and filters: the process noise Q that results from its filter, and mistakes in its entries.

Source: docs/scenario.md, plant; docs/mathematics.md, a filter at the sensor.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from evedrop.kernels.elementary import semidefinite_factor
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.local_filter import MOST_STATES, FilterStep, settled
from evedrop.model.process import Floats, Process
from evedrop.scenario.plant import PlantTable, plant_of
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.valid import ValidTables

FILTER = "filter"


def filter_noise_read(tables: Mapping[str, Any]) -> list[str]:
    """Replace "filter" by the covariance of the filter's innovations, as Q, and of its error, as that of a scheme's noise.

    This is done in place. Returns mistakes, with their paths.
    """
    process, encoding = tables.get("process"), tables.get("encoding")
    if not isinstance(process, dict):
        return []
    of_process = process.get("Q") == FILTER
    noise = encoding if isinstance(encoding, dict) and encoding.get("noise_covariance") == FILTER else None
    rows = process.get("A")
    n = len(rows) if isinstance(rows, list) and 0 < len(rows) <= MOST_STATES else 1
    if of_process:
        process["Q"] = np.eye(n).tolist()  # a placeholder until Q is known
    plant = tables.get("plant")
    if not of_process and noise is None:
        return []
    if not isinstance(plant, Mapping) or plant.get("output_matrix") is None:
        if not of_process:  # the scheme says what it expects instead
            return []
        return [
            f'process.Q: is "{FILTER}", but the sensor has none; expected a matrix, or output_matrix and measurement_noise '
            "in [plant]"
        ]
    if noise is not None:
        noise["noise_covariance"] = np.eye(n).tolist()  # a placeholder, too
    try:
        # Disturbances may be numbers for a whole day, and do not matter here.
        bare = {name: value for name, value in plant.items() if not name.startswith("disturbance")}
        made = ProcessTable.model_validate({**process, "singular_noise": False})
        step = settled_of(made, PlantTable.model_validate(bare))
    except ValueError:  # a mistake in process or plant, reported elsewhere
        return []
    if noise is not None:
        noise["noise_covariance"] = step.covariance.tolist()
    if of_process:
        process["Q"] = step.innovation.tolist()
        process["singular_noise"] = is_singular(step.innovation)
    return []


def settled_of(process: ProcessTable, plant: PlantTable) -> FilterStep:
    """The steady state of the sensor's filter. Raises ValueError if there is no filter, or if it has no steady state."""
    n = len(process.A)
    if plant.output_matrix is None or measured_mistakes(plant, n):
        raise ValueError("no filter")
    known = Process(np.array(process.A), np.eye(n), np.array(process.initial_covariance))
    return settled(known, plant_of(plant, process.around))


def is_singular(Q: Floats) -> bool:
    """Whether a covariance has a direction without variance."""
    return bool(np.any(np.diag(semidefinite_factor(Q)) == 0.0))


def measured_mistakes(plant: PlantTable, n: int) -> list[str]:
    """Mistakes in `output_matrix` and `measurement_noise`, for n states."""
    C, V = plant.output_matrix, plant.measurement_noise
    found: list[str] = []
    if C is None or V is None:
        return found
    if max(n, len(C)) > MOST_STATES:
        large = f"is of {len(C)} measurements of {n} states"
        return [
            f"plant.output_matrix: {large}; expected at most {MOST_STATES} of each, because the filter uses plain arithmetic"
        ]
    if not C or any(len(row) != n for row in C):
        wrong = next((len(row) for row in C if len(row) != n), 0)
        found.append(f"plant.output_matrix: has a row of {wrong} numbers; expected {n}, one for each state")
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


def filter_mistakes(tables: ValidTables) -> Iterator[str]:
    """Mistakes in the sensor's filter together with process, scheme and eavesdroppers."""
    process, plant, encoding, scheme = tables.process, tables.plant, tables.encoding, tables.scheme
    if process is None:
        return
    if plant is not None and plant.output_matrix is not None:
        wrong = measured_mistakes(plant, len(process.A))
        yield from wrong
        try:
            settled_of(process, plant)
        except ValueError:
            if not wrong:
                yield (
                    "plant.output_matrix: does not let the sensor's filter settle: the measurements must show every state, "
                    "and plant.noise must move every state, or the filter ends up ignoring all measurements"
                )
        if encoding is not None and scheme is not None and scheme.decides_initial_state():
            decides = f"the scheme {encoding.scheme} decides x_0 itself"
            yield f"plant.output_matrix: is given, but {decides}; expected another scheme"
    if process.singular_noise:
        for name, table in tables.eavesdroppers.items():
            for entry, strategy in (("strategy", table.strategy), ("reads_as", table.reads_as)):
                if strategy is not None and _inverts_noise(strategy):
                    yield (
                        f"eavesdroppers.{name}.{entry}: is {strategy}, which uses the inverse of Q, and Q may be "
                        "singular; expected another strategy, or a Q that is not"
                    )


def _inverts_noise(strategy: str) -> bool:
    kind = STRATEGIES.get(strategy)
    return kind is not None and kind.inverts_noise
