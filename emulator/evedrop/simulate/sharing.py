"""Shares out the tasks of a study: the one place that knows whether they run here or on a cluster."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import final

from evedrop.simulate.cluster import REACH_SECONDS, Cluster, connected
from evedrop.simulate.kept_tasks import KeptTasks
from evedrop.simulate.tasks import OnProgress, R, Stopped, Task
from evedrop.simulate.workers import in_processes, in_this_process


@final
@dataclass(frozen=True)
class Crew:
    """Where tasks are carried out: in this process, in worker processes on this machine, or on a Dask cluster."""

    workers: int
    """Worker processes on this machine; 1: this process."""
    cluster: Cluster | None = None

    def results(
        self, tasks: Sequence[Task[R]], on_progress: OnProgress, stopped: Stopped, kept: KeptTasks | None = None
    ) -> Generator[R]:
        """Carry out tasks; yields their results in task order.

        on_progress: gets the trial-slots done since its last call; kept: where complete results are kept as they come, and from
        where those that it has are read. After a stop, the last results may be incomplete.

        Raises RunError if a worker fails, OSError if a result cannot be kept.
        """
        read = {number for number, task in enumerate(tasks) if kept is not None and kept.has(task)}
        left = [number for number in range(len(tasks)) if number not in read]
        held: dict[int, R] = {}
        due = 0
        with contextlib.closing(self._as_they_come([tasks[number] for number in left], on_progress, stopped)) as new:
            while True:
                while due in read or due in held:
                    if due in held:
                        yield held.pop(due)
                    elif kept is not None and not stopped():
                        yield kept.load(tasks[due])
                        on_progress(tasks[due].work)
                    else:
                        return
                    due += 1
                if (following := next(new, None)) is None:
                    return
                number, result = left[following[0]], following[1]
                held[number] = result
                if kept is not None and result.complete and len(tasks) > 1:  # a study of one task is complete with it
                    kept.keep(tasks[number], result)

    def _as_they_come(
        self, tasks: Sequence[Task[R]], on_progress: OnProgress, stopped: Stopped
    ) -> Generator[tuple[int, R]]:
        """The results, with the numbers of their tasks."""
        if not tasks:
            return
        if self.cluster is not None:
            for number, result in self.cluster.results(tasks, stopped):
                on_progress(tasks[number].work)
                yield number, result
        elif self.workers == 1 or len(tasks) == 1:
            yield from enumerate(in_this_process(tasks, on_progress, stopped))
        else:
            yield from in_processes(tasks, min(self.workers, len(tasks)), on_progress, stopped)


@contextlib.contextmanager
def crew_of(workers: int, scheduler: str | None = None, patience: float = REACH_SECONDS) -> Iterator[Crew]:
    """A crew of this many workers here; with the address of a Dask scheduler, its cluster.

    patience: seconds for the scheduler to answer. Raises UsageError if it does not.
    """
    with connected(scheduler, patience) as cluster:
        yield Crew(workers, cluster)
