"""Simulated processes for a program that starts them as those of the machine.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from functools import partial
from types import TracebackType
from typing import IO, Self, cast, final

from evedrop.virtual.pipes import Pipe, PipeFile
from evedrop.virtual.processes import VirtualMachine, VirtualProcess


@final
class ChildProcess:
    """A simulated process of Evedrop, used as a `subprocess.Popen` whose standard output is closed."""

    def __init__(self, machine: VirtualMachine, name: str, *words: str) -> None:
        """words: the command."""
        pipe = Pipe(machine.scheduler)
        self.stderr: IO[str] | None = cast("IO[str]", _Lines(PipeFile(pipe)))
        self.process = VirtualProcess(machine.scheduler, machine.scheduler.process(name), pipe.end())
        machine.begin(name, partial(machine.program, words), self.process)

    @property
    def returncode(self) -> int | None:
        """Its exit status; None while it runs."""
        return self.process.task.status

    def poll(self) -> int | None:
        """Its exit status; None while it runs."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end. Raises subprocess.TimeoutExpired."""
        status = self.process.wait(timeout)
        if status is None:
            raise subprocess.TimeoutExpired("evedrop", timeout or 0.0)
        return status

    def send_signal(self, sig: int) -> None:
        """Send a signal to it."""
        self.process.signal(sig)

    def kill(self) -> None:
        """End it."""
        self.send_signal(signal.SIGKILL)


@final
class _Lines:
    """The reader's end of a pipe, for lines of text."""

    def __init__(self, pipe: PipeFile) -> None:
        self._pipe = pipe

    def __iter__(self) -> Iterator[str]:
        return (line.decode() for line in self._pipe)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pipe.close()
