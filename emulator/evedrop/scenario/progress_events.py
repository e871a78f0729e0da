"""The events of progress of a run or study: a class for each kind.

The recorder sends it to its launcher as lines of JSON: `event`, and the entries of that kind.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from evedrop.model.entries import SLOT, Check, entry, listed, maybe, named, plain, text, whole


def _real(path: str, value: Any) -> Iterator[str]:
    """Check that a value is a number; errors of an estimate may be infinite."""
    if type(value) not in (int, float):
        yield f"{path} is {value!r:.40}, expected a number"


_TEXTS: Check = listed(text)


@dataclass(frozen=True)
class ProgressEvent:
    """Something that a command or function reports while it works."""

    kind: ClassVar[str]

    @property
    def plain(self) -> dict[str, object]:
        """The event as a JSON object."""
        return {"event": self.kind, **plain(self)}

    @property
    def line(self) -> bytes:
        """The event as a line for the launcher."""
        return json.dumps(self.plain, ensure_ascii=False).encode() + b"\n"


@dataclass(frozen=True)
class Started(ProgressEvent):
    """All processes are present, and the sensor begins."""

    kind = "started"


@dataclass(frozen=True)
class Held(ProgressEvent):
    """The operator holds the run."""

    kind = "held"
    before: int = field(metadata=entry(SLOT))
    """The slot before which the run is held."""


@dataclass(frozen=True)
class ConnectionOutage(ProgressEvent):
    """A process was cut off, and the run has gone on or ended since."""

    kind = "reconnected"
    process: str = field(metadata=entry(text))
    """The process whose connection was lost; the router if it was restarted, because every connection goes through it."""
    slot: int = field(metadata=entry(SLOT))
    """The first slot that was not joined when the loss was noticed."""
    until: int | None = field(metadata=entry(maybe(SLOT)))
    """The first slot that was not joined when the run went on; None if it did not."""
    seconds: float = field(metadata=entry(_real))
    """From the last joined slot before the loss until the run went on: the loss itself may be noticed late."""
    shard: int | None = field(default=None, metadata=entry(maybe(SLOT), left_out=True))
    """The shard whose process it is; None if the run is not in shards."""


@dataclass(frozen=True)
class RunProgress(ProgressEvent):
    """How far a run has come."""

    kind = "progress"
    done: int = field(metadata=entry(SLOT))
    """Slots in a live run; slots times trials in memory."""
    rate: float = field(metadata=entry(_real))
    """Of progress, in `rate_unit`."""
    rate_unit: str = field(metadata=entry(text))
    """`slots/s` or `trial-slots/s`."""
    squared_errors: Mapping[str, float] = field(metadata=entry(named(_real)))
    """Receiver → its squared error, mean over the trials and the latest slots; empty in memory."""
    total: int | None = field(default=None, metadata=entry(maybe(SLOT), left_out=True))
    """The value of `done` at the end; None in a live run, where it is the scenario's number of slots."""


@dataclass(frozen=True)
class RunEnded(ProgressEvent):
    """The end of a run, as the recorder sees it."""

    kind = "ended"
    status: int = field(metadata=entry(whole(0, 255)))
    """Its exit status."""
    how: str = field(metadata=entry(text))
    """`complete`, `interrupted`, or the reason for a failure."""
    suspects: Sequence[str] = field(default=(), metadata=entry(_TEXTS))
    """Processes that were missing."""
    accused: Sequence[str] = field(default=(), metadata=entry(_TEXTS))
    """Processes whose misbehaviour ended the run."""
    view: str | None = field(default=None, metadata=entry(maybe(text)))
    """Why the view stopped early, if it did."""
    broken_by: str | None = field(default=None, metadata=entry(maybe(text), left_out=True))
    """The process whose message broke the protocol, if that ended the run."""

    @property
    def well(self) -> bool:
        """Whether the run came to its end, whatever its expectations."""
        return self.status in {0, 1}


@dataclass(frozen=True)
class ViewOpened(ProgressEvent):
    """A live view is open, or there is a warning about it."""

    kind = "view"
    address: str | None = field(metadata=entry(maybe(text)))
    """The address to open in a browser; None for a window."""
    warning: str | None = field(default=None, metadata=entry(maybe(text)))


@dataclass(frozen=True)
class FolderMoved(ProgressEvent):
    """The results folder was renamed while the run went on."""

    kind = "moved"
    folder: str = field(metadata=entry(text))


@dataclass(frozen=True)
class RunEvent:
    """An event that took place during the run."""

    slot: int = field(metadata=entry(SLOT))
    event: str = field(metadata=entry(text))
    by: str = field(metadata=entry(text))
    """`scenario` or `operator`."""

    @property
    def line(self) -> str:
        """The event as a line of the view."""
        return self.event if self.by == "scenario" else f"{self.event} (by the {self.by})"


OnEvent = Callable[[ProgressEvent], None]
"""Takes each event."""


def silent(event: ProgressEvent) -> None:
    """Ignore an event."""
    del event
