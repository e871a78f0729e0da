"""Simulated processes: what a program knows of its own, and what a launcher knows of those that it has started.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import IO, BinaryIO, NoReturn, cast, final

from evedrop.live.launch.starter import TELLING, StartedProcess, Starter
from evedrop.system.signals import INTERRUPTED
from evedrop.system.this_process import ThisProcess
from evedrop.system.threads import ThreadEvent
from evedrop.virtual.pipes import Pipe, PipeFile
from evedrop.virtual.scheduler import Ended, VirtualEvent, VirtualScheduler, VirtualTask, Waiter

Program = Callable[[Sequence[str]], int]
"""Runs a command line, and returns its exit status."""
_START_SECONDS = 0.05
"""The mean time until a process that is started begins its work."""
_REMOVED_SECONDS = 0.01


@final
class VirtualProcess(ThisProcess):
    """A simulated process, as its own program sees it."""

    def __init__(
        self,
        scheduler: VirtualScheduler,
        task: VirtualTask,
        log: BinaryIO | None = None,
        stdin: Pipe | None = None,
        stdout: Pipe | None = None,
    ) -> None:
        """log: where its messages go. stdin, stdout: pipes from and to its launcher, if it has one."""
        self.task, self._scheduler = task, scheduler
        self._log, self._stdin, self._stdout = log, stdin, stdout
        self._handle: Callable[[], object] = lambda: self.exit(INTERRUPTED)
        self.printed = ""
        """What it has written to standard output and standard error, if it has no log."""
        task.held.append(self._release)
        self.ended: deque[Waiter] = deque()
        """Who waits for its end."""

    def _release(self) -> None:
        for pipe in (self._stdin, self._stdout):
            if pipe is not None:
                pipe.close_reading()
                pipe.close_writing()
        if self._log is not None:
            self._log.close()
        self._scheduler.wake(self.ended)

    def print(self, text: str) -> None:
        """Write text to its standard output or standard error."""
        if self._log is None:
            self.printed += text
        else:
            self._log.write(text.encode())
            self._log.flush()

    def signal(self, number: int) -> None:
        """Get a signal."""
        scheduler, task = self._scheduler, self.task
        if not task.alive:
            return
        scheduler.note("signal", task.name, number)
        if number == signal.SIGKILL:
            scheduler.end(task, -number)
        elif number == signal.SIGSTOP:
            scheduler.stop(task)
        elif number == signal.SIGCONT:
            scheduler.go_on(task)
        elif number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            scheduler.thread("signal", self._handle, task).start()

    @property
    def pid(self) -> int:
        """Its id."""
        return self.task.number

    def exit(self, status: int) -> NoReturn:
        """End it at once."""
        self._scheduler.end(self.task, status)
        raise Ended

    def interrupt(self) -> None:
        """Send it SIGTERM."""
        self.signal(signal.SIGTERM)

    def on_signals(self, handle: Callable[[], object]) -> None:
        """Call this at the signals that interrupt a command."""
        self._handle = handle

    def leave_on_signals(self) -> None:
        """Let these signals end it at once."""
        self._handle = lambda: self.exit(INTERRUPTED)

    @contextmanager
    def stop_on_signals(self) -> Iterator[ThreadEvent]:
        """An event that these signals set."""
        stop, before = VirtualEvent(self._scheduler), self._handle
        self._handle = stop.set
        try:
            yield stop
        finally:
            self._handle = before

    def told_when_suspended(self, tell: Callable[[], object]) -> AbstractContextManager[None]:
        """Nobody types Ctrl-Z."""
        del tell
        return nullcontext()

    @contextmanager
    def removed_with_it(self, folder: Path) -> Iterator[None]:
        """Have a folder removed a moment after its death."""

        def remove() -> None:
            self._scheduler.at(
                self._scheduler.now + _REMOVED_SECONDS, lambda: shutil.rmtree(folder, ignore_errors=True)
            )

        self.task.held.append(remove)
        try:
            yield
        finally:
            if self.task.alive:
                self.task.held.remove(remove)

    def prepare_for_messages(self, largest: int) -> None:
        """Its memory is the interpreter's."""

    def show_stacks(self) -> None:
        """Nobody asks for them."""

    def continue_when_parent_dies(self) -> None:
        """Let it go on when its launcher dies; `VirtualMachine` does so for all."""

    def native_log_apart(self) -> AbstractContextManager[None]:
        """The simulated Zenoh writes no log."""
        return nullcontext()

    def read_input(self, most: int) -> bytes:
        """Wait for what comes on standard input."""
        return b"" if self._stdin is None else self._stdin.read(most)

    def input_closed(self) -> bool:
        """Whether nothing more can come there."""
        return self._stdin is not None and self._stdin.over

    def keep_events_apart(self, launched: bool) -> None:
        """Events and messages are apart already."""

    def send_event(self, line: bytes) -> None:
        """Write a line to the launcher."""
        if self._stdout is None:
            self.print(line.decode())
        else:
            self._stdout.write(line)


@final
class VirtualStarted(StartedProcess):
    """A simulated process, as its launcher sees it."""

    def __init__(self, scheduler: VirtualScheduler, process: VirtualProcess, stdin: Pipe, stdout: Pipe | None) -> None:
        self._scheduler, self.process = scheduler, process
        self._stdin, self._stdout = PipeFile(stdin), None if stdout is None else PipeFile(stdout)

    @property
    def pid(self) -> int:
        """Its process id."""
        return self.process.pid

    @property
    def stdin(self) -> IO[bytes] | None:
        """The launcher's end of the pipe to its standard input."""
        return cast("IO[bytes]", self._stdin)

    @property
    def stdout(self) -> IO[bytes] | None:
        """The events that it sends."""
        return cast("IO[bytes] | None", self._stdout)

    def poll(self) -> int | None:
        """Its exit status."""
        return self.process.task.status

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end."""
        deadline = None if timeout is None else self._scheduler.now + timeout
        while (status := self.poll()) is None:
            left = None if deadline is None else deadline - self._scheduler.now
            if left is not None and left <= 0.0:
                raise subprocess.TimeoutExpired("evedrop", timeout or 0.0)
            self._scheduler.wait(self.process.ended, left)
        return status

    def send_signal(self, sig: int) -> None:
        """Send a signal to it."""
        self.process.signal(sig)

    def terminate(self) -> None:
        """Ask it to end."""
        self.process.signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it."""
        self.process.signal(signal.SIGKILL)


@final
class VirtualMachine:
    """A machine whose processes are simulated."""

    def __init__(self, scheduler: VirtualScheduler, program: Program) -> None:
        """program: what `evedrop` is on this machine."""
        self._scheduler, self._program = scheduler, program
        self._of: dict[VirtualTask, VirtualProcess] = {}

    @property
    def current(self) -> VirtualProcess:
        """The process of the current thread."""
        thread = self._scheduler.current
        if thread is None:
            raise AssertionError("the world itself is no process")
        return self._of[thread.task]

    @property
    def processes(self) -> list[VirtualProcess]:
        """All processes, also those that have ended."""
        return list(self._of.values())

    def begin(self, name: str, work: Callable[[], int], process: VirtualProcess | None = None) -> VirtualProcess:
        """Start a process that does this work, whose result is its exit status."""
        scheduler = self._scheduler
        if process is None:
            process = VirtualProcess(scheduler, scheduler.process(name))
        self._of[process.task] = process
        scheduler.note("starts", name)

        def run() -> None:
            try:
                status = work()
            except Ended:
                raise
            except BaseException as error:
                process.print(traceback.format_exc())
                scheduler.failed(name, error)
                status = 1
            process.exit(status)

        scheduler.thread("main", run, process.task).start()
        return process

    @contextmanager
    def starter(self, stop: ThreadEvent | None = None) -> Iterator[Starter]:
        """Starts processes, each of which continues and reads the end of its input when the current process dies."""
        del stop
        yield self._start

    def _start(self, role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
        del environment
        scheduler, parent = self._scheduler, self.current
        stdin, stdout = Pipe(scheduler), Pipe(scheduler) if role in TELLING else None
        task = scheduler.process(brief.stem)
        own = os.fdopen(os.dup(log.fileno()), "ab", buffering=0)
        process = VirtualProcess(scheduler, task, cast(BinaryIO, own), stdin, stdout)
        started = VirtualStarted(scheduler, process, stdin, stdout)

        def parent_dies() -> None:
            stdin.close_writing()
            if stdout is not None:
                stdout.close_reading()
            scheduler.go_on(task)

        parent.task.held.append(parent_dies)

        def work() -> int:
            scheduler.sleep(scheduler.random.expovariate(1.0 / _START_SECONDS))
            return self._program([role, str(brief)])

        self.begin(brief.stem, work, process)
        return started


@final
class ProcessOutput:
    """Standard output or standard error of the interpreter: what a simulated process writes goes to its log."""

    encoding = "utf-8"
    errors = "strict"

    def __init__(self, machine: VirtualMachine, outside: IO[str]) -> None:
        """outside: for what is written between the turns of processes."""
        self._machine, self._outside, self._scheduler = machine, outside, machine._scheduler

    def write(self, text: str) -> int:
        """Write text."""
        if self._scheduler.current is None:
            return self._outside.write(text)
        with suppress(OSError, ValueError):
            self._machine.current.print(text)
        return len(text)

    def flush(self) -> None:
        """Everything is written already."""

    def isatty(self) -> bool:
        """It is no terminal."""
        return False
