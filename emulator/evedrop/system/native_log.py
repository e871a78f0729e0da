"""Zenoh's log of a process that others connect to: no line steers a terminal, and strangers can fill neither it nor a disk.

Zenoh writes its log to file descriptor 1, from threads of its own, and some of its lines are about bytes that anybody may send.
So descriptor 1 becomes a file in memory, whose lines a thread passes on to standard error until there are too many. Python's
standard output keeps the former file.

It is no pipe: a thread of Zenoh that waited for us might hold a lock that a Python thread waits for, and a pipe that is full and
does not block makes Zenoh write the whole line to standard error itself, neither marked nor escaped nor counted.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
import tempfile
import threading
from collections.abc import Iterator

from evedrop.system.output import Output, escaped

MARK = "zenoh: "
"""What each line of it begins with where it is passed on."""
_MOST_BYTES = 2**17
_MOST_PER_LINE = 2**12
_END_SECONDS = 1.0
_POLL_SECONDS = 0.1
_STDOUT = 1
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


@contextlib.contextmanager
def native_log_apart() -> Iterator[None]:
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
        log = _new_file()
        os.dup2(log, _STDOUT)
        forwarder = _LogForwarder(log, former)
        stack.callback(forwarder.end)
        forwarder.start()
        yield


class _LogForwarder(threading.Thread):
    """Passes the lines of the file `log` on; it closes the file when it ends.

    `former` is where descriptor 1 leads when the block is over. From the last line that is passed on until then it leads nowhere.
    """

    def __init__(self, log: int, former: int) -> None:
        super().__init__(name="zenoh's log", daemon=True)
        self._log, self._former = log, former
        self._left = _MOST_BYTES
        self._over = threading.Event()
        self._turning = threading.Lock()

    def end(self) -> None:
        """Give descriptor 1 back, and pass the last lines on."""
        with self._turning:
            os.dup2(self._former, _STDOUT)
            self._over.set()
        if self.is_alive():
            self.join(_END_SECONDS)

    def run(self) -> None:
        """Until the block is over, or until there were too many lines."""
        read, rest, over = 0, b"", False
        while self._left > 0 and not over:
            over = self._over.wait(_POLL_SECONDS)
            while self._left > 0 and (more := os.pread(self._log, _MOST_PER_LINE, read)):
                read += len(more)
                *lines, rest = (rest + more).split(b"\n")
                if len(rest) >= _MOST_PER_LINE:
                    lines, rest = [*lines, rest], b""
                self._pass_on(lines)
        if rest:
            self._pass_on([rest])
        with self._turning:
            if not self._over.is_set():
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, _STDOUT)
                os.close(nowhere)
        os.close(self._log)

    def _pass_on(self, lines: list[bytes]) -> None:
        for line in lines:
            if self._left <= 0:
                return
            text = escaped(_COLOUR.sub("", line.decode("utf-8", "replace")))
            self._left -= len(line) + 1
            _write(f"{MARK}{text}\n")
            if self._left <= 0:
                _write(f"evedrop: Zenoh has logged {_MOST_BYTES // 1024} KiB; its further lines are left out\n")


def _new_file() -> int:
    """A file without a name; in memory, where the system has such files."""
    if sys.platform == "linux":
        return os.memfd_create("zenoh's log")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _write(text: str) -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):  # nobody reads it
        sys.stderr.write(text)
        sys.stderr.flush()
