"""Simulated processes: what a program knows of its own, and what a launcher knows of those that it has started.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from queue import Empty
from types import TracebackType
from typing import IO, BinaryIO, NoReturn, Self, cast, final

from evedrop.system.fork_channels import ProcessHandle, StandardFiles
from evedrop.system.signals import AGAIN_SECONDS, INTERRUPTED
from evedrop.system.this_process import ThisProcess
from evedrop.system.threads import ThreadEvent
from evedrop.virtual import notes
from evedrop.virtual.pipes import Pipe, PipeFile, WritingEnd
from evedrop.virtual.scheduler import Ended, VirtualEvent, VirtualQueue, VirtualScheduler, VirtualTask, Waiter

Program = Callable[[Sequence[str]], int]
"""Runs a command line, and returns its exit status."""
_START_SECONDS = 0.05
"""The mean time until a process that is started begins its work."""
_REMOVED_SECONDS = 0.01
_POLL_SECONDS = 0.25
LAUNCHER = "launcher"
FORK_SERVERS = ("fork server", "fork server of the recorder")
"""The processes that start others."""


@final
class VirtualProcess(ThisProcess):
    """A simulated process, as its own program sees it."""

    def __init__(
        self,
        scheduler: VirtualScheduler,
        task: VirtualTask,
        log: BinaryIO | WritingEnd | None = None,
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
        scheduler.note(notes.SIGNAL, task.name, number)
        if number == signal.SIGKILL:
            scheduler.end(task, -number)
        elif number == signal.SIGSTOP:
            scheduler.stop(task)
        elif number == signal.SIGCONT:
            scheduler.go_on(task)
        elif number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            scheduler.thread("signal", self._handle, task).start()

    def wait(self, timeout: float | None = None) -> int | None:
        """Wait for its end, for some seconds at most; returns its exit status, None while it runs."""
        self._scheduler.wait_for(lambda: not self.task.alive, partial(self._scheduler.wait, self.ended), timeout)
        return self.task.status

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
        stop = VirtualEvent(self._scheduler)
        with self._handling(stop.set):
            yield stop

    @contextmanager
    def stop_or_leave_on_signals(self, leave: Callable[[], object]) -> Iterator[ThreadEvent]:
        """An event that the first of these signals sets; a later one, unless it comes at once, calls `leave`."""
        stop, first = VirtualEvent(self._scheduler), 0.0

        def handle() -> None:
            nonlocal first
            if not stop.is_set():
                first = self._scheduler.now
                stop.set()
            elif self._scheduler.now - first > AGAIN_SECONDS:
                leave()

        with self._handling(handle):
            yield stop

    @contextmanager
    def raise_on_signals(self) -> Iterator[None]:
        """Let the first of these signals raise KeyboardInterrupt on the thread of the block."""
        thread = self._scheduler.current
        assert thread is not None  # noqa: S101 - only programs call this

        def interrupt() -> None:
            self._handle = lambda: None
            self._scheduler.raise_in(thread, KeyboardInterrupt())

        with self._handling(interrupt):
            yield

    @contextmanager
    def _handling(self, handle: Callable[[], object]) -> Iterator[None]:
        before, self._handle = self._handle, handle
        try:
            yield
        finally:
            self._handle = before

    def on_thread_failure(self, handle: Callable[[BaseException], object]) -> None:
        """Call this when an error ends a thread."""
        self.task.on_failure = handle

    def told_when_suspended(self, tell: Callable[[], object]) -> AbstractContextManager[None]:
        """Nobody types Ctrl-Z."""
        del tell
        return nullcontext()

    @contextmanager
    def removed_with_it(self, folder: Path) -> Iterator[None]:
        """Have a folder removed a moment after its death, and what is left of it after the block."""

        def remove() -> None:
            self._scheduler.after_seconds(_REMOVED_SECONDS, lambda: shutil.rmtree(folder, ignore_errors=True))

        self.task.held.append(remove)
        try:
            yield
        finally:
            if self.task.alive:
                self.task.held.remove(remove)
                shutil.rmtree(folder, ignore_errors=True)

    def switch_threads_soon(self) -> None:
        """Its threads take turns by the seed."""

    def prepare_for_messages(self, largest: int) -> None:
        """Its memory is the interpreter's."""

    def keep_modules(self) -> None:
        """They are those of the interpreter, and so would all worlds be kept."""

    def keep_files_private(self) -> None:
        """The files of all simulated processes are private."""

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
class _Handle:
    """Refers to a simulated process."""

    def __init__(self, process: VirtualProcess) -> None:
        self._process = process

    @property
    def over(self) -> bool:
        """Whether it has ended."""
        return not self._process.task.alive

    def send_signal(self, sig: int) -> None:
        """Send a signal to it."""
        self._process.signal(sig)

    def close(self) -> None:
        """Nothing is to be closed."""


@final
class _Files:
    """A pipe to a simulated process, its log, and perhaps a pipe from it."""

    def __init__(self, scheduler: VirtualScheduler, log: IO[bytes], tells: bool, number: int) -> None:
        self.log = log.again() if isinstance(log, WritingEnd) else os.fdopen(os.dup(log.fileno()), "ab", buffering=0)
        self.to, self.back = Pipe(scheduler), Pipe(scheduler) if tells else None
        self.stdin = cast("IO[bytes]", PipeFile(self.to))
        self.stdout = None if self.back is None else cast("IO[bytes]", PipeFile(self.back))
        self.descriptors = (number, number, number)

    def close_theirs(self) -> None:
        """The process has them."""


@final
class VirtualForkServer:
    """A simulated process that starts others, and the launcher's end of the channel with it.

    It can be suspended and killed as any other: then it starts nothing, and reports no end.
    """

    def __init__(self, machine: VirtualMachine, name: str) -> None:
        self._machine, self._scheduler = machine, machine.scheduler
        self._requests, self._reports = VirtualQueue(self._scheduler), VirtualQueue(self._scheduler)
        self._files: dict[int, _Files] = {}
        self._launcher = machine.current
        self.process = VirtualProcess(self._scheduler, self._scheduler.process(name))
        self.process.task.held.append(lambda: self._reports.put((b"", [])))
        self._launcher.task.held.append(self.shut)  # before it starts, because its launcher may end meanwhile
        machine.begin(name, self._serve, self.process)

    def files(self, log: IO[bytes], tells: bool) -> StandardFiles:
        """Simulated pipes."""
        files = _Files(self._scheduler, log, tells, self._scheduler.number())
        self._files[files.descriptors[0]] = files
        self._machine.logs.append(files.log)
        return files

    def send(self, request: bytes, descriptors: tuple[int, int, int]) -> None:
        """Send a request."""
        if not self.process.task.alive:
            raise BrokenPipeError(32, "Broken pipe")
        self._requests.put((json.loads(request)["words"], self._files[descriptors[0]]))

    def receive(self) -> tuple[bytes, list[ProcessHandle]]:
        """The next report."""
        try:
            report: tuple[bytes, list[ProcessHandle]] = self._reports.get(timeout=_POLL_SECONDS)
        except Empty:
            raise TimeoutError from None
        return report

    def shut(self) -> None:
        """Let the server end, once it goes on."""
        self._reports.put((b"", []))
        self._requests.put(None)
        self.process.signal(signal.SIGCONT) if not self._launcher.task.alive else None

    def close(self) -> None:
        """Nothing is to be closed."""

    def _serve(self) -> int:
        self._scheduler.sleep(self._scheduler.random.expovariate(1.0 / _START_SECONDS))
        while (request := self._requests.get()) is not None:
            self._start(*request)
        return 0

    def _start(self, words: Sequence[str], files: _Files) -> None:
        scheduler, launcher = self._scheduler, self._launcher
        if self._machine.lacks_threads:
            self._reports.put((json.dumps({"error": errno.EAGAIN}).encode(), []))
            return
        name = Path(words[1]).stem
        process = VirtualProcess(scheduler, scheduler.process(name), files.log, files.to, files.back)

        def launcher_dies() -> None:
            files.to.close_writing()
            if files.back is not None:
                files.back.close_reading()
            scheduler.go_on(process.task)

        launcher.task.held.append(launcher_dies)
        if not launcher.task.alive:
            launcher_dies()

        def work() -> int:
            scheduler.sleep(scheduler.random.expovariate(1.0 / _START_SECONDS))
            return self._machine.program(words)

        self._machine.begin(name, work, process)
        self._reports.put((json.dumps({"pid": process.pid}).encode(), [_Handle(process)]))
        scheduler.thread("waits", lambda: self._report(process)).start()

    def _report(self, process: VirtualProcess) -> None:
        self._reports.put((json.dumps({"pid": process.pid, "status": process.wait()}).encode(), []))


@final
class VirtualMachine:
    """A machine whose processes are simulated."""

    def __init__(self, scheduler: VirtualScheduler, program: Program) -> None:
        """program: what `evedrop` is on this machine."""
        self.scheduler, self.program = scheduler, program
        self._of: dict[VirtualTask, VirtualProcess] = {}
        self.logs: list[BinaryIO | WritingEnd] = []
        """All logs, also of processes that never began."""
        self.no_threads_until = 0.0
        """Until when no thread and no process can be started."""

    @property
    def lacks_threads(self) -> bool:
        """Whether no thread and no process of the launcher's machine can be started now."""
        thread = self.scheduler.current
        return self.scheduler.now < self.no_threads_until and (thread is None or not thread.task.host)

    def admit_thread(self) -> None:
        """The current process starts a thread. Raises RuntimeError if it cannot, in the words of Python, or MemoryError."""
        if self.scheduler.current is not None:
            self.scheduler.current.task.allocate()
        if self.lacks_threads:
            raise RuntimeError("can't start new thread")

    @property
    def current(self) -> VirtualProcess:
        """The process of the current thread."""
        thread = self.scheduler.current
        if thread is None:
            raise AssertionError("the world itself is no process")
        return self._of[thread.task]

    def close(self) -> None:
        """Close the logs of processes that have not ended."""
        for log in self.logs:
            log.close()

    @property
    def processes(self) -> list[VirtualProcess]:
        """All processes, also those that have ended."""
        return list(self._of.values())

    def adopt(self, process: VirtualProcess) -> None:
        """Take a process that the machine did not start for one of its own."""
        self._of[process.task] = process
        self.scheduler.note(notes.STARTS, process.task.name)

    def begin(self, name: str, work: Callable[[], int], process: VirtualProcess | None = None) -> VirtualProcess:
        """Start a process that does this work, whose result is its exit status."""
        scheduler = self.scheduler
        if process is None:
            process = VirtualProcess(scheduler, scheduler.process(name))
        self._of[process.task] = process
        scheduler.note(notes.STARTS, name)

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


@final
class ProcessOutput:
    """Standard output or standard error of the interpreter: what a simulated process writes goes to its log."""

    encoding = "utf-8"
    errors = "strict"

    def __init__(self, machine: VirtualMachine, outside: IO[str]) -> None:
        """outside: for what is written between the turns of processes."""
        self._machine, self._outside, self._scheduler = machine, outside, machine.scheduler

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
    def pid(self) -> int:
        """Its id."""
        return self.process.pid

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
