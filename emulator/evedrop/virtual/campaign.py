"""Plays cases in the simulated world, one seed after the other, and says which promises were broken.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from evedrop.virtual import notes
from evedrop.virtual.cases import SimulatedCase, case_of
from evedrop.virtual.faults import Disturbance
from evedrop.virtual.judge import misses
from evedrop.virtual.processes import Program
from evedrop.virtual.reference import RunReference, in_memory
from evedrop.virtual.run import SimulatedRun, SimulatedWorld, run_in

_MEMORY = Path("/dev/shm")  # noqa: S108 - folders in it are private
"""Where folders are made, if there is such a place: a file system in memory."""


@dataclass(frozen=True)
class PlayedCase:
    """What became of a case."""

    case: SimulatedCase
    run: SimulatedRun
    struck: Mapping[Disturbance, float]
    """The faults that hit something, each with its moment in virtual seconds."""
    misses: tuple[str, ...]

    @property
    def seed(self) -> int:
        """The seed of the case."""
        return self.case.seed


def play(seed: int, program: Program, keep: bool = False) -> PlayedCase:
    """Play the case of a seed; program: what `evedrop` is in its world. keep: whether to keep all events."""
    return play_case(case_of(seed), program, keep)


def play_case(
    case: SimulatedCase, program: Program, keep: bool = False, reference: RunReference | None = None
) -> PlayedCase:
    """Play a case; reference: the same trials in memory, if they have been computed."""
    with _folder() as folder:
        memory, machine = folder / "memory", folder / "machine"
        machine.mkdir()
        if reference is None:
            reference = in_memory(case.scenario, memory)
        struck: dict[Disturbance, float] = {}
        world = SimulatedWorld(case.seed, program, machine, keep)
        temporary = world.disk.root / "temporary"
        temporary.mkdir(0o700)
        for fault in case.faults:
            world.scheduler.after(fault.after, partial(_strike, fault, world, struck))
        with _temporary(temporary):
            run = run_in(world, case.scenario, world.disk.root / "results", case.ahead)
        return PlayedCase(case, run, struck, tuple(misses(case, run, struck, reference, temporary)))


def _strike(fault: Disturbance, world: SimulatedWorld, struck: dict[Disturbance, float]) -> None:
    world.scheduler.note(notes.FAULT, str(fault))
    if fault.strike(world):
        struck[fault] = world.scheduler.now
    else:
        world.scheduler.note(notes.FAULT, "which hits nothing")


@contextmanager
def _folder() -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix="simulated-", dir=_MEMORY if _MEMORY.is_dir() else None))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _temporary(folder: Path) -> Iterator[None]:
    """Let the programs put what is temporary into a folder while the block runs."""
    before, tempfile.tempdir = tempfile.tempdir, str(folder)
    try:
        yield
    finally:
        tempfile.tempdir = before
