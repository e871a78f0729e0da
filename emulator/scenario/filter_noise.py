"""A sensor that measures and filters: the process noise Q that results from its filter, and mistakes in its entries.

Source: docs/scenario.md, plant; docs/mathematics.md, a filter at the sensor and singular noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from evedrop.kernels.elementary import semidefinite_factor
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.local_filter import MOST_STATES, FilterStep, Steps, settled
from evedrop.model.plant import Plant
from evedrop.model.process import MARGINAL, Floats, Process
from evedrop.model.schemes import scheme_of
from evedrop.model.staircase import NOT_REACHED, Staircase, checked_slots
from evedrop.model.theory.horizon import horizon
from evedrop.model.theory.leak import Leaks
from evedrop.scenario.plant import PlantTable, plant_of
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.valid import ValidTables

FILTER = "filter"
_CERTAINLY, _NEARLY = (
    1e-13,
    1e-9,
)  # singular values, of entries up to 1, that are 0
_SMALLEST = 1e-300


def filter_noise_read(tables: Mapping[str, Any]) -> list[str]:
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
    if plant.output_matrix is None or measured_mistakes(plant, n):
        raise ValueError("no filter")
    known = Process(np.array(process.A), np.eye(n), np.array(process.initial_covariance))
    described = plant_of(plant, process.around)
    if _unsettled(known.A, described, _CERTAINLY) is not None:  # thousands of slots would show it, too
        raise ValueError("the filter does not settle")
    return settled(known, described)


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
                yield _unsettled(np.array(process.A), plant_of(plant, process.around), _NEARLY) or (
                    "plant.output_matrix: does not let the sensor's filter settle: the measurements must show every state "
                    "that does not decay, and plant.noise must move some state, or the filter ends up ignoring all "
                    "measurements"
                )
        if encoding is not None and scheme is not None and scheme.decides_initial_state():
            decides = f"the scheme {encoding.scheme} decides x_0 itself"
            yield f"plant.output_matrix: is given, but {decides}; expected another scheme"
    if process.singular_noise:
        yield from _singular_mistakes(tables, process.process)


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


def _singular_mistakes(tables: ValidTables, process: Process) -> Iterator[str]:
    """Mistakes of eavesdroppers that cannot work with this Q, which may be singular."""
    blurred = False
    for name, table in tables.eavesdroppers.items():
        for entry, strategy in (("strategy", table.strategy), ("reads_as", table.reads_as)):
            kind = None if strategy is None else STRATEGIES.get(strategy)
            if kind is None:
                continue
            what = f"eavesdroppers.{name}.{entry}: is {strategy}"
            if kind.inverts_noise:
                yield (
                    f"{what}, which uses the inverse of Q, and Q may be singular; expected another strategy, or a Q that is not"
                )
            if not kind.reads_leaks:
                continue
            try:
                stairs = Staircase(process)
            except ValueError as error:
                yield f"{what}, which uses what innovations leak, but {error}; expected another strategy, or a regular Q"
                continue
            if kind.tests_range:
                yield from (f"{what}, {why}" for why in _outside(tables, process, stairs))
                blurred = blurred or stairs.singular
    if blurred and tables.slots is not None:
        with suppress(ValueError):  # a mistake in the covariance of a scheme's noise, reported elsewhere
            law = None if tables.encoding is None else scheme_of(process, tables.encoding.spec).noise_law
            yield from _blurred(Leaks(process, law), horizon(process, tables.slots), tables.slots)


def _outside(tables: ValidTables, process: Process, stairs: Staircase) -> Iterator[str]:
    """What moves the state out of the range of Q, and what to do about it."""
    plant, expected = tables.plant, "expected another strategy, such as genie, or a regular Q"
    if plant is None or tables.process is None:
        return
    known = plant_of(plant, tables.process.around)
    told = "which tests packets against the range of Q"
    sources = {"input_matrix": known.input_matrix, "disturbance_matrix": known.disturbance_matrix}
    if known.output_matrix is None:
        sources["noise"] = known.noise
    for name, matrix in sources.items():
        if (part := float(stairs.outside(matrix).max(initial=0.0))) > NOT_REACHED:
            yield (
                f"{told}, but plant.{name} moves the state out of it, by {part:.1e} of its size, where {NOT_REACHED:.0e} is "
                f"rounding; {expected}"
            )
    if known.output_matrix is None or measured_mistakes(plant, process.n):
        return
    steps = Steps(process, known)
    steps.next()
    with suppress(ValueError):  # a filter that does not settle, which is reported elsewhere
        settled(process, known)
        while not steps.settled:
            if (part := float(stairs.outside(steps.next().gain).max(initial=0.0))) > NOT_REACHED:
                yield (
                    f"{told}, but the sensor's filter moves its estimate out of it until it has settled, by {part:.1e} of a "
                    f'step, where {NOT_REACHED:.0e} is rounding; expected initial_covariance = "{FILTER}" and '
                    f'Q = "{FILTER}" in [process], with which the filter begins settled, or another strategy, such as genie'
                )
                return


def _blurred(leaks: Leaks, last: int | None, slots: int) -> Iterator[str]:
    """A mistake if rounding hides the range of Q, so that innovations may be taken for states; last: the horizon."""
    n = leaks.stairs.process.n
    # A run beyond the horizon is refused anyway.
    for k in checked_slots(slots) if last is None else ():
        some = range(k, k + 1)
        if leaks.stairs.blurred(leaks.block(some)[:, :n, :n], leaks.rounding(some)):
            yield (
                f"slots: is {slots}; from slot {k} on the range of the singular Q is so close to the size of rounding that "
                "more than one innovation in a million would be taken for a state; expected fewer slots, a smaller "
                "initial_covariance, or eavesdroppers other than bayesian and likelihood"
            )
            return
