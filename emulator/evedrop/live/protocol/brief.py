"""Briefs: a brief has everything that one process may know; the launcher writes it, and its path is the only argument.

A brief is `<process>.json`, mode 0600. It holds the keys of the streams that the process owns; only the recorder's brief
holds the scenario's seed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeGuard, TypeVar

import numpy as np

from evedrop.errors import BriefError
from evedrop.live.protocol.brief_parts import PARTS, Identity, Part
from evedrop.model.entries import (
    MATRIX,
    NUMBERS,
    anything,
    entry,
    expect,
    flag,
    inner,
    key,
    maybe,
    named,
    not_negative,
    number,
    plain,
    read,
    table_of,
    text,
    whole,
)
from evedrop.model.process import Process, mistakes_of
from evedrop.model.streams import MOST_SLOTS, Batch
from evedrop.system.files import Unreadable, opened, why_of

_MOST_TRIALS, _LAST_TRIAL = 1_000_000, 2**48
_MOST_BYTES = 2**30  # the recorder's brief holds the complete scenario
WRITE_AGAIN = "write it again with `evedrop brief`"


@dataclass(frozen=True)
class Flow:
    """End-to-end flow control, both in slots."""

    window: int = field(metadata=entry(whole(1)))
    """The sensor is at most this far ahead of the slowest receiver and of the recorder."""
    batch: int = field(metadata=entry(whole(1)))
    """Telemetry, journal and progress are sent at least this often."""
    longest_outage: float = field(default=30.0, metadata=entry(not_negative))
    """Seconds for which a process may be cut off before that ends the run."""
    largest_message: int = field(default=2**30, metadata=entry(whole(1)))
    """Bytes of the largest message of the run: larger ones are not accepted."""


@dataclass(frozen=True)
class Model:
    """The public model, which every process may know."""

    A: list[list[float]] = field(metadata=entry(MATRIX))
    Q: list[list[float]] = field(metadata=entry(MATRIX))
    initial_covariance: list[list[float]] = field(metadata=entry(MATRIX))
    state_probability: float = field(metadata=entry(number))
    """μ_d; its mean over the slots if it differs from slot to slot."""
    header: int = field(default=0, metadata=entry(whole(0, 64)))
    """How many unencrypted numbers a packet has in addition to its payload."""
    singular_noise: bool = field(default=False, metadata=entry(flag))
    """Whether Q may be singular."""
    state_probabilities: tuple[float, ...] | None = field(default=None, metadata=entry(NUMBERS, tuple, left_out=True))
    """μ_d(k) for every slot; None if it is the same in all slots."""

    @property
    def process(self) -> Process:
        """The process of the model."""
        return Process(np.array(self.A), np.array(self.Q), np.array(self.initial_covariance), self.singular_noise)


P_co = TypeVar("P_co", bound=Part, covariant=True)
P = TypeVar("P", bound=Part)


@dataclass(frozen=True, kw_only=True)
class Brief(Generic[P_co]):
    """Everything one process may know."""

    run: str = field(metadata=entry(text))
    process: str = field(metadata=entry(text))
    role: str = field(metadata=entry(text))
    router: str = field(metadata=entry(text))
    """Zenoh endpoint, such as unixsock-stream/PATH or tls/127.0.0.1:17460."""
    user: str = field(metadata=entry(text))
    password: str = field(repr=False, metadata=entry(text))
    slots: int = field(metadata=entry(whole(1, MOST_SLOTS)))
    trials: int = field(metadata=entry(whole(1, _MOST_TRIALS)))
    first_trial: int = field(metadata=entry(whole(0, _LAST_TRIAL)))
    recorded: int = field(metadata=entry(whole(1, _MOST_TRIALS)))
    """How many of the first trials are recorded in full."""
    flow: Flow = field(metadata=inner(Flow))
    model: Model = field(metadata=inner(Model))
    keys: Mapping[str, str] = field(repr=False, metadata=entry(named(key)))
    """Stream name → key, hexadecimal: the streams this process owns."""
    part: P_co = field(metadata=entry(named(anything)))
    """The role's part of the scenario."""
    first: int = field(default=0, metadata=entry(whole(0, MOST_SLOTS)))
    """The first slot that this process handles; above 0 for a restarted receiver."""
    ends_with_stdin: bool = field(metadata=entry(flag))
    """End when standard input closes: the launcher holds its other end, so nothing outlives a killed launcher."""
    patience: int = field(default=30, metadata=entry(whole(1)))
    """Seconds for which it waits for the other processes to appear."""
    identity: Identity | None = field(default=None, metadata=inner(Identity, or_null=True))
    """Its identity, if the run's router takes certificates."""
    last_word: str | None = field(default=None, metadata=entry(maybe(text), left_out=True))
    """The file for its last word (`evedrop.live.protocol.last_word`); None for a process that is started by hand."""

    @property
    def batch(self) -> Batch:
        """The slots and trials of the run."""
        return Batch(self.slots, self.trials, self.first_trial)

    @property
    def stream_keys(self) -> dict[str, bytes]:
        """The keys of the streams this process owns."""
        return {name: bytes.fromhex(key) for name, key in self.keys.items()}

    @property
    def text(self) -> str:
        """The brief as JSON."""
        return json.dumps(self, default=plain, indent=1)

    def write(self, directory: Path) -> Path:
        """Write `<process>.json`, readable by its owner only."""
        path = directory / f"{self.process}.json"
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            file.write(self.text)
        return path


AnyBrief = Brief[Part]


def has_part(brief: AnyBrief, kind: type[P]) -> TypeGuard[Brief[P]]:
    """Whether a brief has this kind of part, which says its role."""
    return isinstance(brief.part, kind)


def read_brief(path: Path, role: str | None = None) -> AnyBrief:
    """Read and check a brief. Raises BriefError if it is unreadable, readable by others, malformed, or another role's."""
    try:
        with opened(path) as file:
            status = os.fstat(file.fileno())
            if status.st_mode & 0o077:
                raise BriefError(f"{path} is readable by others; a brief holds keys: chmod 600 {path}")
            found = file.read(_MOST_BYTES) if status.st_size <= _MOST_BYTES else None
    except (OSError, Unreadable) as error:
        raise BriefError(f"{path}: {why_of(error)}; give the file that `evedrop brief` wrote") from error
    try:
        if found is None:
            raise ValueError(f"it has more than {_MOST_BYTES} bytes")
        brief = brief_from(json.loads(found.decode("utf-8")))
    except (ValueError, RecursionError) as error:
        raise BriefError(f"{path} is not a brief of this version ({error}); {WRITE_AGAIN}") from error
    if role is not None and brief.role != role:
        raise BriefError(
            f"{path} is the brief of a {brief.role}; expected one of a {role}: start `evedrop {brief.role}`"
        )
    return brief


def brief_from(found: Any) -> AnyBrief:
    """The brief of a decoded JSON text. Raises ValueError if it is not one."""
    expect(table_of(Brief), "", found)
    if found["role"] not in PARTS:
        raise ValueError(f"unknown role {found['role']:.40}, expected one of {', '.join(PARTS)}")
    kind = PARTS[found["role"]]
    expect(table_of(kind), "part", found["part"])
    brief: AnyBrief = read(Brief, {**found, "part": read(kind, found["part"])})
    model = brief.model
    try:
        matrices = [np.array(M, np.float64) for M in (model.A, model.Q, model.initial_covariance)]
    except (ValueError, OverflowError) as error:
        raise ValueError("model.A, model.Q or model.initial_covariance is not a matrix") from error
    if wrong := mistakes_of(matrices[0], matrices[1], matrices[2], model.singular_noise):
        raise ValueError(f"its model is not a process: model.{wrong[0][0]} {wrong[0][1]}")
    if not 0.0 <= model.state_probability <= 1.0:
        raise ValueError(f"model.state_probability is {model.state_probability}, expected a number from 0 to 1")
    if model.state_probabilities is not None:
        wrong_number = len(model.state_probabilities) != brief.slots
        if wrong_number or not all(0.0 <= one <= 1.0 for one in model.state_probabilities):
            raise ValueError(f"model.state_probabilities are not {brief.slots} numbers from 0 to 1, one for each slot")
    return brief
