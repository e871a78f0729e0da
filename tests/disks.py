"""A simulated disk for a test, and programs that write to it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from evedrop.system.world import inside
from evedrop.virtual.disk import DiskFault, DiskFaults, VirtualDisk
from evedrop.virtual.processes import VirtualMachine
from evedrop.virtual.scheduler import VirtualScheduler, VirtualTask
from evedrop.virtual.world import VirtualWorld

VIRTUAL_SECONDS = 3600.0


@contextmanager
def simulated(
    folder: Path, seed: int = 1, faults: DiskFaults = lambda _: None
) -> Iterator[tuple[VirtualScheduler, VirtualDisk]]:
    """A world that has a disk below a folder; `faults` as in `VirtualDisk`."""
    scheduler = VirtualScheduler(seed)
    disk = VirtualDisk(scheduler, folder, faults)
    with inside(VirtualWorld(scheduler, VirtualMachine(scheduler, lambda _: 0), None, disk)):
        try:
            yield scheduler, disk
        finally:
            scheduler.take_down()


def at(number: int, fault: DiskFault) -> DiskFaults:
    """A fault at one operation, and none at the others."""
    return lambda operation: fault if operation == number else None


def run_program(scheduler: VirtualScheduler, work: Callable[[], object]) -> VirtualTask:
    """Let a program run until it ends, or is ended; raises what it raises. Returns its process."""
    task = scheduler.process("program")
    thread = scheduler.thread("main", work, task)
    thread.start()
    scheduler.run(VIRTUAL_SECONDS, lambda: thread.over or not task.alive)
    if task.alive:
        scheduler.end(task, len(scheduler.errors))
    for _, error in scheduler.errors:
        raise error
    return task
