"""The lines that recorder and routers write for their launcher: JSON objects with `event`, its kind, and its entries.

Kinds that only the launcher needs are defined here; it passes the others, which are in `evedrop.scenario.progress_events`, on
to be shown.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

from evedrop.model.entries import SLOT, choice, entry, expect, read, table_of, text
from evedrop.names import ProcessAction
from evedrop.scenario.progress_events import (
    ConnectionOutage,
    Held,
    ProgressEvent,
    RunEnded,
    RunProgress,
    Started,
    ViewOpened,
)


@dataclass(frozen=True)
class Alive(ProgressEvent):
    """The recorder's heartbeat."""

    kind = "alive"


@dataclass(frozen=True)
class RouterListens(ProgressEvent):
    """From a router or relay, its only event: it listens, so the processes that connect to it may be started."""

    kind = "listening"
    process: str = field(metadata=entry(text))


@dataclass(frozen=True)
class ProcessRequest(ProgressEvent):
    """The recorder asks the launcher to act on a process, and to confirm it."""

    kind = "act"
    do: ProcessAction = field(metadata=entry(choice(ProcessAction), ProcessAction))
    process: str = field(metadata=entry(text))
    first: int = field(metadata=entry(SLOT))
    """The first slot that a restarted process handles."""
    number: int = field(metadata=entry(SLOT))
    """The number with which the launcher confirms it."""


@dataclass(frozen=True)
class SlotsDone(ProgressEvent):
    """All slots are done, and the processes will be told to leave."""

    kind = "over"


@dataclass(frozen=True)
class SaveStarted(ProgressEvent):
    """The recorder begins to write the results."""

    kind = "finishing"


_KINDS: Mapping[str, type[ProgressEvent]] = {
    one.kind: one
    for one in (
        Alive,
        RouterListens,
        Started,
        Held,
        ProcessRequest,
        ConnectionOutage,
        RunProgress,
        SlotsDone,
        SaveStarted,
        RunEnded,
        ViewOpened,
    )
}


def read_event(line: bytes) -> ProgressEvent:
    """Read a line of the recorder or a router. Raises ValueError if it is malformed."""
    try:
        entries = json.loads(line)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not isinstance(entries, dict) or not isinstance(event := entries.pop("event", None), str) or event not in _KINDS:
        raise ValueError(f"it is not an object with an event of {', '.join(_KINDS)}")
    kind = _KINDS[event]
    expect(table_of(kind), "", entries)
    return read(kind, entries)
