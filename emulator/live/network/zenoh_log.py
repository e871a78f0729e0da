"""Zenoh's log of a process that others connect to: no line steers a terminal, and strangers can fill neither it nor a disk.

Zenoh writes its log to file descriptor 1, from threads of its own, and some of its lines are about bytes that anybody may send.
So descriptor 1 becomes a pipe, whose lines a thread passes on to standard error until there are too many. Python's standard
output keeps the former file.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
import threading
from collections.abc import Iterator
from typing import BinaryIO

from evedrop.output import Output, escaped

LOGGED = "error,zenoh_codec::common::extension=off"
"""What Zenoh logs by default; it would log an error for every stranger's frame that it cannot read."""
MARK = "zenoh: "
"""What each line of it begins with where it is passed on."""
_MOST_BYTES = 2**17
_MOST_PER_LINE = 2**12
_END_SECONDS = 1.0  # for the last lines; a process that inherited the pipe may keep it open
_STDOUT = 1
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


@contextlib.contextmanager
def zenoh_log_apart() -> Iterator[None]:
    """While the block runs, pass Zenoh's log on to standard error, each line with "zenoh: " before it and escaped.

    After 128 KiB, further lines are dropped, and a line says so. Raises OSError without descriptors.
    """
    with contextlib.ExitStack() as stack:
        former = os.dup(_STDOUT)
        stack.callback(os.close, former)
        stdout: object = sys.stdout
        sys.stdout.flush()
        if isinstance(stdout, Output):
            stack.enter_context(stdout.at(former, of=_STDOUT))
        reading, writing = os.pipe()
        lines = os.fdopen(reading, "rb")
        # A thread of Zenoh must never wait for us: it may hold a lock that a Python thread waits for.
        os.set_blocking(writing, False)
        os.dup2(writing, _STDOUT)
        os.close(writing)
        thread = threading.Thread(target=_pass_on, args=(lines,), name="zenoh's log", daemon=True)
        stack.callback(_end, thread, former)
        thread.start()
        yield


def _end(thread: threading.Thread, former: int) -> None:
    os.dup2(former, _STDOUT)  # which closes the pipe
    if thread.is_alive():
        thread.join(_END_SECONDS)


def _pass_on(lines: BinaryIO) -> None:
    left = _MOST_BYTES
    with lines:
        while line := lines.readline(_MOST_PER_LINE):
            if left <= 0:
                continue
            text = escaped(_COLOUR.sub("", line.decode("utf-8", "replace").rstrip("\n")))
            left -= len(line)
            _write(f"{MARK}{text}\n")
            if left <= 0:
                _write(f"evedrop: Zenoh has logged {_MOST_BYTES // 1024} KiB; its further lines are left out\n")


def _write(text: str) -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):  # nobody reads it
        sys.stderr.write(text)
        sys.stderr.flush()
