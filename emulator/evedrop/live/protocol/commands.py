"""The recorder's commands to the other processes, a class for each, and the report that it can ask of a process.

A process reports the slot that it is at and the keys on which it waits for messages. Only by asking all processes can the
recorder tell a connected process that does nothing from those that wait for it.

Source: docs/protocol.md, control and silence.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any, final

from msgspec import Meta, field, to_builtins

from evedrop.live.protocol.codec import Reader, StructMessage, pack, shown
from evedrop.live.protocol.keys import reader_of
from evedrop.model.slot.link import Change
from evedrop.names import ROUTER, SENSOR
from evedrop.system.fields import Slot
from evedrop.system.threads import Queue
from evedrop.system.world import world

_KEY_LENGTH = 600
"""The most characters of a key: the names of a run and of a process have at most 250."""


@dataclass(frozen=True)
class Bounds:
    """The slots and receivers that a command may name."""

    slots: int
    """The slots of the run."""
    receivers: Collection[str] | None = None
    """The names that it may have: of receivers, and to the sensor also the recorder; None: any."""


class ControlCommand(StructMessage, frozen=True, omit_defaults=True, tag_field="do"):
    """A command without fields; the others add theirs."""

    def expect(self, message: Reader, bounds: Bounds) -> None:
        """Raise MalformedMessage if it names what the run does not have, or lacks what its reader needs."""


class Start(ControlCommand, frozen=True, tag="start"):
    """To the sensor: all processes are present; begin."""


class EndRun(ControlCommand, frozen=True, tag="end"):
    """To all: the run is over; confirm it and leave."""


class ReportStatus(ControlCommand, frozen=True, tag="where"):
    """To all: report your status."""


class Hold(ControlCommand, frozen=True, tag="hold"):
    """To the sensor: stop before the next slot."""


class Abandon(ControlCommand, frozen=True, tag="abandon"):
    """To all: the run was given up."""

    why: str


class Go(ControlCommand, frozen=True, tag="go"):
    """To router and sensor: continue after a hold."""

    slot: Slot = field(name="k")
    """The slot before which the run is held."""
    absent: tuple[str, ...] | None = None
    """To the sensor: the receivers that it does not wait for from now on. None to the router."""
    until: Slot | None = None
    """To the sensor: the slot before which it holds again, if any."""

    def expect(self, message: Reader, bounds: Bounds) -> None:
        """The sensor needs the absent, which are processes of the run."""
        if reader_of(message.key) != SENSOR:
            return
        if self.absent is None:
            raise message.malformed("absent = None", "a list absent of strings")
        if bounds.receivers is not None and not set(self.absent) <= set(bounds.receivers):
            raise message.malformed(f"absent = {shown(self.absent)}", f"some of {', '.join(bounds.receivers)}")
        if self.until is not None and self.until <= self.slot:
            raise message.malformed(f"until = {self.until}", f"a slot after {self.slot}")


class LinkChange(ControlCommand, frozen=True, tag="change"):
    """To the router: change a link."""

    link: str
    """The receiver of the link."""
    changes: tuple[Change, ...]
    """All changes from the slot of the hold on."""

    def pack(self) -> bytes:
        """Encode it as a message."""
        return pack(to_builtins(self) | {"changes": _packed(self.changes)})

    def expect(self, message: Reader, bounds: Bounds) -> None:
        """The link is one of the run's, and so are the slots."""
        _expect_changes(message, bounds, {self.link: self.changes})


class Again(ControlCommand, frozen=True, tag="again"):
    """To all: send the messages again that may have been lost with a connection."""

    round: Slot = field(name="n")
    """Counted from 1."""
    slot: Slot = field(name="k")
    """The first slot that is not joined."""
    links: Mapping[str, tuple[Change, ...]] | None = None
    """To the router: receiver → all changes of its link, for the links that the operator has changed. None to others."""

    def pack(self) -> bytes:
        """Encode it as a message."""
        links = {name: _packed(changes) for name, changes in (self.links or {}).items()}
        return pack(to_builtins(self) | ({} if self.links is None else {"links": links}))

    def expect(self, message: Reader, bounds: Bounds) -> None:
        """The round and the slot are possible. The router needs the changed links, which are of the run."""
        if self.round < 1 or self.slot > bounds.slots:
            raise message.malformed(f"n = {self.round}, k = {self.slot}", f"n from 1 on, and k up to {bounds.slots}")
        if reader_of(message.key) == ROUTER:
            if self.links is None:
                raise message.malformed("links = None", "a map links")
            _expect_changes(message, bounds, self.links)


def _packed(changes: Sequence[Change]) -> list[dict[str, Any]]:
    """Changes of a link as in a message, without what they keep."""
    return [{name: value for name, value in to_builtins(change).items() if value is not None} for change in changes]


def _expect_changes(message: Reader, bounds: Bounds, links: Mapping[str, Sequence[Change]]) -> None:
    """Raise MalformedMessage for a link or a slot that the run does not have."""
    for name, changes in links.items():
        if bounds.receivers is not None and name not in bounds.receivers:
            raise message.malformed(f"the link {shown(name)}", f"one of {', '.join(bounds.receivers)}")
        for change in changes:
            if not 0 <= change.at <= bounds.slots:
                raise message.malformed(f"at = {change.at}", f"an integer at from 0 to {bounds.slots}")


_KINDS: Mapping[str, type[ControlCommand]] = {
    str(kind.__struct_config__.tag): kind
    for kind in (Start, EndRun, ReportStatus, Hold, Abandon, Go, LinkChange, Again)
}


def read_command(message: Reader, bounds: Bounds) -> ControlCommand:
    """Decode a command. Raises MalformedMessage, also for an unknown command, since ignoring it may make results wrong."""
    name = message.text("do")
    kind = _KINDS.get(name)
    if kind is None:
        raise message.malformed(f"do = {shown(name)}", f"one of {', '.join(_KINDS)}")
    command = message.read(kind)
    command.expect(message, bounds)
    return command


class ProcessStatus(StructMessage, frozen=True):
    """What a process reports of itself."""

    slot: Slot = field(name="k")
    """The slot that it is at."""
    waits: Annotated[tuple[str, ...], Meta(max_length=4096)]
    """The keys on which it waits for a message, or a key of its own for whose reader it waits; empty if it does not wait."""


def is_process_status(message: Reader) -> bool:
    """Whether a message on telemetry or journal is a process's status."""
    return message.has("waits")


def read_process_status(message: Reader, slots: int) -> ProcessStatus:
    """Decode a process's status; slots: of the run."""
    message.integer("k", 0, slots)
    status = message.read(ProcessStatus)
    for key in status.waits:  # a failure quotes them
        if key.count("/") < 2 or len(key) > _KEY_LENGTH or not key.isprintable():
            raise message.malformed(f"waits has {shown(key)}", "keys of a run")
    return status


@final
class StatusReporter:
    """Reports the status of its process: the working thread updates it, another thread answers requests."""

    def __init__(self) -> None:
        self.slot = 0
        """The slot that it is at."""
        self.waits: tuple[str, ...] = ()
        """As in `ProcessStatus`."""
        self._requests: Queue[None] = world().queue()

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

        world().thread(go_on, name="status").start()
