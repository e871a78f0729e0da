"""Plays a scenario in the simulated world, one seed after the other, as a test of what it promises.

Source: docs/testing.md, in the simulated world.
"""

from __future__ import annotations

import math
import pkgutil
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evedrop.counting import counted
from evedrop.errors import EvedropError, Interrupted, UsageError
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import options_of
from evedrop.system.signals import stop_on_signals
from evedrop.virtual.campaign import PlayedCase, play_case
from evedrop.virtual.cases import SimulatedCase, case_with
from evedrop.virtual.diagram import diagram
from evedrop.virtual.processes import Program
from evedrop.virtual.reference import RunReference, in_memory
from evedrop.virtual.shrinking import shrink
from evedrop.virtual.steps import steps_of

MOST_SLOTS, MOST_TRIALS = 10_000, 200
"""Of a run in the simulated world: it is one of many."""
_MOST_PACED_SECONDS = 1800.0
"""Virtual seconds for which a scenario may last at its pace: a run that takes an hour counts as one that never ends."""
_MOST_PLAYS = 100
"""Cases that are played to shrink one."""
_MOST_MISSES = 5
"""Broken promises of one run that are told."""


@dataclass(frozen=True)
class SeedsToPlay:
    """The seeds with which a scenario is run in the simulated world."""

    first: int
    """The first seed."""
    seeds: int
    program: str
    """The function that `evedrop` is in that world, as PACKAGE.MODULE:FUNCTION: commands are not known here."""


@dataclass(frozen=True)
class PlayedSeeds:
    """What became of all seeds of a scenario."""

    told: str
    """How many were played, and how fast."""
    reasons: tuple[str, ...] = ()
    """The promises that the first failing seed broke, and how it is played again; empty if none failed."""
    story: str = ""
    """What happened with the first failing seed, shrunk, as a diagram."""


def check_simulated(scenario: Scenario) -> None:
    """Raise UsageError if the simulated world cannot run a scenario."""
    lasting = scenario.slots * scenario.pace
    if scenario.process.source == "zenoh":
        raise UsageError(
            'process.source = "zenoh": no program of yours publishes states there; test it live, without --simulated'
        )
    if scenario.trials > MOST_TRIALS:
        raise UsageError(
            f"{scenario.trials} trials are too many for --simulated; give --trials {MOST_TRIALS}, or fewer"
        )
    if scenario.slots > MOST_SLOTS:
        raise UsageError(
            f"{scenario.slots} slots are too many for --simulated; give --set slots={MOST_SLOTS}, or fewer"
        )
    if lasting > _MOST_PACED_SECONDS:
        most = _MOST_PACED_SECONDS / scenario.slots
        step = 10.0 ** (math.floor(math.log10(most)) - 1)  # of two digits
        raise UsageError(
            f"{scenario.slots} slots at a pace of {scenario.pace:g} s are {lasting:g} s, too long for --simulated; "
            f"give --set pace={math.floor(most / step) * step:.2g}, or less"
        )


def play_seeds(
    scenario: Scenario, place: str, folder: Path, simulation: SeedsToPlay, changes: Mapping[str, Any]
) -> PlayedSeeds:
    """Play all seeds; writes the results of the same trials in memory, to which every run must come, into a folder.

    place: the scenario, as it was given; changes: those that were made of it. Raises Interrupted on Ctrl-C.
    """
    program: Program = pkgutil.resolve_name(simulation.program)
    failed: list[PlayedCase] = []
    with stop_on_signals() as stop:
        reference = in_memory(scenario, folder)

        def heed() -> None:
            if stop.is_set():
                raise Interrupted.with_results(folder)

        def play(case: SimulatedCase, reference: RunReference | None = None) -> PlayedCase:
            heed()
            return play_case(case, program, keep=reference is None, reference=reference, check=heed)

        started = time.monotonic()
        for seed in range(simulation.first, simulation.first + simulation.seeds):
            played = play(case_with(scenario, seed), reference)
            if played.misses:
                failed.append(played)
        seconds = time.monotonic() - started
        told = (
            f"{counted(simulation.seeds, 'run')} from seed {simulation.first} on, "
            f"{len(failed)} of which broke a promise; {simulation.seeds / seconds:.1f} runs/s"
        )
        if not failed:
            return PlayedSeeds(told)
        story = _story(failed[0], play)
        heed()
    return PlayedSeeds(told, _reasons(failed[0], place, changes), story)


def _reasons(played: PlayedCase, place: str, changes: Mapping[str, Any]) -> tuple[str, ...]:
    words = ["evedrop", "test", place, "--simulated", "--seed", str(played.seed), "--seeds", "1", *options_of(changes)]
    again = shlex.join(words)
    faults = "; ".join(map(str, played.case.faults)) or "no fault"
    first, *others = _first(played.misses)
    return (f"seed {played.seed}, {faults}: {first}; see it again: {again}", *others)


def _first(misses: Sequence[str]) -> list[str]:
    """The first misses, and how many more there are: rows that differ are many."""
    more = len(misses) - _MOST_MISSES
    return [*misses[:_MOST_MISSES], *([f"and {more} more"] if more > 0 else [])]


def _story(failed: PlayedCase, play: Callable[[SimulatedCase], PlayedCase]) -> str:
    """The smallest run found that breaks the same promise."""
    small = shrink(failed.case, failed.misses, lambda case: play(case).misses, _MOST_PLAYS)
    lines = [f"the smallest run found that does so: {small.case}", *_first(small.misses)]
    try:
        lines.append(diagram(steps_of(play(small.case).run.happened)))
    except Interrupted:
        raise
    except EvedropError as error:  # of a class that does something else each time
        lines.append(f"played again, it ends otherwise: {error}")
    return "\n".join(lines)
