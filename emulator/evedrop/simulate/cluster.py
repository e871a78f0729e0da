"""Carries out tasks on a Dask cluster: the workers of a scheduler, which must have this version of evedrop.

Source: docs/montecarlo.md, on a cluster.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from queue import Empty, SimpleQueue
from typing import Any, final

from evedrop.errors import RunError, UsageError
from evedrop.simulate.tasks import R, Stopped, Task
from evedrop.system.output import say

REACH_SECONDS = 5.0
"""For a Dask scheduler to answer."""
_ANSWER_SECONDS = 60.0  # for a scheduler that has answered before; it may be busy
_POLL_SECONDS = 0.1
_WORKERS_SECONDS = 1.0  # from one look at the list of workers to the next
_LONELY_SECONDS = 3.0  # without a worker, before this is said


@contextlib.contextmanager
def connected(scheduler: str | None, patience: float = REACH_SECONDS) -> Iterator[Cluster | None]:
    """The cluster of the Dask scheduler at an address, which answers within `patience` seconds; None without an address.

    Raises UsageError if it cannot be reached or the extra `cluster` is not installed.
    """
    if scheduler is None:
        yield None
        return
    import asyncio  # noqa: PLC0415 - a tenth of a worker's import time, and no worker needs it

    try:
        from distributed import Client  # noqa: PLC0415 - an optional extra
        from distributed.comm.core import connect  # noqa: PLC0415 - the same
    except ImportError as error:
        raise UsageError("a scheduler needs Dask: pip install '.[cluster]' in the checkout") from error

    async def reach() -> None:  # a client without a scheduler may hang, and prints useless messages
        reached = connect(scheduler, timeout=patience)  # type: ignore[no-untyped-call]
        comm = await asyncio.wait_for(reached, patience)
        await comm.close()

    try:
        asyncio.run(reach())
        client = Client(scheduler, timeout=patience, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as error:
        raise UsageError(
            f"the scheduler {scheduler}: no Dask scheduler answers there within {patience:g} s; start one with "
            "`dask scheduler`, and give its address, such as tcp://127.0.0.1:8786"
        ) from error
    with contextlib.closing(client):
        yield Cluster(scheduler, client)


@final
class Cluster:
    """The workers of a scheduler. They may come and go while a study runs."""

    def __init__(self, scheduler: str, client: Any) -> None:
        """client: connected to the scheduler at this address."""
        self._scheduler = scheduler
        self._client = client
        self._workers: frozenset[str] = frozenset()
        self._looked = float("-inf")
        self._lonely_since: float | None = None
        self._is_told = False

    def results(self, tasks: Sequence[Task[R]], stopped: Stopped) -> Iterator[tuple[int, R]]:
        """Carry out the tasks; yields the number of a task and its result as they come. After a stop, tasks are cancelled.

        Waits while there is no worker, and says so on standard error after some seconds.

        Raises RunError if a task fails, a worker has another version of evedrop, or the scheduler is gone or does not answer.
        """
        # A task that is submitted earlier could reach a worker of another version.
        while not self._has_workers(stopped):
            if stopped():
                return
            time.sleep(_POLL_SECONDS)
        futures = [self._client.submit(_on_worker, task, pure=False) for task in tasks]
        left = dict(enumerate(futures))
        try:
            while left:
                if stopped():
                    return
                self._has_workers(stopped)
                done = [number for number, future in left.items() if future.done()]
                if not done:
                    time.sleep(_POLL_SECONDS)
                for number in done:
                    yield number, _result(left.pop(number))
        finally:
            with contextlib.suppress(OSError):  # the scheduler may be gone
                self._client.cancel(futures)

    def _answer(self, question: Callable[[], Any], stopped: Stopped) -> Any:
        """The scheduler's answer; None after a stop. Another thread asks: a scheduler that is suspended never answers.

        Raises RunError after `_ANSWER_SECONDS`, and what the question raises.
        """
        answers = SimpleQueue[Any]()

        def ask() -> None:
            try:
                answers.put(question())
            except Exception as error:
                answers.put(error)

        threading.Thread(target=ask, name="scheduler", daemon=True).start()
        deadline = time.monotonic() + _ANSWER_SECONDS
        while time.monotonic() < deadline:
            if stopped():
                return None
            with contextlib.suppress(Empty):
                answer = answers.get(timeout=_POLL_SECONDS)
                if isinstance(answer, Exception):
                    raise answer
                return answer
        raise RunError(
            f"the scheduler {self._scheduler} has not answered for {_ANSWER_SECONDS:g} s (suspended, or cut off?); look at it, "
            "and run again"
        )

    def _has_workers(self, stopped: Stopped) -> bool:
        """Whether there is a worker, by a look at most every second; says on standard error if there is none for long.

        False after a stop.
        """
        now = time.monotonic()
        if now - self._looked >= _WORKERS_SECONDS:
            self._looked = now
            try:
                threads = self._answer(self._client.nthreads, stopped)
                workers = frozenset(threads or ())
                if workers - self._workers:
                    self._check_versions(stopped)
            except OSError as error:
                raise RunError(f"the scheduler {self._scheduler} is gone; start it and its workers again") from error
            if stopped():
                return False
            self._workers = workers
        if self._workers:
            self._lonely_since, self._is_told = None, False
            return True
        if self._lonely_since is None:
            self._lonely_since = now
        elif now - self._lonely_since >= _LONELY_SECONDS and not self._is_told:
            self._is_told = True
            say(
                f"the scheduler {self._scheduler} has no workers; waiting for one: start it with "
                f"`dask worker {self._scheduler} --nthreads 1`"
            )
        return False

    def _check_versions(self, stopped: Stopped) -> None:
        """Raise RunError if a worker has another version of evedrop, or none."""
        ours = importlib.metadata.version("evedrop")
        versions = self._answer(lambda: self._client.get_versions(packages=["evedrop"]), stopped)
        for worker, installed in ({} if versions is None else versions["workers"]).items():
            version = installed["packages"]["evedrop"]
            if version != ours:
                has = "no evedrop" if version is None else f"evedrop {version}"
                raise RunError(
                    f"the worker {worker} of the scheduler {self._scheduler} has {has}; expected evedrop {ours}, "
                    "as here: install this version there, or end that worker"
                )


def _result(future: Any) -> Any:
    try:
        return future.result()
    except RunError as error:
        raise RunError(f"a worker failed: {error}") from error
    except Exception as error:
        first = next(iter(str(error).splitlines()), "")
        raise RunError(
            f"a worker of the cluster failed: {type(error).__name__}: {first}; "
            "look at the worker's log, and whether the scenario's classes and files are there, too"
        ) from error


def _on_worker(task: Task[R]) -> R:
    return task.carry_out(lambda _: None, lambda: False)
