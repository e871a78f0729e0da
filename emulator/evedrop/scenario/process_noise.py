"""The process noise Q of a scenario: the one that results from a sensor's filter, and what cannot work with a singular one.

A sensor that measures and filters has mistakes of its own in its entries. Some eavesdroppers cannot work with a singular Q, each
for a reason that its message gives.

Source: docs/scenario.md, plant; docs/mathematics/plant.md, a filter at the sensor; docs/mathematics/numerics.md, singular noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from evedrop.counting import counted
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.kernels.elementary import semidefinite_factor
from evedrop.model.local_filter import MOST_STATES, FilterStep, Steps, settled
from evedrop.model.plant import Plant
from evedrop.model.process import MARGINAL, Floats, Process
from evedrop.model.staircase import NOT_REACHED, Staircase, checked_slots
from evedrop.model.theory.horizon import horizon
from evedrop.model.theory.leak import Leaks
from evedrop.scenario.plant import PlantTable, noise_mistakes, plant_of
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.tables import Scenario

FILTER = "filter"
_CERTAINLY, _NEARLY = 1e-13, 1e-9  # singular values, of entries up to 1, that are 0
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
        mistakes.append(
            f"plant.output_matrix: has a row of {counted(wrong, 'number')}; expected {n}, one for each state"
        )
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
    """The reason why a filter has no steady state; None if unknown.

    It is a measurement that follows from others without noise, or a mode of A that no measurement shows or no noise moves.
    least: the smallest singular value that is not rounding.
    """
    C, V, n = plant.output_matrix, plant.measurement_noise, len(A)
    assert C is not None and V is not None  # noqa: S101, PT018 - the caller knows
    if plant.noise.shape != A.shape:
        return None  # reported elsewhere
    if not C.any():
        return "plant.output_matrix: is 0, so that the measurements show nothing; expected a row for each measurement"
    deviations = np.sqrt(np.where(np.diag(V) > 0.0, np.diag(V), 1.0))
    weighed = np.hstack([np.stack([_scaled(row) for row in C]), V / np.outer(deviations, deviations)])
    if int(np.linalg.matrix_rank(weighed, tol=least)) < len(C):
        return (
            "plant.measurement_noise: gives no noise to measurements that follow exactly from the others, and the filter cannot "
            f"weigh them; expected noise in each of the {len(C)}, or fewer measurements"
        )
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


_WAYS_ON = (
    "another strategy, such as smart, or noise in every direction: add a small variance to the diagonal of Q and leave out "
    'singular_noise, or with Q = "filter" have as many measurements as states'
)


class Unsuited(NamedTuple):
    """A reason why a strategy cannot work with a process and its plant."""

    why: str
    """What the strategy does, as a verb and what follows it."""
    expected: str


def singular_mistakes(scenario: Scenario) -> Iterator[str]:
    """Mistakes of eavesdroppers together with a Q that may be singular."""
    table = scenario.process
    if not table.singular_noise:
        return
    tested = False
    for name, eavesdropper in scenario.eavesdroppers.items():
        for entry, strategy in (("strategy", eavesdropper.strategy), ("reads_as", eavesdropper.reads_as)):
            if strategy is None:
                continue
            for reason in unsuited(table, scenario.plant, strategy):
                place = f"eavesdroppers.{name}.{entry}: is {strategy}"
                yield f"{place}, which {reason.why}; expected {reason.expected}"
            kind = STRATEGIES.get(strategy)
            tested = tested or (kind is not None and kind.tests_range)
    if tested:
        with suppress(ValueError):  # A is singular, or there is a mistake in a scheme's noise: reported elsewhere
            process = table.process
            distribution = scenario.make_scheme().noise_distribution
            yield from _blurred(Leaks(process, distribution), horizon(process, scenario.slots), scenario.slots)


def unsuited(table: ProcessTable, plant: PlantTable | None, strategy: str) -> Iterator[Unsuited]:
    """The reasons why a strategy cannot work with this process and plant; none for a Q that must be nonsingular."""
    kind = STRATEGIES.get(strategy)
    if kind is None or not table.singular_noise:
        return
    if kind.inverts_noise:
        yield Unsuited("uses the inverse of Q, and Q may be singular", _WAYS_ON)
    if not kind.reads_leaks:
        return
    try:
        stairs = Staircase(table.process)
    except ValueError as error:
        yield Unsuited(f"uses what innovations leak, but {error}", _WAYS_ON)
        return
    if kind.tests_range and stairs.singular and plant is not None and not measured_mistakes(plant, len(table.A)):
        with suppress(ValueError):  # matrices of the plant do not fit the process, which is reported elsewhere
            yield from _outside(table.process, plant_of(plant, table.around), stairs)


def _outside(process: Process, plant: Plant, stairs: Staircase) -> Iterator[Unsuited]:
    """What moves the state out of the range of Q. Raises ValueError if the plant does not fit the process."""
    told, bound = "tests packets against the range of Q", f"where {NOT_REACHED:.0e} is rounding"
    sources = {"input_matrix": plant.input_matrix, "disturbance_matrix": plant.disturbance_matrix}
    if plant.output_matrix is None:
        sources["noise"] = plant.noise
    for name, matrix in sources.items():
        part = float(stairs.outside(matrix).max(initial=0.0))
        if part > NOT_REACHED:
            why = f"{told}, but plant.{name} moves the state out of it, by {part:.1e} of its size, {bound}"
            yield Unsuited(why, f"genie, or {_WAYS_ON}")
    if plant.output_matrix is None:
        return
    settled(process, plant)
    steps = Steps(process, plant)
    steps.next()
    while not steps.settled:
        part = float(stairs.outside(steps.next().gain).max(initial=0.0))
        if part > NOT_REACHED:
            yield Unsuited(
                f"{told}, but the sensor's filter moves its estimate out of it until it has settled, by {part:.1e} of a step, "
                f"{bound}",
                f'initial_covariance = "{FILTER}" and Q = "{FILTER}" in [process], with which the filter begins settled, or '
                "another strategy, such as genie",
            )
            return


def _blurred(leaks: Leaks, last: int | None, slots: int) -> Iterator[str]:
    """A mistake if rounding hides the range of Q, so that innovations may be taken for states; last: the horizon."""
    n = leaks.stairs.process.n
    # A run beyond the horizon is refused anyway.
    for k in checked_slots(slots) if last is None and leaks.stairs.singular else ():
        some = range(k, k + 1)
        if leaks.stairs.blurred(leaks.block(some)[:, :n, :n], leaks.rounding(some)):
            yield (
                f"slots: is {slots}; from slot {k} on the range of the singular Q is so close to the size of rounding that "
                "more than one innovation in a million would be taken for a state; expected fewer slots, a smaller "
                "initial_covariance, or eavesdroppers other than bayesian and likelihood"
            )
            return
