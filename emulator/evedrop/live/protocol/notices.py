"""What a process says besides its reports: how far it is, that it ends on command, and that it cannot read a message.

Source: docs/protocol.md, progress, over and refusal.
"""

from __future__ import annotations

from typing import Annotated, Self

from msgspec import Meta, to_builtins

from evedrop.errors import Refusal
from evedrop.live.protocol.codec import Reader, StructMessage, pack, shown
from evedrop.live.protocol.keys import reads, writer_of
from evedrop.system.fields import Slot

_WHY_CHARACTERS = 1000


class Progress(StructMessage, frozen=True):
    """From a receiver or the recorder to the sensor: all slots below k are done."""

    k: Slot

    @classmethod
    def read(cls, key: str, payload: bytes, sent: int) -> Self:
        """Decode it; all slots below `sent` were sent. Raises MalformedMessage."""
        return cls(Reader(key, payload).integer("k", 0, sent))


class EndReport(StructMessage, frozen=True, omit_defaults=True):
    """The last message of a process that ends on command."""

    misdelivered: Annotated[int, Meta(ge=1, le=2**62)] = 0
    """How many messages it dropped because they named another key; left out if none."""

    def pack(self) -> bytes:
        """Encode it as a message."""
        return pack({"over": True, **to_builtins(self)})

    @classmethod
    def read(cls, message: Reader) -> Self | None:
        """Decode it; None if the message is another one. Raises MalformedMessage."""
        return message.read(cls) if message.has("over") else None


class RefusalNotice(StructMessage, frozen=True):
    """The last message of a process that ends because it cannot read a message."""

    refuses: str
    """The key of that message."""
    why: str
    """The mistake in it."""

    @classmethod
    def of(cls, key: str, why: str) -> Self:
        """The notice about a message on a key; only the beginning of a long reason is sent."""
        return cls(key, why[:_WHY_CHARACTERS])

    @classmethod
    def read(cls, message: Reader, process: str) -> Refusal | None:
        """Decode it into an error; None if the message is another one.

        Raises MalformedMessage if the key of the refused message is not one that the process reads.
        """
        if not message.has("refuses"):
            return None
        notice = message.read(cls)
        key = notice.refuses
        if key.split("/")[:2] != message.key.split("/")[:2] or not writer_of(key) or not reads(process, key):
            raise message.malformed(f"refuses = {shown(key)}", f"a key that {process} reads")
        plain = "".join(letter if letter.isprintable() else "?" for letter in notice.why[:_WHY_CHARACTERS])
        return Refusal(process, key, writer_of(key), plain)
