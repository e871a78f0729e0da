"""The observer's news to its launcher, a class for each kind: JSON objects, one a line, with `event` and its entries.

The launcher adds kinds of its own, and hands all of them on to be shown.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from evedrop.live.protocol.entries import (
    SLOT,
    Check,
    entry,
    expect,
    listed,
    maybe,
    named,
    plain,
    read,
    table_of,
    text,
    whole,
)
from evedrop.names import ProcessAction


def _real(path: str, found: Any) -> Iterator[str]:
    """Check that a value is a number; errors of an estimate may be infinite."""
    if type(found) not in (int, float):
        yield f"{path} is {found!r:.40}, expected a number"


def _action(path: str, found: Any) -> Iterator[str]:
    if found not in [*ProcessAction]:
        yield f"{path} is {found!r:.40}, expected one of {', '.join(ProcessAction)}"


_TEXTS: Check = listed(text)


@dataclass(frozen=True)
class News:
    """One item of news."""

    event: ClassVar[str]

    @property
    def plain(self) -> dict[str, object]:
        """The news as they are written, and shown."""
        return {"event": self.event, **plain(self)}

    @property
    def line(self) -> bytes:
        """The news as a line for the launcher."""
        return json.dumps(self.plain, ensure_ascii=False).encode() + b"\n"


@dataclass(frozen=True)
class Alive(News):
    """The observer's heartbeat."""

    event = "alive"


@dataclass(frozen=True)
class Started(News):
    """All processes are there, and the sensor begins."""

    event = "started"


@dataclass(frozen=True)
class Held(News):
    """The operator holds the run."""

    event = "held"
    before: int = field(metadata=entry(SLOT))
    """Slot."""


@dataclass(frozen=True)
class ProcessRequest(News):
    """The observer asks the launcher to act on a process, and to confirm it."""

    event = "act"
    do: ProcessAction = field(metadata=entry(_action, ProcessAction))
    process: str = field(metadata=entry(text))
    first: int = field(metadata=entry(SLOT))
    """The first slot that a restarted process handles."""
    number: int = field(metadata=entry(SLOT))
    """By which the launcher confirms it."""


@dataclass(frozen=True)
class ConnectionOutage(News):
    """A process was cut off, and the run has gone on or ended since."""

    event = "reconnected"
    process: str = field(metadata=entry(text))
    """The process whose connection was lost; the router, if it was restarted, since all connections are with it."""
    slot: int = field(metadata=entry(SLOT))
    """The first slot that was not joined when the loss was noticed."""
    until: int | None = field(metadata=entry(maybe(SLOT)))
    """The first slot that was not joined when the run went on; None if it did not."""
    seconds: float = field(metadata=entry(_real))
    """From the last joined slot before the loss until the run went on: the loss itself may be noticed late."""
    shard: int | None = field(default=None, metadata=entry(maybe(SLOT), left_out=True))
    """The shard whose process it is; None if the run is not in shards."""


@dataclass(frozen=True)
class RunProgress(News):
    """How far a run has come."""

    event = "progress"
    done: int = field(metadata=entry(SLOT))
    """Slots."""
    rate: float = field(metadata=entry(_real))
    rate_unit: str = field(metadata=entry(text))
    squared_errors: Mapping[str, float] = field(metadata=entry(named(_real)))
    """Estimator → its mean over the trials, in the last slots."""


@dataclass(frozen=True)
class RunOver(News):
    """All slots are done, and the processes are told to leave."""

    event = "over"


@dataclass(frozen=True)
class Finishing(News):
    """The observer begins to write the results."""

    event = "finishing"


@dataclass(frozen=True)
class RunEnded(News):
    """The end of a run, as the observer sees it."""

    event = "ended"
    status: int = field(metadata=entry(whole(0, 255)))
    """Its exit status."""
    how: str = field(metadata=entry(text))
    """`complete`, `interrupted`, or the reason of a failure."""
    suspects: Sequence[str] = field(default=(), metadata=entry(_TEXTS))
    """Processes that were missing."""
    accused: Sequence[str] = field(default=(), metadata=entry(_TEXTS))
    """Processes whose misbehaviour ended the run."""
    view: str | None = field(default=None, metadata=entry(maybe(text)))
    """Why the view stopped early, if it did."""

    @property
    def well(self) -> bool:
        """Whether the run came to its end, whatever its expectations."""
        return self.status in {0, 1}


@dataclass(frozen=True)
class ViewOpened(News):
    """There is a live view."""

    event = "view"
    address: str | None = field(metadata=entry(maybe(text)))
    """For a browser; None for a window."""
    warning: str | None = field(default=None, metadata=entry(maybe(text)))


@dataclass(frozen=True)
class FolderMoved(News):
    """The results folder was renamed while the run went on."""

    event = "moved"
    folder: str = field(metadata=entry(text))


_KINDS: Mapping[str, type[News]] = {
    kind.event: kind
    for kind in (
        Alive,
        Started,
        Held,
        ProcessRequest,
        ConnectionOutage,
        RunProgress,
        RunOver,
        Finishing,
        RunEnded,
        ViewOpened,
    )
}


def read_news(line: bytes) -> News:
    """Read a line of the observer. Raises ValueError if it is malformed."""
    try:
        found = json.loads(line)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not isinstance(found, dict) or not isinstance(event := found.pop("event", None), str) or event not in _KINDS:
        raise ValueError(f"it is no object with an event of {', '.join(_KINDS)}")
    kind = _KINDS[event]
    expect(table_of(kind), "", found)
    return read(kind, found)
