"""The operator's requests to a run or wire in progress, a class for each.

Source: docs/protocol.md, request.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from evedrop.live.protocol.codec import Reader, pack


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
