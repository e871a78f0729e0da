"""Reads and writes the pipes of a process that draws, with a limit: a process that hangs must not hang the command."""

from __future__ import annotations

import os
import select
import subprocess
from typing import IO, Final

from evedrop.errors import RunError

DRAWING_SECONDS: Final = 1800.0
"""How long a process that draws may do nothing that is seen. Its viewer answers within ten minutes, or says that it failed."""
_PIECE = 2**16


def received(pipe: IO[bytes], most: int) -> bytes:
    """The next bytes of an unbuffered pipe, up to a number; fewer if the other end was closed.

    Raises RunError if none come for `DRAWING_SECONDS`.
    """
    pieces, left = [], most
    while left:
        if not select.select([pipe], [], [], DRAWING_SECONDS)[0]:
            raise _hung("drew nothing")
        if not (piece := os.read(pipe.fileno(), min(left, _PIECE))):
            break
        pieces.append(piece)
        left -= len(piece)
    return b"".join(pieces)


def give(pipe: IO[bytes], data: bytes) -> None:
    """Write to an unbuffered pipe. Raises BrokenPipeError, and RunError if nothing is taken for `DRAWING_SECONDS`."""
    os.set_blocking(pipe.fileno(), False)
    view = memoryview(data)
    while view:
        if not select.select([], [pipe], [], DRAWING_SECONDS)[1]:
            raise _hung("took no further picture")
        view = view[os.write(pipe.fileno(), view) :]


def ended(process: subprocess.Popen[bytes]) -> int:
    """The exit status of a process that is about to end. Raises RunError if it does not end in `DRAWING_SECONDS`."""
    try:
        return process.wait(DRAWING_SECONDS)
    except subprocess.TimeoutExpired as error:
        raise _hung("did not end") from error


def _hung(subject: str) -> RunError:
    return RunError(
        f"the process that draws {subject} for {DRAWING_SECONDS:g} s, and was ended; something that it uses hangs, such as the "
        "driver of the graphics card, or a disk; try again, on another disk or with another driver"
    )
