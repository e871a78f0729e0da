"""The events of progress of a run or study: a class for each kind.

The recorder sends it to its launcher as lines of JSON: `event`, and the entries of that kind.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated

from msgspec import Meta, Struct, to_builtins

from evedrop.system.fields import Slot


class ProgressEvent(Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True, tag_field="event"):
    """Something that a command or function reports while it works."""

    @property
    def line(self) -> bytes:
        """The event as a line for the launcher."""
        # Errors of an estimate may be infinite, for which msgspec would write null.
        return json.dumps(to_builtins(self), ensure_ascii=False).encode() + b"\n"


class Started(ProgressEvent, frozen=True, tag="started"):
    """All processes are present, and the sensor begins."""


class Held(ProgressEvent, frozen=True, tag="held"):
    """The operator holds the run."""

    before: Slot
    """The slot before which the run is held."""


class ConnectionOutage(ProgressEvent, frozen=True, tag="reconnected"):
    """A process was cut off, and the run has gone on or ended since."""

    process: str
    """The process whose connection was lost; the router if it was restarted, because every connection goes through it."""
    slot: Slot
    """The first slot that was not joined when the loss was noticed."""
    until: Slot | None
    """The first slot that was not joined when the run went on; None if it did not."""
    seconds: float
    """From the last joined slot before the loss until the run went on: the loss itself may be noticed late."""
    shard: Slot | None = None
    """The shard whose process it is; None if the run is not in shards."""


class RunProgress(ProgressEvent, frozen=True, tag="progress"):
    """How far a run has come."""

    done: Slot
    """Slots in a live run; slots times trials in memory."""
    rate: float
    """Of progress, in `rate_unit`."""
    rate_unit: str
    """`slots/s` or `trial-slots/s`."""
    squared_errors: Mapping[str, float]
    """Receiver → its squared error, mean over the trials and the latest slots; empty in memory."""
    total: Slot | None = None
    """The value of `done` at the end; None in a live run, where it is the scenario's number of slots."""


class RunEnded(ProgressEvent, frozen=True, tag="ended"):
    """The end of a run, as the recorder sees it."""

    status: Annotated[int, Meta(ge=0, le=255)]
    """Its exit status."""
    how: str
    """`complete`, `interrupted`, or the reason for a failure."""
    suspects: Sequence[str] = ()
    """Processes that were missing."""
    accused: Sequence[str] = ()
    """Processes whose misbehaviour ended the run."""
    view: str | None = None
    """Why the view stopped early, if it did."""
    broken_by: str | None = None
    """The process whose message broke the protocol, if that ended the run."""

    @property
    def well(self) -> bool:
        """Whether the run came to its end, whatever its expectations."""
        return self.status in {0, 1}


class ViewOpened(ProgressEvent, frozen=True, tag="view"):
    """A live view is open, or there is a warning about it."""

    address: str | None
    """The address to open in a browser; None for a window."""
    warning: str | None = None


class FolderMoved(ProgressEvent, frozen=True, tag="moved"):
    """The results folder was renamed while the run went on."""

    folder: str


class RunEvent(Struct, frozen=True, forbid_unknown_fields=True):
    """An event that took place during the run."""

    slot: Slot
    event: str
    by: str
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
