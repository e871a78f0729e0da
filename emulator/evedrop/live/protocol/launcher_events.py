"""The lines that recorder and routers write for their launcher: JSON objects with `event`, its kind, and its entries.

Kinds that only the launcher needs are defined here; it passes the others, which are in `evedrop.scenario.progress_events`, on
to be shown.
"""

from __future__ import annotations

import json

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
from evedrop.system.fields import Slot
from evedrop.system.structs import converted


class Alive(ProgressEvent, frozen=True, tag="alive"):
    """The recorder's heartbeat."""


class RouterListens(ProgressEvent, frozen=True, tag="listening"):
    """From a router or relay, its only event: it listens, so the processes that connect to it may be started."""

    process: str


class ProcessRequest(ProgressEvent, frozen=True, tag="act"):
    """The recorder asks the launcher to act on a process, and to confirm it."""

    do: ProcessAction
    process: str
    first: Slot
    """The first slot that a restarted process handles."""
    number: Slot
    """The number with which the launcher confirms it."""


class SlotsDone(ProgressEvent, frozen=True, tag="over"):
    """All slots are done, and the processes will be told to leave."""


class SaveStarted(ProgressEvent, frozen=True, tag="finishing"):
    """The recorder begins to write the results."""


_ReadByLauncher = (
    Alive
    | RouterListens
    | Started
    | Held
    | ProcessRequest
    | ConnectionOutage
    | RunProgress
    | SlotsDone
    | SaveStarted
    | RunEnded
    | ViewOpened
)


def read_event(line: bytes) -> ProgressEvent:
    """Read a line of the recorder or a router. Raises ValueError if it is malformed."""
    try:
        event: ProgressEvent = converted(json.loads(line), _ReadByLauncher)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    return event
