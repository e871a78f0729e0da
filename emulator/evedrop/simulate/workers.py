"""Carries out tasks on this machine: in this process or in worker processes.

A worker process has a pipe of its own and shares no lock with other processes, so that killing one cannot hang the others. A
thread of its own writes to that pipe and reads from it: a worker that is suspended, or hangs, may leave half a message there.

`concurrent.futures.ProcessPoolExecutor` was tried in their place: when one worker is killed it fails all tasks, those of other
workers too, and names no cause; it waits for a suspended worker without end; and a task cannot return what it has when it is
told to stop.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, Pipe
from queue import Empty, SimpleQueue
from typing import Any, final

from evedrop.errors import EvedropError, RunError
from evedrop.model.registry import CLASS_ERRORS, place_of
from evedrop.scenario.dry_run import foreign
from evedrop.simulate.tasks import OnProgress, R, Result, Stopped, Task
from evedrop.system.environment import SINGLE_THREADED, own_environment
from evedrop.system.killable import KILLED_SECONDS
from evedrop.system.lacks import lack_of
from evedrop.system.parents import continue_when_parent_dies
from evedrop.system.processes import SUSPENDED_SECONDS, SuspensionWatch, kill
from evedrop.system.signals import SIGNALS

_POLL_SECONDS = 0.1
_LAST_SECONDS = 30.0  # after a stop, for the current chunk of slots; only a worker that hangs needs them all


def usable_cores() -> int:
    """The number of cores that this process may use; all of the machine's where the system cannot say, as on macOS."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_this_process(tasks: Sequence[Task[R]], on_progress: OnProgress, stopped: Stopped) -> Iterator[R]:
    """Carry out the tasks in this process, one after the other."""
    for task in tasks:
        if stopped():
            return
        try:
            result = task.carry_out(on_progress, stopped)
        except EvedropError:
            raise
        except CLASS_ERRORS as error:
            # A bug of this program keeps its traceback; an error in a class of the user's own names the class.
            if isinstance(error, OSError) or lack_of(error) is not None or not foreign(task.scenario):
                raise
            raise RunError(
                f"one of the trials {task.start} to {task.stop - 1} failed: {place_of(error)}; run `evedrop check` on the "
                "class it is in"
            ) from error
        yield result


def in_processes(
    tasks: Sequence[Task[R]], workers: int, on_progress: OnProgress, stopped: Stopped
) -> Iterator[tuple[int, R]]:
    """Carry out the tasks in worker processes; yields the number of a task and its result as they come.

    After a stop, the partial results of the current tasks come last, as far as they come within `_LAST_SECONDS`. Raises RunError
    if a process dies, or is suspended for good.
    """
    crew = list[_Worker]()
    messages: _Messages = SimpleQueue()
    try:
        for _ in range(workers):
            crew.append(_Worker(messages))
        yield from _results(tasks, crew, messages, on_progress, stopped)
    finally:
        kill(*(worker.process for worker in crew))
        for worker in crew:
            worker.leave()


@final
class _Worker:
    """A worker process, and the thread that talks with it."""

    def __init__(self, messages: _Messages) -> None:
        """messages: gets counts of trial-slots done, reasons for failures, results, and the error that ends the worker."""
        self._messages = messages
        self._tasks: SimpleQueue[Task[Any] | None] = SimpleQueue()
        self.pipe, theirs = Pipe()
        self.number: int | None = None
        """Number of the current task."""
        self.task: Task[Any] | None = None
        # A session of its own, so that a Ctrl-C in the terminal does not reach it. And not a multiprocessing.Process, which
        # would run the caller's script a second time.
        command = f"from evedrop.simulate.workers import work; work({theirs.fileno()})"
        # Signals are blocked until the worker can handle them: it inherits the mask.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-c", command],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                env={**own_environment(), **SINGLE_THREADED},
            )
        except OSError as error:
            self.pipe.close()
            raise RunError(f"no worker process can be started ({error}); try fewer workers") from error
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()
        self._thread = threading.Thread(target=self._talk, name="worker", daemon=True)
        try:
            self._thread.start()
        except RuntimeError:  # no thread can be started
            kill(self.process)
            self.pipe.close()
            raise

    def send_task(self, number: int, task: Task[Any]) -> None:
        self.number, self.task = number, task
        self._tasks.put(task)

    def _talk(self) -> None:
        """Send tasks and receive what the worker says, until it has ended. Without a limit: nobody waits for this thread."""
        try:
            with self.pipe:
                while (task := self._tasks.get()) is not None:
                    self.pipe.send(task)
                    while isinstance(message := self.pipe.recv(), int):
                        self._messages.put((self, message))
                    self._messages.put((self, message))
        except Exception as error:
            self._messages.put((self, error))

    def stop(self) -> None:
        """Ask for the results so far of the current task, also from a suspended worker."""
        self.process.send_signal(signal.SIGCONT)
        self.process.terminate()

    def leave(self) -> None:
        """End the thread, whose worker was killed."""
        self._tasks.put(None)
        self._thread.join(KILLED_SECONDS)

    @property
    def lost(self) -> RunError:
        """How the worker ended, whose pipe is closed."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(KILLED_SECONDS)
        code = self.process.returncode
        how = f"was ended by signal {-code}" if code is not None and code < 0 else f"ended with status {code}"
        return RunError(f"a worker process {how}; was it killed, or out of memory? try fewer workers")


_Messages = SimpleQueue[tuple[_Worker, Any]]


def _results(
    tasks: Sequence[Task[R]], crew: list[_Worker], messages: _Messages, on_progress: OnProgress, stopped: Stopped
) -> Iterator[tuple[int, R]]:
    waiting = iter(enumerate(tasks))
    for worker, (number, task) in zip(crew, waiting, strict=False):
        worker.send_task(number, task)
    deadline: float | None = None
    watch = SuspensionWatch()
    while busy := {worker.process.pid: worker for worker in crew if worker.number is not None}:
        if deadline is None and stopped():
            deadline = time.monotonic() + _LAST_SECONDS
            for worker in busy.values():
                worker.stop()
        if deadline is not None and time.monotonic() > deadline:
            return
        if (pid := watch.suspended_for_good(busy)) is not None:
            raise _suspended(busy[pid])
        try:
            worker, message = messages.get(timeout=_POLL_SECONDS)
        except Empty:
            continue
        message = _unfailed(worker, message)
        if isinstance(message, int):
            on_progress(message)
            continue
        if worker.number is not None:
            yield worker.number, message
        worker.number = None
        if deadline is None and (following := next(waiting, None)) is not None:
            worker.send_task(*following)


def _unfailed(worker: _Worker, message: Any) -> Any:
    """What a worker says: a count or a result. Raises RunError if it failed or ended."""
    if isinstance(message, str):
        raise RunError(f"a worker failed: {message}")
    if isinstance(message, EOFError | OSError):
        raise worker.lost from message
    if isinstance(message, Exception):
        raise message
    return message


def _suspended(worker: _Worker) -> RunError:
    task = worker.task
    trials = "" if task is None else f", which computes trials {task.start} to {task.stop - 1},"
    return RunError(
        f"worker process {worker.process.pid}{trials} has been suspended for {SUSPENDED_SECONDS:g} s; find out what suspends "
        "it (SIGSTOP), and run again"
    )


def work(descriptor: int) -> None:
    """Run a worker: carry out tasks from its pipe until it is ended, or the starting process is gone."""
    continue_when_parent_dies()
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    for number in (
        signal.SIGINT,
        signal.SIGHUP,
    ):  # these reach the starting process, too, which tells the workers to stop
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    # Without memory for a message it ends, which the starting process reports.
    with contextlib.suppress(EOFError, OSError, MemoryError), Connection(descriptor) as pipe:
        while True:
            pipe.send(_outcome(pipe.recv(), pipe.send, stop.is_set))


def _outcome(task: Task[Result], on_progress: OnProgress, stopped: Stopped) -> Result | str:
    try:
        return task.carry_out(on_progress, stopped)
    except OSError:
        raise
    except EvedropError as error:
        return str(error)
    except CLASS_ERRORS as error:
        if (lack := lack_of(error)) is not None:
            return lack
        return f"trials {task.start} to {task.stop - 1}: {place_of(error)}"
