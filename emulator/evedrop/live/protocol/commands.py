"""The recorder's commands to the other processes, a class for each, and the report that it can ask of a process.

A process reports the slot that it is at and the keys on which it waits for messages. Only by asking all processes can the
recorder tell a connected process that does nothing from those that wait for it.

Source: docs/protocol.md, control and silence.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any, ClassVar, Self, final

from evedrop.live.protocol.codec import Reader, pack, shown
from evedrop.live.protocol.keys import reader_of
from evedrop.model.slot.link import Change
from evedrop.names import ROUTER, SENSOR


@dataclass(frozen=True)
class Bounds:
    """The slots and receivers that a command may name."""

    slots: int
    """The slots of the run."""
    receivers: Collection[str] | None = None
    """The names that it may have: of receivers, and to the sensor also the recorder; None: any."""


@dataclass(frozen=True)
class ControlCommand:
    """A command without fields; the others add theirs."""

    do: ClassVar[str]

    def pack(self) -> bytes:
        """Encode it as a message."""
        return pack({"do": self.do})

    @classmethod
    def read(cls, message: Reader, bounds: Bounds) -> Self:  # noqa: ARG003 - for kinds with fields
        """Decode a command of this kind. Raises MalformedMessage."""
        return cls()


@dataclass(frozen=True)
class Start(ControlCommand):
    """To the sensor: all processes are present; begin."""

    do = "start"


@dataclass(frozen=True)
class EndRun(ControlCommand):
    """To all: the run is over; confirm it and leave."""

    do = "end"


@dataclass(frozen=True)
class ReportStatus(ControlCommand):
    """To all: report your status."""

    do = "where"


@dataclass(frozen=True)
class Hold(ControlCommand):
    """To the sensor: stop before the next slot."""

    do = "hold"


@dataclass(frozen=True)
class Unknown(ControlCommand):
    """A command that this version does not know, and ignores."""

    do = "unknown"


@dataclass(frozen=True)
class Abandon(ControlCommand):
    """To all: the run was given up."""

    do = "abandon"
    why: str

    def pack(self) -> bytes:
        """Encode it as a message."""
        return pack({"do": self.do, "why": self.why})

    @classmethod
    def read(cls, message: Reader, bounds: Bounds) -> Self:  # noqa: ARG003 - for kinds that name receivers or slots
        """Decode it."""
        return cls(message.text("why"))


@dataclass(frozen=True)
class Go(ControlCommand):
    """To router and sensor: continue after a hold."""

    do = "go"
    slot: int
    """The slot before which the run is held."""
    absent: tuple[str, ...] | None = None
    """To the sensor: the receivers that it does not wait for from now on. None to the router."""
    until: int | None = None
    """To the sensor: the slot before which it holds again, if any."""

    def pack(self) -> bytes:
        """Encode it as a message."""
        absent = {} if self.absent is None else {"absent": list(self.absent)}
        until = {} if self.until is None else {"until": self.until}
        return pack({"do": self.do, "k": self.slot, **absent, **until})

    @classmethod
    def read(cls, message: Reader, bounds: Bounds) -> Self:
        """Decode it."""
        slot = message.integer("k")
        if reader_of(message.key) != SENSOR:
            return cls(slot)
        absent = message.names("absent")
        if bounds.receivers is not None and not set(absent) <= set(bounds.receivers):
            raise message.malformed(f"absent = {shown(absent)}", f"some of {', '.join(bounds.receivers)}")
        return cls(slot, absent, message.integer("until") if message.has("until") else None)


@dataclass(frozen=True)
class LinkChange(ControlCommand):
    """To the router: change a link."""

    do = "change"
    link: str
    """The receiver of the link."""
    changes: tuple[Change, ...]
    """All changes from the slot of the hold on."""

    def pack(self) -> bytes:
        """Encode it as a message."""
        return pack({"do": self.do, "link": self.link, "changes": _packed(self.changes)})

    @classmethod
    def read(cls, message: Reader, bounds: Bounds) -> Self:
        """Decode it."""
        link = message.text("link") if bounds.receivers is None else message.choice("link", bounds.receivers)
        return cls(link, _changes(message, "changes", bounds.slots))


@dataclass(frozen=True)
class Again(ControlCommand):
    """To all: send the messages again that may have been lost with a connection."""

    do = "again"
    round: int
    """Counted from 1."""
    slot: int
    """The first slot that is not joined."""
    links: Mapping[str, tuple[Change, ...]] | None = None
    """To the router: receiver → all changes of its link, for the links that the operator has changed. None to others."""

    def pack(self) -> bytes:
        """Encode it as a message."""
        links = (
            {} if self.links is None else {"links": {name: _packed(changes) for name, changes in self.links.items()}}
        )
        return pack({"do": self.do, "n": self.round, "k": self.slot, **links})

    @classmethod
    def read(cls, message: Reader, bounds: Bounds) -> Self:
        """Decode it."""
        number, slot = message.integer("n"), message.integer("k")
        if reader_of(message.key) != ROUTER:
            return cls(number, slot)
        names, links = message.map("links"), message.nested("links")
        for name in names:
            if bounds.receivers is not None and name not in bounds.receivers:
                raise message.malformed(f"the link {shown(name)}", f"one of {', '.join(bounds.receivers)}")
        return cls(number, slot, {name: _changes(links, name, bounds.slots) for name in names})


def _packed(changes: Sequence[Change]) -> list[dict[str, Any]]:
    """Changes of a link as in a message."""
    return [
        {
            "at": change.at,
            **({} if change.settings is None else {"settings": change.settings}),
            **({} if change.cut is None else {"cut": change.cut}),
        }
        for change in changes
    ]


def _changes(message: Reader, name: str, slots: int) -> tuple[Change, ...]:
    """The changes of a link in a field of a message; slots: of the run."""
    return tuple(
        Change(
            change.integer("at", 0, slots),
            change.map("settings") if change.has("settings") else None,
            change.flag("cut") if change.has("cut") else None,
        )
        for change in message.maps(name)
    )


_KINDS: Mapping[str, type[ControlCommand]] = {
    kind.do: kind for kind in (Start, EndRun, ReportStatus, Hold, Abandon, Go, LinkChange, Again)
}


def read_command(message: Reader, bounds: Bounds) -> ControlCommand:
    """Decode a command. Raises MalformedMessage."""
    return _KINDS.get(message.text("do"), Unknown).read(message, bounds)


_MOST_KEYS = 4096


@dataclass(frozen=True)
class ProcessStatus:
    """What a process reports of itself."""

    slot: int
    """The slot that it is at."""
    waits: tuple[str, ...]
    """The keys on which it waits for a message; empty if it does not wait."""

    def pack(self) -> bytes:
        """Encode it as a message."""
        return pack({"k": self.slot, "waits": list(self.waits)})


def is_process_status(message: Reader) -> bool:
    """Whether a message on telemetry or journal is a process's status."""
    return message.has("waits")


def read_process_status(message: Reader, slots: int) -> ProcessStatus:
    """Decode a process's status; slots: of the run."""
    waits = message.names("waits")
    if len(waits) > _MOST_KEYS:
        raise message.malformed(f"{len(waits)} keys in waits", f"{_MOST_KEYS} at most")
    return ProcessStatus(message.integer("k", 0, slots), waits)


@final
class StatusReporter:
    """Reports the status of its process: the working thread updates it, another thread answers requests."""

    def __init__(self) -> None:
        self.slot = 0
        """The slot that it is at."""
        self.waits: tuple[str, ...] = ()
        """As in `ProcessStatus`."""
        self._requests: SimpleQueue[None] = SimpleQueue()

    @contextmanager
    def waiting(self, *keys: str) -> Iterator[None]:
        """Record that the process waits on these keys during the block."""
        self.waits = keys
        try:
            yield
        finally:
            self.waits = ()

    def request(self) -> None:
        """Take a request from the recorder."""
        self._requests.put(None)

    def answer(self, put: Callable[[bytes], None]) -> None:
        """Start a thread that answers the requests; put: sends an answer."""

        def go_on() -> None:
            while True:
                self._requests.get()
                put(ProcessStatus(self.slot, self.waits).pack())

        threading.Thread(target=go_on, name="status", daemon=True).start()
