"""Checks that a brief can be used, by making the objects of its process once before the process takes part in a run.

Source: docs/protocol.md, the brief.
"""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from evedrop.errors import BriefError, NotRegistered
from evedrop.live.protocol.brief import Brief
from evedrop.model.acknowledgements import ATTACKS
from evedrop.model.controllers import CONTROLLERS, Assignment
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.plant import Plant
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.slot.link import Link, LinkSchedule, streams_of
from evedrop.names import ACKNOWLEDGEMENTS

_WRITE_AGAIN = "write it again with `evedrop brief`"


def expect_usable(brief: Brief) -> None:
    """Raise BriefError if a process cannot work with its brief: a key, a class or a number is missing or unusable."""
    try:
        _expect_usable(brief)
    except NotRegistered as error:
        name = str(error.name).encode("unicode_escape").decode()
        raise BriefError(f"it names {name}{error.why or ', which is not a class here'}") from error


def _expect_usable(brief: Brief) -> None:
    match brief.role:
        case "router":
            _expect_links(brief)
        case "sensor":
            plant = brief.part["plant"]
            scheme = _scheme(brief)
            measures = plant is not None and "output_matrix" in plant
            _expect_keys(brief, ["process", *(["measurement"] if measures else []), *scheme.secret_streams])
            _expect_plant(brief, plant)
        case "legitimate":
            _expect_keys(brief, _scheme(brief).estimator_streams)
            _expect_plant(brief, (brief.part["controller"] or {}).get("plant"))
        case "eavesdropper":
            kind, parameters = STRATEGIES[brief.part["strategy"]], brief.part["parameters"]
            lacking = sorted(set(kind.parameters) - set(parameters))
            if lacking:
                raise BriefError(f"part.parameters.{lacking[0]} is missing, which the strategy needs; {_WRITE_AGAIN}")
            with _using("part.parameters"):
                streams = kind.streams(parameters)
            _expect_keys(brief, streams)
        case "controller":
            _expect_controller(brief)
        case _:
            pass


def _expect_keys(brief: Brief, names: Iterable[str]) -> None:
    for name in names:
        if name not in brief.keys:
            raise BriefError(f"keys.{name} is missing, and {brief.process} cannot work without it; {_WRITE_AGAIN}")


def _scheme(brief: Brief) -> Any:
    kind = SCHEMES[brief.part["scheme"]["scheme"]]
    given = set(brief.part["scheme"]) - {"scheme"}
    for name in sorted(set(kind.parameters) ^ given):
        what = "missing" if name in kind.parameters else "not a parameter of the scheme"
        raise BriefError(f"part.scheme.{name} is {what}; {_WRITE_AGAIN}")
    with _using("part.scheme"):
        return scheme_of(brief.model.process, brief.part["scheme"])


def _expect_plant(brief: Brief, spec: Mapping[str, Any] | None) -> None:
    if spec is None:
        return
    n = brief.model.process.n
    with _using("part.plant"):
        plant = Plant.of({name: value for name, value in spec.items() if name != "disturbances"})
        if plant.noise.shape != (n, n) or plant.start.shape != (n,):
            raise ValueError(f"it does not have {n} states, as the model does")
        if "disturbances" in spec:
            _expect_disturbances(brief, spec["disturbances"], plant)


def _expect_disturbances(brief: Brief, text: str, plant: Plant) -> None:
    found = np.frombuffer(b64decode(text), "<f8").reshape(brief.slots, -1)
    if found.shape[1] != plant.disturbance_matrix.shape[1] or not np.isfinite(found).all():
        raise ValueError(f"it has {found.shape[1]} disturbances in each slot, or they are not finite")


def _expect_controller(brief: Brief) -> None:
    part = brief.part
    if part["strategy"] not in CONTROLLERS:
        known = ", ".join(sorted(CONTROLLERS))
        raise BriefError(f"part.strategy is {part['strategy']:.40}, expected one of {known}; {_WRITE_AGAIN}")
    _expect_plant(brief, {**part["plant"], "disturbances": part["disturbances"]})
    with _using("part.assignment"):
        assignment = Assignment.of(brief.model.process, Plant.of(part["plant"]), part["assignment"])
        objections = CONTROLLERS[part["strategy"]].objections(assignment)
    if objections:
        raise BriefError(f"part: the {objections[0][0]} {objections[0][1]}")


def _expect_links(brief: Brief) -> None:
    for name, spec in brief.part["links"].items():
        with _using(f"part.links.{name}"):
            course = LinkSchedule.of(spec)
        _expect_keys(brief, streams_of(name, course))
        with _using(f"part.links.{name}"):
            keys = brief.stream_keys
            Link(course, name, {stream: keys[stream] for stream in streams_of(name, course)}, brief.batch)
    acknowledgements = brief.part["acknowledgements"]
    if acknowledgements is not None:
        _expect_keys(brief, [f"link/{ACKNOWLEDGEMENTS}"])
        if acknowledgements["attack"] not in ATTACKS:
            raise BriefError(f"part.acknowledgements.attack is {acknowledgements['attack']:.40}; {_WRITE_AGAIN}")


@contextmanager
def _using(path: str) -> Iterator[None]:
    """Turn any error in the block into a BriefError that names the part of the brief."""
    try:
        yield
    except (BriefError, NotRegistered):
        raise
    except Exception as error:
        said = f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')}"
        raise BriefError(f"{path} cannot be used ({said}); {_WRITE_AGAIN}") from error
