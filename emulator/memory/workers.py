"""Carries out tasks on this machine: in this process or in worker processes.

A worker process has a pipe of its own and shares no lock with other processes, so that killing one cannot hang the others.
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
from multiprocessing import connection
from multiprocessing.connection import Connection, Pipe
from typing import Any, final

from evedrop.environment import SINGLE_THREADED, own_environment
from evedrop.errors import EvedropError, RunError
from evedrop.interrupts import SIGNALS
from evedrop.lacks import lack_of
from evedrop.memory.tasks import R, Result, Stopped, Task, Tell
from evedrop.model.registry import place_of
from evedrop.processes import kill
from evedrop.scenario.dry_run import foreign

_LOOK_SECONDS = 0.1
_LAST_SECONDS = 10.0  # after a stop, for the current chunk of slots


def usable_cores() -> int:
    """The number of cores that this process may use; all of the machine's where the system cannot say, as on macOS."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_this_process(tasks: Sequence[Task[R]], tell: Tell, stopped: Stopped) -> Iterator[R]:
    """Carry out the tasks in this process, one after the other."""
    for task in tasks:
        if stopped():
            return
        try:
            result = task.carry_out(tell, stopped)
        except EvedropError:
            raise
        except Exception as error:
            # A bug of this program keeps its traceback; an error in a class of the user's own names the class.
            if isinstance(error, OSError) or lack_of(error) is not None or not foreign(task.scenario):
                raise
            raise RunError(
                f"one of the trials {task.start} to {task.stop - 1} failed: {place_of(error)}; run `evedrop check` on the "
                "class it is in"
            ) from error
        yield result


def in_processes(tasks: Sequence[Task[R]], workers: int, tell: Tell, stopped: Stopped) -> Iterator[tuple[int, R]]:
    """Carry out the tasks in worker processes; yields the number of a task and its result as they come.

    After a stop, the partial results of the current tasks come last. Raises RunError if a process dies.
    """
    crew = [_Worker() for _ in range(workers)]
    try:
        yield from _results(tasks, crew, tell, stopped)
    finally:
        for worker in crew:
            worker.end()


@final
class _Worker:
    """A worker process, and this process's end of its pipe."""

    def __init__(self) -> None:
        self.pipe, theirs = Pipe()
        self.number: int | None = None
        """Number of the current task."""
        # A session of its own, so that a Ctrl-C in the terminal does not reach it. And not a multiprocessing.Process, which
        # would run the caller's script a second time.
        command = f"from evedrop.memory.workers import work; work({theirs.fileno()})"
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

    def send_task(self, number: int, task: Task[Any]) -> None:
        self.number = number
        with contextlib.suppress(OSError):  # the worker died; the next read of its pipe reports it
            self.pipe.send(task)

    def stop(self) -> None:
        """Ask for the results so far of the current task."""
        self.process.terminate()

    def end(self) -> None:
        kill(self.process)
        self.pipe.close()


def _results(tasks: Sequence[Task[R]], crew: list[_Worker], tell: Tell, stopped: Stopped) -> Iterator[tuple[int, R]]:
    waiting = iter(enumerate(tasks))
    for worker, (number, task) in zip(crew, waiting, strict=False):
        worker.send_task(number, task)
    deadline: float | None = None
    while busy := {worker.pipe: worker for worker in crew if worker.number is not None}:
        if deadline is None and stopped():
            deadline = time.monotonic() + _LAST_SECONDS
            for worker in busy.values():
                worker.stop()
        if deadline is not None and time.monotonic() > deadline:
            return
        for pipe in connection.wait(list(busy), _LOOK_SECONDS):
            worker = busy[pipe]  # type: ignore[index]  # `wait` takes other kinds of objects, but these are pipes
            news = _received(worker)
            if isinstance(news, int):
                tell(news)
                continue
            if isinstance(news, str):
                raise RunError(f"a worker failed: {news}")
            if worker.number is not None:
                yield worker.number, news
            worker.number = None
            if deadline is None and (following := next(waiting, None)) is not None:
                worker.send_task(*following)


def _received(worker: _Worker) -> Any:
    """A count of trial-slots done, the reason for a failure, or the result of a task."""
    try:
        news = worker.pipe.recv()
    except (EOFError, OSError) as error:
        with contextlib.suppress(subprocess.TimeoutExpired):
            worker.process.wait(_LAST_SECONDS)
        code = worker.process.returncode
        how = f"was ended by signal {-code}" if code is not None and code < 0 else f"ended with status {code}"
        raise RunError(f"a worker process {how}; was it killed, or out of memory? try fewer workers") from error
    return news


def work(descriptor: int) -> None:
    """Run a worker: carry out tasks from its pipe until it is ended, or the starting process is gone."""
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


def _outcome(task: Task[Result], tell: Tell, stopped: Stopped) -> Result | str:
    try:
        return task.carry_out(tell, stopped)
    except OSError:
        raise
    except EvedropError as error:
        return str(error)
    except Exception as error:
        if (lack := lack_of(error)) is not None:
            return lack
        return f"trials {task.start} to {task.stop - 1}: {place_of(error)}"
