"""The operator's requests to a run or wire in progress, a class for each, and the status that it gets in answer.

Source: docs/protocol.md, request and answer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self

from msgspec import Meta, Struct, structs

from evedrop.live.protocol.codec import Reader, StructMessage
from evedrop.scenario.progress_events import RunEvent
from evedrop.system.fields import NotNegative, Slot


class OperatorRequest(StructMessage, frozen=True, tag_field="do"):
    """A request without fields; the others add theirs."""

    repeatable: ClassVar[bool] = True
    """Whether nothing else happens if it is carried out twice."""


class LinkRequest(OperatorRequest, frozen=True, tag="link"):
    """Change, cut or heal a link; on a wire also a partition of two sides."""

    repeatable = False
    event: Mapping[str, Any]
    """The entries of an [[event]] of a scenario or a wire, except its time; on a wire also `heal` and `join`, which end a cut
    and a partition."""


class PauseRequest(OperatorRequest, frozen=True, tag="pause"):
    """Hold the run before its next slot."""


class ResumeRequest(OperatorRequest, frozen=True, tag="resume"):
    """Let a held run continue."""


class StepRequest(OperatorRequest, frozen=True, tag="step"):
    """Let the run continue for some slots, and hold it again."""

    repeatable = False
    slots: Annotated[int, Meta(ge=1, le=2**62)]


class StatusRequest(OperatorRequest, frozen=True, tag="status"):
    """Say how the run or wire is."""


REQUESTS: Mapping[str, type[OperatorRequest]] = {
    str(kind.__struct_config__.tag): kind
    for kind in (LinkRequest, PauseRequest, ResumeRequest, StepRequest, StatusRequest)
}
"""The word in the message → the request."""


def read_request(key: str, payload: bytes) -> OperatorRequest:
    """Decode a request. Raises MalformedMessage if the message is not a request."""
    message = Reader(key, payload)
    return message.read(REQUESTS[message.choice("do", REQUESTS)])


class LinkStatus(Struct, frozen=True, forbid_unknown_fields=True):
    """The packets of a link so far."""

    offered: Slot
    delivered: Slot
    fraction: NotNegative | None
    """The fraction of the offered packets that was delivered; None if none was offered."""

    @classmethod
    def of(cls, offered: int, delivered: int) -> Self:
        """The status of a link with these packets."""
        return cls(offered, delivered, delivered / offered if offered else None)

    def __str__(self) -> str:
        fraction = "–" if self.fraction is None else f"{self.fraction:.4f}"
        return f"{self.delivered} of {self.offered} packets delivered, {fraction}"


class RunStatus(Struct, frozen=True, forbid_unknown_fields=True):
    """The state of a run in progress."""

    slot: Slot
    """The first slot that is not scored."""
    slots: Slot
    """The number of slots of the run."""
    slots_per_second: NotNegative
    state: str
    """`running`, `held` or `paused`."""
    processes: Mapping[str, bool]
    """Process → whether it is on the network."""
    links: Mapping[str, LinkStatus]
    """Receiver → its link."""
    events: Sequence[RunEvent]

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
    return structs.replace(slowest, processes=processes, links=links)


class WireLinkStatus(Struct, frozen=True, forbid_unknown_fields=True):
    """The messages of a wire's link so far."""

    heard: Slot
    delivered: Slot
    cut: bool
    """Whether nothing passes now."""

    def __str__(self) -> str:
        fraction = f"{self.delivered / self.heard:.4f}" if self.heard else "–"
        return f"{self.delivered} of {self.heard} messages delivered, {fraction}" + (", cut" if self.cut else "")


class WireStatus(Struct, frozen=True, forbid_unknown_fields=True):
    """The state of a wire."""

    seconds: NotNegative
    """Since it began."""
    sides: Mapping[str, Sequence[str]]
    """Side → the endpoints at which programs connect."""
    links: Mapping[str, WireLinkStatus]
    events: Sequence[str]
    """The events so far, a line each."""
    journal: str
    """Whether the journal is complete, in words."""
    bypasses: Sequence[str]
    """The ways past the wire that it noticed, a line each."""

    @property
    def lines(self) -> Iterator[str]:
        """The status as lines of text."""
        yield f"{self.seconds:.1f} s, journal {self.journal}"
        yield from (f"side {name}: {', '.join(endpoints)}" for name, endpoints in self.sides.items())
        yield from (f"link {name}: {link}" for name, link in self.links.items())
        yield from (f"event at {event}" for event in self.events)
        yield from (f"no verdict: {bypass}" for bypass in self.bypasses)
