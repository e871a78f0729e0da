"""Plays cases in the simulated world, one seed after the other, and says which promises were broken.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

from evedrop.errors import UsageError
from evedrop.scenario.loading import load
from evedrop.scenario.tables import Scenario
from evedrop.virtual import notes
from evedrop.virtual.cases import SEEDS_OF_A_SCENARIO, SimulatedCase, case_of
from evedrop.virtual.disturbance import Disturbance, processes_of
from evedrop.virtual.drawn_scenarios import scenario_of
from evedrop.virtual.judge import misses
from evedrop.virtual.moments import EVENTS, is_counted
from evedrop.virtual.processes import Program
from evedrop.virtual.programs import taken_states
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
    return play_case(case_of(seed), program, keep, _reference_of(seed // SEEDS_OF_A_SCENARIO))


def play_case(
    case: SimulatedCase,
    program: Program,
    keep: bool = False,
    reference: RunReference | None = None,
    check: Callable[[], object] = lambda: None,
) -> PlayedCase:
    """Play a case; reference: the same trials in memory, if they have been computed.

    check: called again and again meanwhile; what it raises ends the play.
    """
    with _folder() as folder:
        if reference is None:
            reference = in_memory(case.scenario, folder / "memory")
        machine = folder / "machine"
        machine.mkdir()
        struck: dict[Disturbance, float] = {}
        world = SimulatedWorld(case.seed, program, machine, keep)
        world.scheduler.check = check
        temporary = world.disk.root / "temporary"
        temporary.mkdir(0o700)
        for fault in case.faults:
            _plan(fault, case.scenario, world, struck)
        hosts_file = None
        if case.hosts is not None:
            world.add_hosts(machine, case.hosts.oddities)
            hosts_file = folder / "hosts.toml"
            hosts_file.write_text(case.hosts.text(case.scenario))
        with _temporary(temporary):
            run = run_in(world, case.live, case.ahead, hosts_file, begin=partial(_begin_program, case, world))
        temporaries = {"": temporary, **{host.name: host.temporary for host in world.hosts or ()}}
        if any(fault.amends for fault in struck):
            reference = _amended(reference, case.scenario, run.folder, folder / "amended")
        wrong = list[str]()
        if case.program is not None:
            taken, count, wrong = taken_states(run.folder, case.scenario, disturbed=bool(struck))
            reference = in_memory(taken, folder / "taken").of_states(count)
        return PlayedCase(case, run, struck, (*wrong, *misses(case, run, struck, reference, temporaries)))


def _begin_program(case: SimulatedCase, world: SimulatedWorld) -> None:
    if case.program is not None:
        case.program.begin(world, case.scenario)


@lru_cache(maxsize=1)
def _reference_of(number: int) -> RunReference:
    """The trials in memory of the scenario that some seeds play."""
    with _folder() as folder:
        return in_memory(scenario_of(number), folder / "memory")


def _amended(reference: RunReference, scenario: Scenario, results: Path, folder: Path) -> RunReference:
    """The same trials in memory with the events that an operator has added; results: of the run."""
    with suppress(UsageError):  # it has no results
        amended = load(results)
        if added := [event for event in amended.event if event not in scenario.event]:
            first = min(act.at for event in added for act in event.acts())
            return in_memory(amended, folder).after(first, reference)
    return reference


def _plan(fault: Disturbance, scenario: Scenario, world: SimulatedWorld, struck: dict[Disturbance, float]) -> None:
    """Let a fault strike at its moment."""
    act = partial(_strike, fault, world, struck)
    if fault.moment == EVENTS:
        world.scheduler.after(fault.after, act)
    else:
        counts = partial(is_counted, fault.moment, fault.target, fault.target in processes_of(scenario))
        world.scheduler.after_some(fault.after, counts, act)


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
