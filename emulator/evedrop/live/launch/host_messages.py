"""The messages between a launcher and the program that starts processes for it on another host, over ssh.

Each message is one JSON object on a line: the entries of its class, and its kind. Closing the launcher's side ends everything
on the host.

Source: docs/hosts.md, how it works.
"""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

from evedrop.live.launch.starter import FORK_SERVER_LOST
from evedrop.live.protocol.brief import AnyBrief, brief_from
from evedrop.live.protocol.last_word import LastWord
from evedrop.model.entries import (
    SLOT,
    anything,
    entry,
    expect,
    inner,
    named,
    not_negative,
    plain,
    read,
    table,
    table_of,
    text,
    whole,
)

MOST_NOISE = 200
"""The most lines that the login shell of a host may print before the program begins."""
_KIND = "kind"
_NUMBER = entry(SLOT)


@dataclass(frozen=True)
class HostMessage:
    """The base class of all messages."""

    kind: ClassVar[str]


@dataclass(frozen=True)
class StartProcess(HostMessage):
    """To the host: start a process."""

    kind = "start"
    number: int = field(metadata=_NUMBER)
    """Distinguishes it from all other processes of the run."""
    brief: AnyBrief = field(repr=False, metadata=entry(anything, brief_from))
    environment: Mapping[str, str] = field(metadata=entry(named(text)))
    """Variables in addition to those of the host."""


@dataclass(frozen=True)
class SendSignal(HostMessage):
    """To the host: send a signal to a process."""

    kind = "signal"
    number: int = field(metadata=_NUMBER)
    signal: int = field(metadata=entry(whole(1, 64)))


@dataclass(frozen=True)
class LauncherHeartbeat(HostMessage):
    """To the host: the launcher is still there."""

    kind = "heartbeat"
    silence: float = field(metadata=entry(not_negative))
    """Seconds after which the host may consider a silent launcher gone."""


@dataclass(frozen=True)
class Greeting(HostMessage):
    """To the launcher, before all else: the program runs."""

    kind = "greeting"
    evedrop: str = field(metadata=entry(text))
    """Its version."""


@dataclass(frozen=True)
class LogText(HostMessage):
    """To the launcher: what a process has written to its log."""

    kind = "log"
    number: int = field(metadata=_NUMBER)
    written: str = field(metadata=entry(text))


@dataclass(frozen=True)
class ProcessEnded(HostMessage):
    """To the launcher: a process has ended."""

    kind = "ended"
    number: int = field(metadata=_NUMBER)
    status: int = field(metadata=entry(whole(-64, FORK_SERVER_LOST)))
    """Negative: the signal that ended it. `FORK_SERVER_LOST`: it ended with its fork server."""
    last_word: LastWord | None = field(default=None, metadata=inner(LastWord, left_out=True))
    """Why it ended, if it could tell."""


Order = StartProcess | SendSignal | LauncherHeartbeat
"""What a launcher sends."""
Answer = LogText | ProcessEnded
"""What a host sends after its greeting."""
_ORDERS: tuple[type[Order], ...] = (StartProcess, SendSignal, LauncherHeartbeat)
_ANSWERS: tuple[type[Answer], ...] = (LogText, ProcessEnded)
M = TypeVar("M", bound=HostMessage)


def line_of(message: HostMessage) -> bytes:
    """A message as a line."""
    return json.dumps({_KIND: message.kind, **plain(message)}, default=plain).encode() + b"\n"


def order_in(line: bytes) -> Order:
    """The order of a line. Raises ValueError if it is not one."""
    return _message_in(line, _ORDERS)


def answer_in(line: bytes) -> Answer:
    """The answer of a line. Raises ValueError if it is not one."""
    return _message_in(line, _ANSWERS)


def greeting_in(line: bytes) -> Greeting:
    """The greeting of a line, of any version of the program. Raises ValueError if it is not one."""
    found = _object_in(line)
    expect(table({"evedrop": text}, strict=False), "", found)
    return Greeting(found["evedrop"])


def _message_in(line: bytes, kinds: Collection[type[M]]) -> M:
    found = _object_in(line)
    name = found.pop(_KIND, None)
    kind = next((kind for kind in kinds if kind.kind == name), None)
    if kind is None:
        raise _no_message(line)
    expect(table_of(kind), kind.kind, found)
    return read(kind, found)


def _object_in(line: bytes) -> dict[str, Any]:
    try:
        found = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise _no_message(line) from error
    if not isinstance(found, dict):
        raise _no_message(line)
    return found


def _no_message(line: bytes) -> ValueError:
    return ValueError(f"{line[:80]!r} is not a message")


def own_version() -> str:
    """The version of Evedrop, which must be the same on all hosts."""
    return importlib.metadata.version("evedrop")
