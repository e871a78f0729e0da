"""Shares out the tasks of a study: the one place that knows whether they run here or on a cluster."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import final

from evedrop.memory.cluster import REACH_SECONDS, Cluster, connected
from evedrop.memory.tasks import R, Stopped, Task, Tell
from evedrop.memory.workers import in_processes, in_this_process


@final
@dataclass(frozen=True)
class Crew:
    """Where tasks are carried out: in this process, in worker processes on this machine, or on a Dask cluster."""

    workers: int
    """Worker processes on this machine; 1: this process."""
    cluster: Cluster | None = None

    def results(self, tasks: Sequence[Task[R]], tell: Tell, stopped: Stopped) -> Generator[R]:
        """Carry out tasks; yields their results in task order.

        tell: gets the trial-slots done since its last call. After a stop, the last results may be incomplete.

        Raises RunError if a worker fails.
        """
        yield from _in_order(self._as_they_come(tasks, tell, stopped))

    def _as_they_come(self, tasks: Sequence[Task[R]], tell: Tell, stopped: Stopped) -> Iterator[tuple[int, R]]:
        """The results, with the numbers of their tasks."""
        if self.cluster is not None:
            for number, result in self.cluster.results(tasks, stopped):
                tell(tasks[number].work)
                yield number, result
        elif self.workers == 1 or len(tasks) == 1:
            yield from enumerate(in_this_process(tasks, tell, stopped))
        else:
            yield from in_processes(tasks, min(self.workers, len(tasks)), tell, stopped)


@contextlib.contextmanager
def crew_of(workers: int, scheduler: str | None = None, patience: float = REACH_SECONDS) -> Iterator[Crew]:
    """A crew of this many workers here; with the address of a Dask scheduler, its cluster.

    patience: seconds for the scheduler to answer. Raises UsageError if it does not.
    """
    with connected(scheduler, patience) as cluster:
        yield Crew(workers, cluster)


def _in_order(results: Iterator[tuple[int, R]]) -> Iterator[R]:
    """Results in the order of their numbers; those after a missing one are left out."""
    held: dict[int, R] = {}
    due = 0
    for number, result in results:
        held[number] = result
        while due in held:
            yield held.pop(due)
            due += 1
