"""What programs get from a simulated session: messages, answers, and what becomes of its connections.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import zenoh

from evedrop.virtual.zenoh.transport import TransportFrame


class VirtualSample(NamedTuple):
    """A message as its reader gets it."""

    key_expr: str
    payload: zenoh.ZBytes
    kind: zenoh.SampleKind = zenoh.SampleKind.PUT
    encoding: zenoh.Encoding = zenoh.Encoding.ZENOH_BYTES
    attachment: zenoh.ZBytes | None = None
    timestamp: zenoh.Timestamp | None = None
    source_info: zenoh.SourceInfo | None = None
    priority: zenoh.Priority = zenoh.Priority.DATA
    congestion_control: zenoh.CongestionControl = zenoh.CongestionControl.BLOCK
    express: bool = False

    @classmethod
    def of(cls, frame: TransportFrame, key: str | None = None) -> VirtualSample:
        """The message of a frame; key: another one than its own."""
        return cls(frame.key if key is None else key, zenoh.ZBytes(frame.payload), *frame.details)


@dataclass(frozen=True)
class VirtualTransport:
    """Who is at the other end of a connection."""

    zid: str
    whatami: zenoh.WhatAmI
    auth_identifier: str | None
    dst: str


@dataclass(frozen=True)
class TransportEvent:
    """A connection that was made (`PUT`) or lost (`DELETE`)."""

    kind: zenoh.SampleKind
    transport: VirtualTransport

    @property
    def link(self) -> VirtualTransport:
        """The same: a connection has one link."""
        return self.transport


@dataclass(frozen=True)
class MatchingStatus:
    """Whether somebody reads what is published, or answers what is asked."""

    matching: bool


@dataclass(frozen=True)
class ReplyError:
    """What comes instead of an answer."""

    payload: zenoh.ZBytes
    encoding: zenoh.Encoding = zenoh.Encoding.ZENOH_BYTES


@dataclass(frozen=True)
class Replier:
    """Who sent an answer."""

    eid: int


QUERYABLE = Replier(1)
"""A queryable. Zenoh's routing, which sends nothing here, is number 0."""


@dataclass(frozen=True)
class VirtualReply:
    """An answer to a question, or an error; without a replier that of the querier, whose time for answers is over."""

    ok: VirtualSample | None
    err: ReplyError | None = None
    replier_id: Replier | None = QUERYABLE


def bytes_of(payload: bytes | str | zenoh.ZBytes | None) -> bytes:
    """The bytes of what a program puts."""
    if payload is None or isinstance(payload, bytes):
        return payload or b""
    return payload.encode() if isinstance(payload, str) else payload.to_bytes()
