"""How processes are ended: asked, then killed, and never waited for without a limit; no process is started."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
from io import BytesIO
from queue import Queue
from typing import IO

import pytest

from evedrop.live.launch.starter import GRACE_SECONDS, ForkServer, ReportedProcess, end_all
from evedrop.system.fork_channels import ProcessHandle, StandardFiles
from evedrop.system.killable import KILLED_SECONDS
from evedrop.system.processes import kill, wait_for
from evedrop.system.signals import SHOW_STACKS


class Stubborn:
    """A process that ends with a certain signal, or has ended; waiting for it takes no time."""

    def __init__(self, ends_with: int = signal.SIGTERM, status: int | None = None) -> None:
        self.pid, self.stdin, self.stdout = 1, BytesIO(), None
        self._ends_with, self._status = ends_with, status
        self.signals: list[int] = []
        self.waited: list[float | None] = []

    def poll(self) -> int | None:
        """Its exit status."""
        return self._status

    def wait(self, timeout: float | None = None) -> int:
        """It ends at once or not at all."""
        self.waited.append(timeout)
        if self._status is None:
            raise subprocess.TimeoutExpired("stubborn", timeout or 0.0)
        return self._status

    def send_signal(self, sig: int) -> None:
        """It may end."""
        self.signals.append(sig)
        if sig == self._ends_with:
            self._status = -sig

    def terminate(self) -> None:
        """It may end."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """It may end."""
        self.send_signal(signal.SIGKILL)


def test_processes_are_asked_before_they_are_killed() -> None:
    """A suspended one is continued first, one that has ended is left alone, and one that stays shows its stacks; pipes close."""
    willing, stays, gone = Stubborn(), Stubborn(signal.SIGKILL), Stubborn(status=3)
    end_all([willing, stays, gone])
    assert willing.signals == [signal.SIGCONT, signal.SIGTERM]
    assert stays.signals == [signal.SIGCONT, signal.SIGTERM, SHOW_STACKS, signal.SIGKILL]
    assert gone.signals == [signal.SIGCONT]
    assert all(process.stdin.closed for process in (willing, stays, gone))


class DeadPipe(BytesIO):
    """A pipe to a process that has died, with something in its buffer."""

    def close(self) -> None:
        """Write that again, in vain."""
        super().close()
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))


def test_what_a_dead_process_was_not_told_is_no_error() -> None:
    """All others are ended, and the run's own error is shown."""
    dead, other = Stubborn(status=3), Stubborn()
    dead.stdin = DeadPipe()
    end_all([dead, other])
    assert dead.stdin.closed
    assert other.stdin.closed


def test_a_process_that_cannot_be_killed_is_waited_for_with_a_limit() -> None:
    """As on a dead disk: the grace, the time for stacks, and the time after the kill are all that it gets."""
    hangs = Stubborn(ends_with=0)
    end_all([hangs])
    limits = [seconds for seconds in hangs.waited if seconds is not None]
    assert len(limits) == len(hangs.waited) == 3
    assert all(0.0 < limit <= most for limit, most in zip(limits, (GRACE_SECONDS, 0.3, KILLED_SECONDS), strict=True))
    assert limits[0] > 1.0


def test_who_still_runs_after_a_wait_is_returned() -> None:
    """The limit is that of all processes together; killed ones are waited for, too."""
    stays, gone = Stubborn(signal.SIGKILL), Stubborn(status=0)
    assert wait_for([gone, stays], 60.0) == [stays]
    assert 0.0 < float(stays.waited[0] or 0.0) <= 60.0
    assert wait_for([stays], -1.0) == [stays]
    assert stays.waited[-1] == 0.0
    kill(stays, gone)
    assert stays.poll() == -signal.SIGKILL
    assert wait_for([stays], 1.0) == []


class Reported(ReportedProcess):
    """A process whose end the test reports."""

    def __init__(self) -> None:
        super().__init__(7)
        self.closed = 0
        self.signals: list[int] = []

    def _close(self) -> None:
        self.closed += 1

    def send_signal(self, sig: int) -> None:
        """Note it."""
        self.signals.append(sig)


def test_the_first_report_of_an_end_counts() -> None:
    """Until then it runs; a later report, as of a lost connection, changes nothing."""
    process = Reported()
    assert process.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.0)
    process.terminate()
    process.kill()
    assert process.signals == [signal.SIGTERM, signal.SIGKILL]
    process.ended(0)
    process.ended(5)
    assert process.poll() == 0
    assert process.wait() == 0
    assert process.closed == 1


class Channel:
    """A channel with a fork server that starts a process, to which the system passes on no descriptor."""

    def __init__(self) -> None:
        self._reports: Queue[bytes] = Queue()

    def files(self, log: IO[bytes], tells: bool) -> StandardFiles:
        """None."""
        raise NotImplementedError

    def send(self, request: bytes, descriptors: tuple[int, int, int]) -> None:
        """Start a process, which ends at once."""
        del request, descriptors
        self._reports.put(b'{"pid": 7}')
        self._reports.put(b'{"pid": 7, "status": 0}')

    def receive(self) -> tuple[bytes, list[ProcessHandle]]:
        """The next report, without a handle."""
        return self._reports.get(), []

    def shut(self) -> None:
        """There is no further report."""
        self._reports.put(b"")

    def close(self) -> None:
        """Nothing is open."""


def test_a_launcher_that_may_open_no_further_file_cannot_start_a_process() -> None:
    """It gets no descriptor of the process; that the process ends then is no surprise, and the server goes on."""
    server = ForkServer(Channel())
    for _ in range(2):
        with pytest.raises(OSError, match="Too many open files"):
            server.fork(["sensor"], (0, 1, 2), {}, None, 0o077)
    assert server.alive
    server.close()
