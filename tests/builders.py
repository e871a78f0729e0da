"""Shared by many tests: processes, keys, small scenarios, their tables and mistakes, and readers of results."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
import tomli_w

from evedrop.errors import DisturbanceError, ScenarioError
from evedrop.live.protocol.brief import AnyBrief, Part
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Belief, Beliefs
from evedrop.model.slot.records import SensorSlots
from evedrop.model.streams import root_of_seed, stream_key
from evedrop.results.reading import Results
from evedrop.scenario.loading import checked, parse
from evedrop.scenario.tables import Scenario

P = TypeVar("P", bound=Part)

UNSTABLE = Process(np.array([[1.0, 0.3], [0.5, 1.001]]), 1e-3 * np.eye(2), np.eye(2))
"""The paper's numerical illustration, with Σ0 = I."""
MARGINAL = Process(np.array([[1.0, 0.05], [0.0, 1.0]]), np.diag([1e-3, 1e-4]), np.diag([1.0, 0.01]))
"""A vehicle: position and speed."""
MICROGRID = Process(np.eye(2), 1e-5 * np.eye(2), 1e-5 * np.eye(2))
"""The paper's microgrid: two stores, which change by their noise alone."""
DRIFTING = Process(
    np.array([[1.0, 0.05, 0.0], [0.0, 1.0, 0.1], [0.0, -0.1, 0.99]]),
    np.array([[1e-3, 0.0, 0.0], [0.0, 2e-3, 1e-4], [0.0, 1e-4, 1e-3]]),
    np.array([[1.0, 0.2, 0.0], [0.2, 0.5, 0.0], [0.0, 0.0, 0.3]]),
)
"""Three states, with noise and Σ0 that are not diagonal."""
GOOD: dict[str, Any] = {
    "title": "A vehicle",
    "slots": 50,
    "process": {
        "A": [[1.0, 0.1], [0.0, 1.0]],
        "Q": [[1e-3, 0.0], [0.0, 1e-3]],
        "initial_covariance": [[1.0, 0.0], [0.0, 1.0]],
    },
    "encoding": {"scheme": "innovation", "state_probability": 0.5},
    "legitimate": {"link": {"quality": 0.9}},
    "eavesdroppers": {"smart": {"strategy": "smart", "link": {"quality": 0.8}}},
}
"""A scenario without mistakes."""
BASE = """
title = "Refused"
slots = 50
[process]
A = [[1.0, 0.1], [0.0, 1.0]]
Q = [[1e-3, 0.0], [0.0, 1e-3]]
initial_covariance = [[1.0, 0.0], [0.0, 1.0]]
[encoding]
scheme = "innovation"
state_probability = 0.5
[legitimate]
link = { quality = 0.9 }
"""
"""The text of a scenario without mistakes, to which tables can be added."""


def stream_keys(seed: int, names: Iterable[str]) -> dict[str, bytes]:
    """Stream → its key, of a run with this seed."""
    root = root_of_seed(seed)
    return {name: stream_key(root, name) for name in names}


def process_table(process: Process) -> dict[str, list[list[float]]]:
    """The table `process` of a scenario."""
    return {
        "A": process.A.tolist(),
        "Q": process.Q.tolist(),
        "initial_covariance": process.initial_covariance.tolist(),
    }


def tables_of(process: Process, /, **entries: Any) -> dict[str, Any]:
    """The tables of a scenario whose process the paper's scheme sends over a good link; entries replace or add."""
    return {
        "title": "A scenario of a test",
        "process": process_table(process),
        "encoding": {"scheme": "innovation", "state_probability": 0.5},
        "legitimate": {"link": {"quality": 0.9}},
        **entries,
    }


def scalar_tables(A: float, Q: float, **entries: Any) -> dict[str, Any]:
    """The same of one state, whose variance at first is 1."""
    return tables_of(Process(np.array([[A]]), np.array([[Q]]), np.eye(1)), **entries)


def scenario_of(process: Process, /, *, beyond_horizon: bool = False, **entries: Any) -> Scenario:
    """A scenario of such tables, checked."""
    return checked(tables_of(process, **entries), "scenario", beyond_horizon=beyond_horizon)


def listener(strategy: str, quality: float, **entries: Any) -> dict[str, Any]:
    """The table of an eavesdropper behind a link of this quality."""
    return {"strategy": strategy, "link": {"quality": quality}, **entries}


def changed(tables: Mapping[str, Any], **changes: Any) -> dict[str, Any]:
    """A copy of tables with entries by dotted key, `__` for the dot; None leaves an entry out."""
    made = copy.deepcopy(dict(tables))
    for key, value in changes.items():
        *path, last = key.split("__")
        table = made
        for name in path:
            table = table.setdefault(name, {})
        table[last] = value
        if value is None:
            del table[last]
    return made


def mistakes_of(read: Callable[..., object], *arguments: Any, **named: Any) -> list[str]:
    """The mistakes for which a call is refused."""
    with pytest.raises((ScenarioError, DisturbanceError)) as caught:
        read(*arguments, **named)
    error = caught.value
    assert isinstance(error, (ScenarioError, DisturbanceError))
    assert error.exit_status == 2
    return error.mistakes


def places_of(mistakes: Iterable[str]) -> list[str]:
    """The entries that mistakes are about, in order."""
    return [mistake.partition(": ")[0] for mistake in mistakes]


def mistakes_in_good(changes: dict[str, Any], without: str = "") -> list[str]:
    """The mistakes of `GOOD` with these changes, by dotted key, and without one entry."""
    tables = changed(GOOD, **{without.replace(".", "__"): None}) if without else copy.deepcopy(GOOD)
    return mistakes_of(parse, tomli_w.dumps(tables), "scenario", changes)


def digests_of(results: Results | Path) -> dict[str, str]:
    """Receiver → its digest, of results or of the folder that has them."""
    result = results if isinstance(results, Results) else Results.read(results)
    return {name: peer["digest"] for name, peer in result.summary["peers"].items()}


def part_of(brief: AnyBrief, kind: type[P]) -> P:
    """The part of a brief, which must be one of this role."""
    assert isinstance(brief.part, kind)
    return brief.part


def mirrored(P: Floats) -> Floats:
    """Covariances (…, n, n, R) with the upper triangles of P, each its own transpose."""
    upper = np.triu(np.ones(P.shape[-3:-1], np.bool_))[:, :, None]
    return np.where(upper, P, P.swapaxes(-3, -2))


def with_inputs(u: Floats) -> SensorSlots:
    """A sensor in one trial of two states, with inputs (c, m)."""
    zeros = np.zeros((len(u), 2, 1))
    return SensorSlots(0, zeros, zeros[:, 0] > 0.0, u=u[..., None], failed=zeros[:, 0] > 0.0)


def one_slot(belief: Belief) -> Beliefs:
    """A belief as a block of one slot."""
    return Beliefs(belief.x_hat[None], belief.P[None], belief.action[None])
