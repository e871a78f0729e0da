"""What one process may know: written by the launcher, read by the process, and nothing else is handed to it.

A brief is `<process>.json`, mode 0600. The keys in it are those of the streams the process owns; the scenario's seed
is in none but the observer's.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from emulator.errors import BriefError
from emulator.model.process import Process, mistakes_of
from emulator.streams import KEY_BYTES, Batch

_KINDS: Mapping[tuple[str, ...], type] = {
    ("run", "process", "role", "router", "user", "password"): str,
    ("slots", "trials", "first_trial", "recorded"): int,
    ("flow", "model", "keys", "part"): dict,
    ("ends_with_stdin",): bool,
}
_PARTS: Mapping[str, tuple[str, ...]] = {
    "router": ("links", "pace", "users", "leaks", "acknowledgements", "controller", "zid", "limits"),
    "relay": ("users", "receivers", "listen", "zid", "controller", "limits"),
    "sensor": ("scheme", "pace", "receivers", "holds", "history", "leaks", "chart", "plant", "controller"),
    "legitimate": ("scheme", "window", "outages", "controller"),
    "eavesdropper": ("strategy", "parameters", "window", "outages"),
    "controller": ("strategy", "assignment", "acts_on", "plant", "disturbances"),
    "observer": ("scenario", "results", "recording", "live", "operator", "operator_identity", "shard"),
}
ROLES = ("router", "relay", "sensor", "legitimate", "eavesdropper", "controller", "observer")


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
    """Bytes of the largest message of the run: more is not taken in."""


@dataclass(frozen=True)
class Model:
    """The public model: everybody may know it."""

    A: list[list[float]]
    Q: list[list[float]]
    initial_covariance: list[list[float]]
    state_probability: float
    """μ_d."""
    header: int = 0
    """Numbers that a packet has in clear beside its payload."""
    singular_noise: bool = False
    """Whether Q may be singular."""

    @property
    def process(self) -> Process:
        """The process of the model."""
        return Process(np.array(self.A), np.array(self.Q), np.array(self.initial_covariance), self.singular_noise)


@dataclass(frozen=True)
class Identity:
    """Who a process is where that must be shown, and who else to believe; each in PEM."""

    authority: str
    """The certificate of the run's authority, which made everybody's."""
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
    """The first so many trials of the run are recorded in full."""
    flow: Flow
    model: Model
    keys: Mapping[str, str] = field(default_factory=dict)
    """Stream name → key, hexadecimal: the streams this process owns."""
    part: Mapping[str, Any] = field(default_factory=dict)
    """The role's part of the scenario."""
    first: int = 0
    """The first slot that this process sees: of one that is started again, where it goes on."""
    ends_with_stdin: bool = False
    """End when standard input closes: the launcher holds its other end, so nothing outlives a killed launcher."""
    patience: int = 30
    """Seconds that it waits for the others to be there."""
    identity: Identity | None = None
    """Of a run whose router takes certificates."""

    @property
    def batch(self) -> Batch:
        """Slots and trials."""
        return Batch(self.slots, self.trials, self.first_trial)

    @property
    def stream_keys(self) -> dict[str, bytes]:
        """The keys of the streams this process owns."""
        return {name: bytes.fromhex(key) for name, key in self.keys.items()}

    def write(self, directory: Path) -> Path:
        """Write `<process>.json`, readable by nobody else."""
        path = directory / f"{self.process}.json"
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            json.dump(asdict(self), file, indent=1)
        return path


def read_brief(path: Path, role: str | None = None) -> Brief:
    """The brief in a file. Raises BriefError if it is unreadable, readable by others, or another role's."""
    try:
        if path.stat().st_mode & 0o077:
            raise BriefError(f"{path} is readable by others; a brief holds keys: chmod 600 {path}")
        brief = _parsed(json.loads(path.read_text()))
    except OSError as error:
        raise BriefError(f"{path}: {error.strerror}; give the file that `evedrop brief` wrote") from error
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise BriefError(
            f"{path} is not a brief of this version ({error}); write it again with `evedrop brief`"
        ) from error
    if role is not None and brief.role != role:
        raise BriefError(
            f"{path} is the brief of a {brief.role}; expected one of a {role}: start `evedrop {brief.role}`"
        )
    return brief


def _parsed(found: Any) -> Brief:
    if not isinstance(found, dict):
        raise TypeError("not a JSON object")
    unknown = set(found) - {known.name for known in fields(Brief)}
    if unknown:
        raise TypeError(f"unknown entry {min(unknown)}")
    if found["role"] not in ROLES:
        raise ValueError(f"unknown role {found['role']}")
    for names, kind in _KINDS.items():
        for name in names:
            if type(found[name]) is not kind:
                raise TypeError(f"{name} is no {kind.__name__}")
    for name in _PARTS[found["role"]]:
        if name not in found["part"]:
            raise ValueError(f"part.{name} is missing")
    for name, key in found["keys"].items():
        if not isinstance(key, str) or len(bytes.fromhex(key)) != KEY_BYTES:
            raise ValueError(f"the key of {name} is not {KEY_BYTES} bytes")
    identity = found.get("identity")
    if identity is not None:
        identity = Identity(**identity)
        if not all(isinstance(value, str) for value in asdict(identity).values()):
            raise TypeError("identity has an entry that is no str")
    brief = Brief(**{**found, "flow": Flow(**found["flow"]), "model": Model(**found["model"]), "identity": identity})
    _check_numbers(brief)
    return brief


def _check_numbers(brief: Brief) -> None:
    """Raise ValueError or TypeError for numbers that no run has."""
    if type(brief.patience) is not int or brief.patience < 1:
        raise ValueError("patience must be a whole number of seconds, at least 1")
    if min(brief.slots, brief.trials, brief.recorded, brief.flow.window, brief.flow.batch) < 1 or brief.first_trial < 0:
        raise ValueError("slots, trials, recorded, flow.window and flow.batch must be at least 1")
    model = brief.model
    A, Q, initial = (np.array(M, np.float64) for M in (model.A, model.Q, model.initial_covariance))
    if mistakes_of(A, Q, initial, model.singular_noise):
        raise ValueError("its model is no process")
