"""All kinds of faults of the simulated world, and those that are drawn for a run.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import random
from collections.abc import Mapping

from evedrop.model.schemes import SCHEMES
from evedrop.scenario.tables import Scenario
from evedrop.virtual import faults, lacks, outsiders
from evedrop.virtual.disturbance import Disturbance, processes_of

_MOST_FAULTS = 3
_LATE = 0.5
"""The fraction of faults that strike at any moment of a run; the others strike rather at its beginning."""
_FIRST = 20
"""Events, of the starts of the first processes, before which no fault strikes."""
_OF_PROCESS, _OF_SLOT = 8, 1.2
"""About how many events there are for each process of a run, and for each slot of a receiver for which somebody waits."""
KINDS: Mapping[str, type[Disturbance]] = {
    disturbance.kind: disturbance
    for disturbance in (
        faults.KillProcess,
        faults.InterruptProcess,
        faults.TerminateProcess,
        faults.HangUpProcess,
        faults.StopProcess,
        faults.StopAndKillProcess,
        faults.CutConnection,
        faults.FlapConnection,
        faults.FreezeConnection,
        faults.SlowConnection,
        faults.ConfuseKeys,
        faults.ShortenMessage,
        faults.FillDisk,
        faults.RefuseWrite,
        faults.BreakWrite,
        faults.ShortenWrite,
        faults.CutPower,
        faults.RenameResults,
        faults.RemoveResults,
        lacks.LackThreads,
        lacks.LackMemory,
        outsiders.AskStatus,
        outsiders.PauseRun,
        outsiders.ChangeLink,
        outsiders.CutLink,
        outsiders.LetStrangerIn,
    )
}


def events_of(scenario: Scenario, ahead: int) -> float:
    """About how many events a run has; ahead: how many slots the sensor may be ahead.

    A message carries some slots, unless each slot waits for an answer or for its time.
    """
    answered = scenario.controller is not None or SCHEMES[scenario.encoding.spec["scheme"]].needs_acknowledgements
    messages = scenario.slots if answered or scenario.pace else scenario.slots * 4.0 / ahead
    processes = len(processes_of(scenario))
    return scenario.shards * processes * (_OF_PROCESS + messages * (2.0 if answered else _OF_SLOT))


def faults_of(source: random.Random, scenario: Scenario, ahead: int) -> tuple[Disturbance, ...]:
    """The faults of a case; ahead: as in `events_of`."""
    last = max(2.0 * _FIRST, events_of(scenario, ahead))
    drawn = []
    for _ in range(source.choice([0, 1, 1, 1, 2, _MOST_FAULTS])):
        [kind] = source.choices([*KINDS.values()], [kind.share for kind in KINDS.values()])
        target = source.choice(kind.targets(scenario))
        seconds = None
        if kind.lasts and (not kind.for_good or source.random() < 0.85):
            seconds = round(10.0 ** source.uniform(-2.0, 1.0), 3)
        uniform = source.random() < _LATE
        after = int(source.uniform(_FIRST, last) if uniform else _FIRST * (last / _FIRST) ** source.random())
        drawn.append(kind(target, after, seconds))
    return tuple(drawn)
