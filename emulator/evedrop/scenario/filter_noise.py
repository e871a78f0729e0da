"""A sensor that measures and filters: the process noise Q that results from its filter, and mistakes in its entries.

Source: docs/scenario.md, plant; docs/mathematics.md, a filter at the sensor.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from evedrop.model.kernels.elementary import semidefinite_factor
from evedrop.model.local_filter import MOST_STATES, FilterStep, settled
from evedrop.model.plant import Plant
from evedrop.model.process import MARGINAL, Floats, Process
from evedrop.scenario.plant import PlantTable, noise_mistakes, plant_of
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.tables import Scenario

FILTER = "filter"
_CERTAINLY, _NEARLY = (
    1e-13,
    1e-9,
)  # singular values, of entries up to 1, that are 0
_SMALLEST = 1e-300


def replace_filter_noise(tables: Mapping[str, Any]) -> list[str]:
    """Replace "filter" by what the sensor's filter makes of it: as `initial_covariance`, as `Q`, and as a scheme's noise.

    This is done in place. Returns mistakes, with their paths.
    """
    process, encoding = tables.get("process"), tables.get("encoding")
    if not isinstance(process, dict):
        return []
    wanted = [name for name in ("initial_covariance", "Q") if process.get(name) == FILTER]
    noise = encoding if isinstance(encoding, dict) and encoding.get("noise_covariance") == FILTER else None
    rows = process.get("A")
    n = len(rows) if isinstance(rows, list) and 0 < len(rows) <= MOST_STATES else 1
    process |= {name: np.eye(n).tolist() for name in wanted}  # placeholders until they are known
    if not wanted and noise is None:
        return []
    plant = tables.get("plant")
    if not isinstance(plant, Mapping) or plant.get("output_matrix") is None:
        # The scheme says what it expects instead of its noise.
        return [
            f'process.{name}: is "{FILTER}", but the sensor has none; expected a matrix, or output_matrix and '
            "measurement_noise in [plant]"
            for name in wanted
        ]
    if noise is not None:
        noise["noise_covariance"] = np.eye(n).tolist()  # a placeholder, too
    try:
        # Disturbances may be numbers for a whole day, and do not matter here.
        bare = PlantTable.model_validate(
            {name: value for name, value in plant.items() if not name.startswith("disturbance")}
        )
        step = _settled_from(process, bare)
        if "initial_covariance" in wanted:
            process["initial_covariance"] = step.predicted.tolist()
            step = _settled_from(process, bare)  # a filter that begins so is settled from the first slot on
    except ValueError:  # a mistake in process or plant, reported elsewhere
        return []
    if noise is not None:
        noise["noise_covariance"] = step.covariance.tolist()
    if "Q" in wanted:
        process |= {"Q": step.innovation.tolist(), "singular_noise": is_singular(step.innovation)}
    return []


def _settled_from(process: Mapping[str, Any], plant: PlantTable) -> FilterStep:
    return settled_of(ProcessTable.model_validate({**process, "singular_noise": False}), plant)


def settled_of(process: ProcessTable, plant: PlantTable) -> FilterStep:
    """The steady state of the sensor's filter. Raises ValueError if there is no filter, or if it has no steady state."""
    n = len(process.A)
    if plant.output_matrix is None or measured_mistakes(plant, n) or noise_mistakes(plant, n):
        raise ValueError("no filter")
    model = Process(np.array(process.A), np.eye(n), np.array(process.initial_covariance))
    described = plant_of(plant, process.around)
    if _unsettled(model.A, described, _CERTAINLY) is not None:  # thousands of slots would show it, too
        raise ValueError("the filter does not settle")
    return settled(model, described)


def is_singular(Q: Floats) -> bool:
    """Whether a covariance has a direction without variance."""
    return bool(np.any(np.diag(semidefinite_factor(Q)) == 0.0))


def measured_mistakes(plant: PlantTable, n: int) -> list[str]:
    """Mistakes in `output_matrix` and `measurement_noise`, for n states."""
    C, V = plant.output_matrix, plant.measurement_noise
    mistakes: list[str] = []
    if C is None or V is None:
        return mistakes
    if max(n, len(C)) > MOST_STATES:
        large = f"is of {len(C)} measurements of {n} states"
        return [
            f"plant.output_matrix: {large}; expected at most {MOST_STATES} of each, because the filter uses plain arithmetic"
        ]
    mistakes += [
        f"plant.{name}: has an entry that is infinite or not a number; expected finite numbers"
        for name, rows in (("output_matrix", C), ("measurement_noise", V))
        if not all(math.isfinite(number) for row in rows for number in row)
    ]
    if mistakes:
        return mistakes
    if not C or any(len(row) != n for row in C):
        wrong = next((len(row) for row in C if len(row) != n), 0)
        mistakes.append(f"plant.output_matrix: has a row of {wrong} numbers; expected {n}, one for each state")
    noise, p = [*map(len, V)], len(C)
    if noise != [p] * p:
        mistakes.append(
            f"plant.measurement_noise: has rows of {noise} numbers; expected {p} × {p}, as output_matrix has rows"
        )
        return mistakes
    matrix = np.array(V, np.float64)
    try:
        semidefinite_factor(matrix)
    except ValueError:
        mistakes.append("plant.measurement_noise: has an eigenvalue below 0; expected a covariance, such as [[0.01]]")
    if not np.array_equal(matrix, matrix.T):
        mistakes.append("plant.measurement_noise: is not symmetric; expected a covariance, such as [[0.01]]")
    return mistakes


def filter_mistakes(scenario: Scenario) -> Iterator[str]:
    """Mistakes in the sensor's filter together with process, scheme and eavesdroppers."""
    process, plant = scenario.process, scenario.plant
    if plant is not None and plant.output_matrix is not None:
        wrong = measured_mistakes(plant, len(process.A))
        yield from wrong
        try:
            settled_of(process, plant)
        except ValueError:
            if not wrong and not noise_mistakes(plant, len(process.A)):
                yield from _why_unsettled(process, plant)
        if scenario.scheme.decides_initial_state():
            decides = f"the scheme {scenario.encoding.scheme} decides x_0 itself"
            yield f"plant.output_matrix: is given, but {decides}; expected another scheme"


def _why_unsettled(process: ProcessTable, plant: PlantTable) -> Iterator[str]:
    with suppress(ValueError):  # matrices of the plant do not fit the process, which is reported elsewhere
        yield _unsettled(np.array(process.A), plant_of(plant, process.around), _NEARLY) or (
            "plant.output_matrix: does not let the sensor's filter settle: the measurements must show every state "
            "that does not decay, and plant.noise must move some state, or the filter ends up ignoring all measurements"
        )


def _unsettled(A: Floats, plant: Plant, least: float) -> str | None:
    """The reason why a filter has no steady state: a mode of A that no measurement shows or no noise moves; None if unknown.

    least: the smallest singular value that is not rounding.
    """
    C, n = plant.output_matrix, len(A)
    assert C is not None  # noqa: S101 - the caller knows
    if plant.noise.shape != A.shape:
        return None  # reported elsewhere
    if not C.any():
        return "plant.output_matrix: is 0, so that the measurements show nothing; expected a row for each measurement"
    for value in sorted(np.linalg.eigvals(A), key=abs, reverse=True):
        size = f"an eigenvalue of A of modulus {abs(value):.6g}"
        shifted = _scaled(A - value * np.eye(n))
        seen = int(np.linalg.matrix_rank(np.vstack([shifted, *(_scaled(row)[None] for row in C)]), tol=least))
        if abs(value) >= 1.0 - MARGINAL and seen < n:
            return (
                f"plant.output_matrix: shows only {seen} of {n} directions of a mode that does not decay, {size}, so the "
                "filter's error grows without bound; expected C with a measurement of every mode of modulus 1 or more: "
                "the rank of [A − λ; C] must be the number of states"
            )
        moved = int(np.linalg.matrix_rank(np.hstack([shifted, _scaled(plant.noise)]), tol=least))
        if abs(abs(value) - 1.0) <= MARGINAL and moved < n:
            return (
                f"plant.noise: moves only {moved} of {n} directions of a mode that neither decays nor grows, {size}, so the "
                "filter ends up ignoring all measurements of it; expected noise that moves every such mode: the rank of "
                "[A − λ, W] must be the number of states"
            )
    return None


def _scaled(M: Floats) -> Floats:
    return np.asarray(M / max(float(np.abs(M).max(initial=0.0)), _SMALLEST))
