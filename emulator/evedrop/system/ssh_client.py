"""A process of the system's `ssh`, through which the launcher talks with a program on another host.

Source: docs/hosts.md, how it works.
"""

from __future__ import annotations

import errno
import os
import select
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from typing import IO, Protocol, final

from evedrop.system.killable import KillableProcess
from evedrop.system.parents import signalled_when_parent_dies

_MOST_SAID = 2**20


class SshClient(KillableProcess, Protocol):
    """The part of a process of ssh that the launcher uses."""

    answers: IO[bytes]
    """What comes from the host."""

    def send(self, data: bytes, seconds: float) -> bool:
        """Send bytes to the host; returns False if ssh takes none for so long. Raises OSError, and ValueError once it hung up."""

    def hang_up(self) -> None:
        """Send nothing more. Raises OSError."""

    @property
    def said(self) -> str:
        """What ssh, and the program on the host, have written to standard error."""

    def poll(self) -> int | None:
        """Its exit status; None while it runs."""

    def close(self) -> None:
        """Forget what it has said, once it has ended."""


@final
class SystemSsh:
    """A process of the system's client."""

    def __init__(self, command: Sequence[str]) -> None:
        """Start it. Raises OSError."""
        self.output_file = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the connection
        try:
            self.process = subprocess.Popen(
                _ended_with_us(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self.output_file,
                start_new_session=True,  # Ctrl-C in the terminal must reach only the launcher
            )
        except OSError:
            self.output_file.close()
            raise
        assert self.process.stdin is not None  # noqa: S101 - it was started with pipes
        assert self.process.stdout is not None  # noqa: S101
        self._orders, self.answers = self.process.stdin, self.process.stdout
        self.kill, self.poll, self.wait = self.process.kill, self.process.poll, self.process.wait

    def send(self, data: bytes, seconds: float) -> bool:
        """Send bytes to the host."""
        handle, left = self._orders.fileno(), memoryview(data)  # bytes would be copied for each part
        os.set_blocking(handle, False)
        room = select.poll()
        room.register(handle, select.POLLOUT)
        while left:
            if not room.poll(1000 * seconds):
                return False
            left = left[os.write(handle, left) :]
        return True

    def hang_up(self) -> None:
        """Send nothing more."""
        self._orders.close()

    @property
    def said(self) -> str:
        """What was written to standard error."""
        # Not by reading the file: ssh writes at the same position in it.
        return os.pread(self.output_file.fileno(), _MOST_SAID, 0).decode("utf-8", "replace")

    def close(self) -> None:
        """Close the file of what it has said."""
        self.output_file.close()


def _ended_with_us(command: Sequence[str]) -> list[str]:
    """The same command, whose process the system kills when this one dies: ssh would wait for a host that hangs, or hang itself.

    Raises FileNotFoundError if there is no such program.
    """
    program = shutil.which(command[0])
    if program is None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
    return signalled_when_parent_dies([program, *command[1:]], signal.SIGKILL)
