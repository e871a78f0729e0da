"""Carries tasks out: here, in worker processes on this machine, or on a Dask cluster. Results come in task order."""

from __future__ import annotations

import contextlib
import multiprocessing as mp
import signal
import time
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from multiprocessing.queues import Queue
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from queue import Empty
from typing import Any

from emulator.errors import RunError, UsageError
from emulator.runs.trials import BatchResult, Task, carry_out

_LOOK_SECONDS = 0.1

Tell = Callable[[int], None]
Stopped = Callable[[], bool]


def in_this_process(tasks: list[Task], tell: Tell, stopped: Stopped) -> Iterator[BatchResult]:
    """One after the other, here."""
    for task in tasks:
        if stopped():
            return
        yield carry_out(task, tell, stopped)


def in_processes(tasks: list[Task], workers: int, tell: Tell, stopped: Stopped) -> Iterator[BatchResult]:
    """By worker processes of our own. Raises RunError if one dies."""
    context = mp.get_context("spawn")
    waiting: Queue[tuple[int, Task] | None] = context.Queue()
    results: Queue[tuple[int, BatchResult | str]] = context.Queue()
    done: Synchronized[int] = context.Value("q", 0)
    stop = context.Event()
    for entry in [*enumerate(tasks), *[None] * workers]:
        waiting.put(entry)
    processes = [
        context.Process(target=_work, args=(waiting, results, done, stop), daemon=True) for _ in range(workers)
    ]
    for process in processes:
        process.start()
    try:
        yield from _in_order(_results(len(tasks), results, processes, _Progress(done, tell), stop, stopped))
    finally:
        stop.set()
        for process in processes:
            process.terminate()
            process.join()


class _Progress:
    """Passes on how far a shared counter has come. Final."""

    def __init__(self, done: Synchronized[int], tell: Tell) -> None:
        self._done = done
        self._tell = tell
        self._told = 0

    def look(self) -> None:
        done = self._done.value
        if done > self._told:
            self._tell(done - self._told)
            self._told = done


def _work(
    waiting: Queue[tuple[int, Task] | None],
    results: Queue[tuple[int, BatchResult | str]],
    done: Synchronized[int],
    stop: Event,
) -> None:
    """A worker's life: tasks until there are none."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def tell(count: int) -> None:
        with done.get_lock():
            done.value += count

    while (entry := waiting.get()) is not None:
        number, task = entry
        try:
            results.put((number, carry_out(task, tell, stop.is_set)))
        except Exception as error:
            results.put((number, f"{type(error).__name__}: {error}"))


def _results(
    count: int,
    results: Queue[tuple[int, BatchResult | str]],
    processes: list[BaseProcess] | list[Any],
    progress: _Progress,
    stop: Event,
    stopped: Stopped,
) -> Iterator[tuple[int, BatchResult]]:
    """The results as they come; after a stop, those of the tasks under way."""
    left, deadline = count, None
    while left:
        progress.look()
        if stopped() and not stop.is_set():
            stop.set()
            deadline = time.monotonic() + 10.0
        try:
            number, result = results.get(timeout=_LOOK_SECONDS)
        except Empty:
            if deadline is not None and time.monotonic() > deadline:
                return
            if any(process.exitcode not in {None, 0} for process in processes):
                raise RunError("a worker process died; was it killed, or out of memory? try fewer --workers") from None
            continue
        if isinstance(result, str):
            raise RunError(f"a worker failed: {result}")
        left -= 1
        yield number, result


def _in_order(results: Iterator[tuple[int, BatchResult]]) -> Iterator[BatchResult]:
    """Results in the order of their numbers."""
    held: dict[int, BatchResult] = {}
    due = 0
    for number, result in results:
        held[number] = result
        while due in held:
            yield held.pop(due)
            due += 1
    for number in sorted(held):
        yield held[number]


def on_cluster(tasks: list[Task], scheduler: str, tell: Tell, stopped: Stopped) -> Iterator[BatchResult]:
    """By the workers of a Dask cluster, which must have this version of evedrop installed.

    Raises UsageError if the scheduler cannot be reached or the extra `cluster` is not installed.
    """
    try:
        from distributed import Client  # noqa: PLC0415 - an optional extra
    except ImportError as error:
        raise UsageError("--scheduler needs Dask: pip install 'evedrop[cluster]'") from error
    try:
        client = Client(scheduler, timeout=5, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as error:
        raise UsageError(
            f"--scheduler {scheduler}: no Dask scheduler answers there within 5 s; start one with `dask scheduler`, "
            "and give its address, such as tcp://127.0.0.1:8786"
        ) from error
    return _from_cluster(client, tasks, tell, stopped)


def _from_cluster(client: Any, tasks: list[Task], tell: Tell, stopped: Stopped) -> Iterator[BatchResult]:
    with contextlib.closing(client):
        futures = [client.submit(_on_worker, task, pure=False) for task in tasks]
        try:
            for task, future in zip(tasks, futures, strict=True):
                while not future.done():
                    if stopped():
                        return
                    time.sleep(_LOOK_SECONDS)
                yield future.result()
                tell((task.stop - task.start) * int(task.scenario["slots"]))
        finally:
            client.cancel(futures)


def _on_worker(task: Task) -> BatchResult:
    return carry_out(task, lambda _: None, lambda: False)
