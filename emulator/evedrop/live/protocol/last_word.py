"""The last word of a process that fails: a small file from which its launcher learns why, and whom the process blames.

A process that is killed or stopped, or whose interpreter crashes, leaves none: its status says how it ended.

Source: docs/protocol.md, the brief.
"""

from __future__ import annotations

from contextlib import suppress
from enum import StrEnum
from pathlib import Path

from msgspec import Struct, json

from evedrop.errors import EvedropError, Gap, MalformedMessage, MissingProcesses, NoRouter, Refusal
from evedrop.live.protocol.keys import writer_of
from evedrop.system.files import Unreadable, contents
from evedrop.system.output import escaped
from evedrop.system.structs import converted
from evedrop.system.world import world

_MOST_BYTES = 2**16


class Cause(StrEnum):
    """Why a process ended by itself."""

    MISSING_PROCESSES = "missing processes"
    """Those that it blames did not appear."""
    NO_CONNECTION = "no connection"
    """It had no connection with its router for too long."""
    BROKEN_PROTOCOL = "broken protocol"
    """The process that it blames sent a message that cannot be read, or left one out."""
    FAILURE = "failure"
    """Anything else."""


class LastWord(Struct, frozen=True, forbid_unknown_fields=True):
    """Why a process ended by itself."""

    cause: Cause
    sentence: str
    blamed: tuple[str, ...] = ()
    """The processes that it blames."""

    @classmethod
    def about(cls, error: EvedropError) -> LastWord:
        """The last word of a process that ends with this error."""
        if isinstance(error, MissingProcesses):
            return cls(Cause.MISSING_PROCESSES, str(error), error.missing)
        if isinstance(error, NoRouter):
            return cls(Cause.NO_CONNECTION, str(error))
        if (sender := protocol_breaker(error)) is not None:
            return cls(Cause.BROKEN_PROTOCOL, str(error), (sender,))
        return cls(Cause.FAILURE, str(error))

    def leave(self, file: str | Path | None) -> None:
        """Write it into a file, if that is possible; None: nobody asks for it."""
        if file is not None:
            with suppress(OSError, UnicodeEncodeError):
                world().disk.write(Path(file), json.encode(self))


def protocol_breaker(error: EvedropError) -> str | None:
    """The process whose message broke the protocol; None if the error is another one, or the key is not a process's."""
    return writer_of(error.key) or None if isinstance(error, MalformedMessage | Gap | Refusal) else None


def last_word_file(folder: Path, process: str) -> Path:
    """The file for the last word of a process, in the folder of its brief."""
    return folder.absolute() / f"{process}.last-word"


def read_last_word(file: Path) -> LastWord | None:
    """The last word in a file; None if there is none that can be read."""
    with suppress(Unreadable, ValueError, RecursionError):
        word = converted(json.decode(contents(file, _MOST_BYTES)), LastWord)
        return LastWord(word.cause, escaped(word.sentence), word.blamed)
    return None
