"""The operator's requests to a run or wire in progress, a class for each, and the status that it gets in answer.

Source: docs/protocol.md, request and answer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

from evedrop.live.protocol.codec import Reader, pack
from evedrop.model.entries import SLOT, entry, flag, listed, maybe, named, not_negative, read, table_of, text
from evedrop.scenario.progress_events import RunEvent


@dataclass(frozen=True)
class OperatorRequest:
    """A request without fields; the others add theirs."""

    do: ClassVar[str]
    repeatable: ClassVar[bool] = True
    """Whether nothing else happens if it is carried out twice."""

    def pack(self) -> bytes:
        """Encode it as a message."""
        return pack({"do": self.do})

    @classmethod
    def read(cls, message: Reader) -> Self:  # noqa: ARG003 - for kinds with fields
        """Decode a request of this kind. Raises MalformedMessage."""
        return cls()


@dataclass(frozen=True)
class LinkRequest(OperatorRequest):
    """Change, cut or heal a link; on a wire also a partition of two sides."""

    do = "link"
    repeatable = False
    event: Mapping[str, Any]
    """The entries of an [[event]] of a scenario or a wire, except its time; on a wire also `heal` and `join`, which end a cut
    and a partition."""

    def pack(self) -> bytes:
        """Encode it as a message."""
        return pack({"do": self.do, "event": self.event})

    @classmethod
    def read(cls, message: Reader) -> Self:
        """Decode it."""
        event = message.map("event")
        if not all(isinstance(name, str) for name in event):
            raise message.malformed(f"event = {event!r:.60}", "a map event with strings as keys")
        return cls(event)


@dataclass(frozen=True)
class PauseRequest(OperatorRequest):
    """Hold the run before its next slot."""

    do = "pause"


@dataclass(frozen=True)
class ResumeRequest(OperatorRequest):
    """Let a held run continue."""

    do = "resume"


@dataclass(frozen=True)
class StepRequest(OperatorRequest):
    """Let the run continue for some slots, and hold it again."""

    do = "step"
    repeatable = False
    slots: int

    def pack(self) -> bytes:
        """Encode it as a message."""
        return pack({"do": self.do, "slots": self.slots})

    @classmethod
    def read(cls, message: Reader) -> Self:
        """Decode it."""
        return cls(message.integer("slots", 1))


@dataclass(frozen=True)
class StatusRequest(OperatorRequest):
    """Say how the run or wire is."""

    do = "status"


REQUESTS: Mapping[str, type[OperatorRequest]] = {
    kind.do: kind for kind in (LinkRequest, PauseRequest, ResumeRequest, StepRequest, StatusRequest)
}
"""The word in the message → the request."""


def read_request(key: str, payload: bytes) -> OperatorRequest:
    """Decode a request. Raises MalformedMessage if the message is not a request."""
    message = Reader(key, payload)
    do = message.text("do")
    if do not in REQUESTS:
        raise message.malformed(f"do = {do!r}", f"one of {', '.join(REQUESTS)}")
    return REQUESTS[do].read(message)


@dataclass(frozen=True)
class LinkStatus:
    """The packets of a link so far."""

    offered: int = field(metadata=entry(SLOT))
    delivered: int = field(metadata=entry(SLOT))
    fraction: float | None = field(metadata=entry(maybe(not_negative)))
    """The fraction of the offered packets that was delivered; None if none was offered."""

    @classmethod
    def of(cls, offered: int, delivered: int) -> Self:
        """The status of a link with these packets."""
        return cls(offered, delivered, delivered / offered if offered else None)

    def __str__(self) -> str:
        fraction = "–" if self.fraction is None else f"{self.fraction:.4f}"
        return f"{self.delivered} of {self.offered} packets delivered, {fraction}"


def _links(tables: Mapping[str, Any]) -> dict[str, LinkStatus]:
    return {name: read(LinkStatus, table) for name, table in tables.items()}


def _events(events: Sequence[Mapping[str, Any]]) -> list[RunEvent]:
    return [read(RunEvent, happening) for happening in events]


@dataclass(frozen=True)
class RunStatus:
    """The state of a run in progress."""

    slot: int = field(metadata=entry(SLOT))
    """The first slot that is not scored."""
    slots: int = field(metadata=entry(SLOT))
    """The number of slots of the run."""
    slots_per_second: float = field(metadata=entry(not_negative))
    state: str = field(metadata=entry(text))
    """`running`, `held` or `paused`."""
    processes: Mapping[str, bool] = field(metadata=entry(named(flag)))
    """Process → whether it is on the network."""
    links: Mapping[str, LinkStatus] = field(metadata=entry(named(table_of(LinkStatus)), _links))
    """Receiver → its link."""
    events: Sequence[RunEvent] = field(metadata=entry(listed(table_of(RunEvent)), _events))

    @property
    def lines(self) -> Iterator[str]:
        """The status as lines of text."""
        state = self.state if self.state == "running" else f"{self.state} before slot {self.slot}"
        yield f"slot {self.slot} of {self.slots}, {self.slots_per_second:,.0f} slots/s, {state}"
        there = ", ".join(name for name, is_there in self.processes.items() if is_there)
        missing = ", ".join(name for name, is_there in self.processes.items() if not is_there)
        yield f"processes: {there}" + (f"; not on the network: {missing}" if missing else "")
        yield from (f"link {name}: {link}" for name, link in self.links.items())
        yield from (f"event at slot {event.slot}: {event.event} (by the {event.by})" for event in self.events)


def status_of_shards(statuses: Sequence[RunStatus]) -> RunStatus:
    """The status of a run in shards: the slowest one's slot; processes present if they are in all shards; and all packets."""
    slowest = min(statuses, key=lambda status: status.slot)
    processes = {name: all(shard.processes[name] for shard in statuses) for name in slowest.processes}
    links = {
        name: LinkStatus.of(
            *(sum(getattr(shard.links[name], count) for shard in statuses) for count in ("offered", "delivered"))
        )
        for name in slowest.links
    }
    return replace(slowest, processes=processes, links=links)


@dataclass(frozen=True)
class WireLinkStatus:
    """The messages of a wire's link so far."""

    heard: int = field(metadata=entry(SLOT))
    delivered: int = field(metadata=entry(SLOT))
    cut: bool = field(metadata=entry(flag))
    """Whether nothing passes now."""

    def __str__(self) -> str:
        fraction = f"{self.delivered / self.heard:.4f}" if self.heard else "–"
        return f"{self.delivered} of {self.heard} messages delivered, {fraction}" + (", cut" if self.cut else "")


def _wire_links(entries: Mapping[str, Any]) -> dict[str, WireLinkStatus]:
    return {name: read(WireLinkStatus, entry) for name, entry in entries.items()}


@dataclass(frozen=True)
class WireStatus:
    """The state of a wire."""

    seconds: float = field(metadata=entry(not_negative))
    """Since it began."""
    sides: Mapping[str, Sequence[str]] = field(metadata=entry(named(listed(text))))
    """Side → the endpoints at which programs connect."""
    links: Mapping[str, WireLinkStatus] = field(metadata=entry(named(table_of(WireLinkStatus)), _wire_links))
    events: Sequence[str] = field(metadata=entry(listed(text)))
    """The events so far, a line each."""
    journal: str = field(metadata=entry(text))
    """Whether the journal is complete, in words."""
    bypasses: Sequence[str] = field(metadata=entry(listed(text)))
    """The ways past the wire that it noticed, a line each."""

    @property
    def lines(self) -> Iterator[str]:
        """The status as lines of text."""
        yield f"{self.seconds:.1f} s, journal {self.journal}"
        yield from (f"side {name}: {', '.join(endpoints)}" for name, endpoints in self.sides.items())
        yield from (f"link {name}: {link}" for name, link in self.links.items())
        yield from (f"event at {event}" for event in self.events)
        yield from (f"no verdict: {bypass}" for bypass in self.bypasses)
