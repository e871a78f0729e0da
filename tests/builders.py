"""Shared by many tests: processes, keys, the tables of small scenarios, and readers of results."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from evedrop.live.protocol.brief import AnyBrief
from evedrop.live.protocol.brief_parts import Part
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Belief, Beliefs
from evedrop.model.streams import root_of_seed, stream_key
from evedrop.results.reading import Results

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


def scalar_tables(A: float, Q: float, **entries: Any) -> dict[str, Any]:
    """The tables of a scenario with one state, which the paper's scheme sends over a good link; entries replace or add."""
    return {
        "title": "One state",
        "process": {"A": [[A]], "Q": [[Q]], "initial_covariance": [[1.0]]},
        "encoding": {"scheme": "innovation", "state_probability": 0.5},
        "legitimate": {"link": {"quality": 0.9}},
        **entries,
    }


def digests_of(results: Results | Path) -> dict[str, str]:
    """Receiver → its digest, of results or of the folder that has them."""
    found = results if isinstance(results, Results) else Results.read(results)
    return {name: peer["digest"] for name, peer in found.summary["peers"].items()}


def part_of(brief: AnyBrief, kind: type[P]) -> P:
    """The part of a brief, which must be one of this role."""
    assert isinstance(brief.part, kind)
    return brief.part


def mirrored(P: Floats) -> Floats:
    """Covariances (…, n, n, R) with the upper triangles of P, each its own transpose."""
    upper = np.triu(np.ones(P.shape[-3:-1], np.bool_))[:, :, None]
    return np.where(upper, P, P.swapaxes(-3, -2))


def one_slot(belief: Belief) -> Beliefs:
    """A belief as a block of one slot."""
    return Beliefs(belief.x_hat[None], belief.P[None], belief.action[None])
