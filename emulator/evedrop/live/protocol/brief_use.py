"""Checks that a brief can be used: makes the objects that its process needs once before the process takes part in a run.

Source: docs/protocol.md, the brief.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import numpy as np

from evedrop.errors import BriefError, NotRegistered
from evedrop.live.protocol.brief import (
    WRITE_AGAIN,
    AnyBrief,
    ControllerPart,
    EavesdropperPart,
    LegitimatePart,
    MonitorEntry,
    PlantEntry,
    RouterPart,
    SensorPart,
    decoded,
)
from evedrop.model.acknowledgements import ATTACKS
from evedrop.model.controllers import CONTROLLERS
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.integrity.monitor import Monitor
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.slot.link import Link, streams_of
from evedrop.model.streams import KEY_BYTES
from evedrop.names import ACKNOWLEDGEMENTS


@contextmanager
def classes_known() -> Iterator[None]:
    """Turn a NotRegistered of the block into a BriefError: the brief names a class that this process does not have."""
    try:
        yield
    except NotRegistered as error:
        name = str(error.name).encode("unicode_escape").decode()
        raise BriefError(f"it names {name}{error.why or ', which is not a class here'}") from error


@classes_known()
def expect_usable(brief: AnyBrief) -> None:
    """Raise BriefError if a process cannot work with its brief: a key, a class or a number is missing or unusable."""
    match brief.part:
        case RouterPart() as part:
            _expect_links(brief, part)
        case SensorPart(plant=plant) as part:
            scheme = _scheme(brief, part)
            measures = plant is not None and plant.output_matrix is not None
            monitors = ["watermark", "spoofing"] if part.monitor is not None else []
            _expect_keys(brief, ["process", *(["measurement"] if measures else []), *monitors, *scheme.secret_streams])
            if plant is not None:
                _expect_plant(brief, plant, plant.disturbances)
            if part.monitor is not None:
                _expect_monitor(brief, part.monitor, plant)
            _expect_states(brief, part)
        case LegitimatePart(controller=loop) as part:
            _expect_keys(brief, _scheme(brief, part).estimator_streams)
            if loop is not None and loop.plant is not None:
                _expect_plant(brief, loop.plant)
        case EavesdropperPart(strategy=strategy, parameters=parameters, noise_distribution=noise):
            kind, n = STRATEGIES[strategy], brief.model.process.n
            lacking = sorted(set(kind.parameters) - set(parameters))
            if lacking:
                raise BriefError(f"part.parameters.{lacking[0]} is missing, which the strategy needs; {WRITE_AGAIN}")
            with _using("part.parameters"):
                streams = kind.streams(parameters)
            _expect_keys(brief, streams)
            with _using("part.noise_covariance"):
                if noise is not None and noise.factors(brief.model.process).block(range(1, 2)).shape[1:] != (n, n):
                    raise ValueError(f"it does not have {n} states, as the model does")
        case ControllerPart() as part:
            _expect_controller(brief, part)
        case _:
            pass


def _expect_keys(brief: AnyBrief, names: Iterable[str]) -> None:
    for name in names:
        if name not in brief.keys:
            raise BriefError(f"keys.{name} is missing, and {brief.process} cannot work without it; {WRITE_AGAIN}")


def _scheme(brief: AnyBrief, part: SensorPart | LegitimatePart) -> Scheme:
    spec = part.scheme
    kind = SCHEMES[spec["scheme"]]
    for name in sorted(set(kind.parameters) ^ (set(spec) - {"scheme"})):
        problem = "missing" if name in kind.parameters else "not a parameter of the scheme"
        raise BriefError(f"part.scheme.{name} is {problem}; {WRITE_AGAIN}")
    with _using("part.scheme"):
        return scheme_of(brief.model.process, spec)


def _expect_plant(brief: AnyBrief, entry: PlantEntry, disturbances: str | None = None) -> None:
    n = brief.model.process.n
    with _using("part.plant"):
        plant = entry.plant
        if plant.noise.shape != (n, n) or plant.start.shape != (n,):
            raise ValueError(f"it does not have {n} states, as the model does")
        if disturbances is None:
            return
        disturbances_ = decoded(disturbances, brief.slots)
        if disturbances_.shape[1] != plant.disturbance_matrix.shape[1] or not np.isfinite(disturbances_).all():
            raise ValueError(f"it has {disturbances_.shape[1]} disturbances in each slot, or they are not finite")


def _expect_states(brief: AnyBrief, part: SensorPart) -> None:
    n, program = brief.model.process.n, part.program
    with _using("part.states"):
        if part.states is not None:
            states = decoded(part.states, brief.slots)
            if states.shape[1] != n or not np.isfinite(states).all():
                raise ValueError(f"it has {states.shape[1]} states, not {n}, or they are not finite")
    with _using("part.program"):
        if program is not None:
            if {len(program.states), len(program.reference), len(program.offsets or program.states)} != {n}:
                raise ValueError(f"it does not have {n} states, as the model does")
            if (program.connect is None) == (program.listen is None):
                raise ValueError("it needs connect or listen, and not both")


def _expect_monitor(brief: AnyBrief, entry: MonitorEntry, plant: PlantEntry | None) -> None:
    with _using("part.monitor"):
        if plant is None or plant.output_matrix is None:
            raise ValueError("there is no filter whose innovations could be tested")
        plan, p, m = entry.plan, len(plant.output_matrix), plant.plant.inputs
        shapes = [array.shape for array in (plan.watermark, plan.shift, plan.marked.precision, plan.unmarked.precision)]
        if shapes != [(m, m), (p, m), (p, p), (p, p)]:
            raise ValueError(f"its matrices are {shapes}, and there are {m} inputs and {p} measurements")
        Monitor(plan, bytes(KEY_BYTES), brief.batch)
        plan.spoofing(bytes(KEY_BYTES), brief.batch)


def _expect_controller(brief: AnyBrief, part: ControllerPart) -> None:
    if part.strategy not in CONTROLLERS:
        names = ", ".join(sorted(CONTROLLERS))
        raise BriefError(f"part.strategy is {part.strategy:.40}, expected one of {names}; {WRITE_AGAIN}")
    _expect_plant(brief, part.plant, part.disturbances)
    with _using("part.assignment"):
        assignment = part.assignment.assignment(brief.model.process, part.plant.plant)
        objections = CONTROLLERS[part.strategy].objections(assignment)
    if objections:
        raise BriefError(f"part: the {objections[0][0]} {objections[0][1]}")


def _expect_links(brief: AnyBrief, part: RouterPart) -> None:
    for name, entry in part.links.items():
        with _using(f"part.links.{name}"):
            schedule = entry.schedule
        _expect_keys(brief, streams_of(name, schedule))
        with _using(f"part.links.{name}"):
            keys = brief.stream_keys
            Link(schedule, name, {stream: keys[stream] for stream in streams_of(name, schedule)}, brief.batch)
    if part.acknowledgements is not None:
        _expect_keys(brief, [f"link/{ACKNOWLEDGEMENTS}"])
        if part.acknowledgements.attack not in ATTACKS:
            raise BriefError(f"part.acknowledgements.attack is {part.acknowledgements.attack:.40}; {WRITE_AGAIN}")


@contextmanager
def _using(path: str) -> Iterator[None]:
    """Turn any error in the block into a BriefError that names the part of the brief."""
    try:
        yield
    except (BriefError, NotRegistered):
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')}"
        raise BriefError(f"{path} cannot be used ({reason}); {WRITE_AGAIN}") from error
