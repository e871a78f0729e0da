"""Briefs: everything that one process may know, written by the launcher and read by the process as its only argument.

A brief is `<process>.json`, mode 0600. It holds the keys of the streams that the process owns; only the observer's brief
holds the scenario's seed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from evedrop.errors import BriefError
from evedrop.files import Unreadable, opened, why_of
from evedrop.live.protocol.brief_entries import PARTS, mistakes_in
from evedrop.model.process import Process, mistakes_of
from evedrop.streams import Batch

ROLES = tuple(PARTS)
_MOST_BYTES = 2**30  # the observer's brief holds the complete scenario
_WRITE_AGAIN = "write it again with `evedrop brief`"


@dataclass(frozen=True)
class Flow:
    """End-to-end flow control, both in slots."""

    window: int
    """The sensor stays at most this far ahead of the slowest receiver and of the observer."""
    batch: int
    """Telemetry, journal and progress are sent at least this often."""
    longest_outage: float = 30.0
    """Seconds for which a process may be cut off before that ends the run."""
    largest_message: int = 2**30
    """Bytes of the largest message of the run: larger ones are not accepted."""


@dataclass(frozen=True)
class Model:
    """The public model, which every process may know."""

    A: list[list[float]]
    Q: list[list[float]]
    initial_covariance: list[list[float]]
    state_probability: float
    """μ_d."""
    header: int = 0
    """How many unencrypted numbers a packet has in addition to its payload."""
    singular_noise: bool = False
    """Whether Q may be singular."""

    @property
    def process(self) -> Process:
        """The process of the model."""
        return Process(np.array(self.A), np.array(self.Q), np.array(self.initial_covariance), self.singular_noise)


@dataclass(frozen=True)
class Identity:
    """A process's certificate and key, and the authority that it trusts; each in PEM."""

    authority: str
    """The certificate of the run's authority, which made all certificates of the run."""
    certificate: str
    key: str
    """The private key of the certificate."""


@dataclass(frozen=True)
class Brief:
    """Everything one process may know."""

    run: str
    process: str
    role: str
    router: str
    """Zenoh endpoint, such as tcp/127.0.0.1:17460."""
    user: str
    password: str
    slots: int
    trials: int
    first_trial: int
    recorded: int
    """How many of the first trials are recorded in full."""
    flow: Flow
    model: Model
    keys: Mapping[str, str] = field(default_factory=dict)
    """Stream name → key, hexadecimal: the streams this process owns."""
    part: Mapping[str, Any] = field(default_factory=dict)
    """The role's part of the scenario."""
    first: int = 0
    """The first slot that this process handles: for a restarted process, where it goes on."""
    ends_with_stdin: bool = False
    """End when standard input closes: the launcher holds its other end, so nothing outlives a killed launcher."""
    patience: int = 30
    """Seconds for which it waits for the other processes."""
    identity: Identity | None = None
    """Its identity, if the run's router takes certificates."""

    @property
    def batch(self) -> Batch:
        """Slots and trials."""
        return Batch(self.slots, self.trials, self.first_trial)

    @property
    def stream_keys(self) -> dict[str, bytes]:
        """The keys of the streams this process owns."""
        return {name: bytes.fromhex(key) for name, key in self.keys.items()}

    def write(self, directory: Path) -> Path:
        """Write `<process>.json`, readable by its owner only."""
        path = directory / f"{self.process}.json"
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            json.dump(asdict(self), file, indent=1)
        return path


def read_brief(path: Path, role: str | None = None) -> Brief:
    """Read a brief. Raises BriefError if it cannot be read, is readable by others, or is another role's."""
    try:
        with opened(path) as file:
            if os.fstat(file.fileno()).st_mode & 0o077:
                raise BriefError(f"{path} is readable by others; a brief holds keys: chmod 600 {path}")
            found = file.read(_MOST_BYTES + 1)
    except (OSError, Unreadable) as error:
        raise BriefError(f"{path}: {why_of(error)}; give the file that `evedrop brief` wrote") from error
    try:
        if len(found) > _MOST_BYTES:
            raise ValueError(f"it has more than {_MOST_BYTES} bytes")
        brief = _parsed(json.loads(found.decode("utf-8")))
    except (ValueError, RecursionError) as error:
        raise BriefError(f"{path} is not a brief of this version ({error}); {_WRITE_AGAIN}") from error
    if role is not None and brief.role != role:
        raise BriefError(
            f"{path} is the brief of a {brief.role}; expected one of a {role}: start `evedrop {brief.role}`"
        )
    return brief


def _parsed(found: Any) -> Brief:
    mistakes = mistakes_in(found)
    if mistakes:
        raise ValueError("; ".join(mistakes))
    identity = found.get("identity")
    brief = Brief(
        **{
            **found,
            "flow": Flow(**found["flow"]),
            "model": Model(**found["model"]),
            "identity": None if identity is None else Identity(**identity),
        }
    )
    model = brief.model
    try:
        matrices = [np.array(M, np.float64) for M in (model.A, model.Q, model.initial_covariance)]
    except (ValueError, OverflowError) as error:
        raise ValueError("model.A, model.Q or model.initial_covariance is not a matrix") from error
    if wrong := mistakes_of(matrices[0], matrices[1], matrices[2], model.singular_noise):
        raise ValueError(f"its model is not a process: model.{wrong[0][0]} {wrong[0][1]}")
    if not 0.0 <= model.state_probability <= 1.0:
        raise ValueError(f"model.state_probability is {model.state_probability}, expected a number from 0 to 1")
    return brief
