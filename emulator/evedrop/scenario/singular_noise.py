"""Eavesdroppers that cannot work with a singular Q, and why.

Source: docs/mathematics.md, singular noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.local_filter import Steps, settled
from evedrop.model.plant import Plant
from evedrop.model.process import Process
from evedrop.model.schemes import scheme_of
from evedrop.model.staircase import NOT_REACHED, Staircase, checked_slots
from evedrop.model.theory.horizon import horizon
from evedrop.model.theory.leak import Leaks
from evedrop.scenario.filter_noise import FILTER, measured_mistakes
from evedrop.scenario.plant import PlantTable, plant_of
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.tables import Scenario

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
            distribution = scheme_of(process, scenario.encoding.spec).noise_distribution
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
