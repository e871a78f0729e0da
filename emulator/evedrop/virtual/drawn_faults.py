"""All kinds of faults of the simulated world, and those that are drawn for a run.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from math import ceil, log10

from evedrop.live.launch.briefs import flow_of
from evedrop.model.schemes import SCHEMES
from evedrop.names import CONTROLLER, LEGITIMATE, RECORDER, SENSOR
from evedrop.scenario.tables import Scenario
from evedrop.virtual import faults, outsiders
from evedrop.virtual.disturbance import ROUTERS, Disturbance, processes_of
from evedrop.virtual.moments import (
    ACKNOWLEDGED,
    BARRIERS,
    CHANGES,
    COMMANDS,
    DECISIONS,
    EVENTS,
    FINAL_BELIEFS,
    INPUTS,
    LOSSES,
    OF_SENSOR,
    PROGRESS,
    PROGRESS_OF_RECEIVERS,
)

_MOST_FAULTS = 3
_LATE = 0.5
"""The fraction of faults that strike at any moment of a run; the others strike rather at its beginning."""
_LOSING = 0.5
"""The fraction of faults that are short, and lose messages while the sensor sends its own."""
_LOSSES = (faults.CutConnection, faults.CutConnection, faults.FlapConnection, faults.ConfuseKeys, faults.KillProcess)
_CONCERNED = 0.5
"""The fraction of these that hit a process which sends or reads the messages that are counted."""
_NOTABLE = 0.4
"""The fraction of the other faults that strike at another moment than after some events."""
_OF_DISK = 0.8
"""The same of those that hit the disk."""
_COUNTS: Mapping[str, Sequence[int]] = {
    COMMANDS: (1, 1, 2, 2, 3, 4, 5),
    BARRIERS: (1, 1, 2, 3),
    LOSSES: (1, 1, 2),
    FINAL_BELIEFS: (1, 1, 2, 3),
    CHANGES: range(1, 100),
}
"""Moment → how many of its kind there may be until a fault strikes."""
_SOON, _SOON_EVENTS = 0.4, 50
"""The fraction of further faults that strike soon after an earlier one, and within how many events."""
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
        faults.HangProcess,
        faults.DelayThread,
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
        faults.LackThreads,
        faults.LackMemory,
        outsiders.AskStatus,
        outsiders.PauseRun,
        outsiders.ChangeLink,
        outsiders.CutLink,
        outsiders.LetStrangerIn,
    )
}


def is_answered(scenario: Scenario) -> bool:
    """Whether the sensor waits in each slot for what others answer."""
    return scenario.controller is not None or SCHEMES[scenario.encoding.spec["scheme"]].needs_acknowledgements


def events_of(scenario: Scenario, ahead: int) -> float:
    """About how many events a run has; ahead: how many slots the sensor may be ahead.

    A message carries some slots, unless each slot waits for an answer or for its time.
    """
    answered = is_answered(scenario)
    messages = scenario.slots if answered or scenario.pace else scenario.slots * 4.0 / ahead
    processes = len(processes_of(scenario))
    return scenario.shards * processes * (_OF_PROCESS + messages * (2.0 if answered else _OF_SLOT))


def faults_of(source: random.Random, scenario: Scenario, ahead: int) -> tuple[Disturbance, ...]:
    """The faults of a case; ahead: as in `events_of`."""
    last = max(2.0 * _FIRST, events_of(scenario, ahead))
    drawn: list[Disturbance] = []
    for _ in range(source.choice([0, 1, 1, 1, 2, _MOST_FAULTS])):
        if source.random() < _LOSING:
            drawn.append(_loss(source, scenario, ahead))
            continue
        [kind] = source.choices([*KINDS.values()], [kind.share for kind in KINDS.values()])
        target = source.choice(kind.targets(scenario))
        seconds = None
        if kind.lasts and (not kind.for_good or source.random() < 0.85):
            seconds = round(10.0 ** source.uniform(-2.0, log10(kind.most_seconds)), 3)
        before = next((fault for fault in reversed(drawn) if fault.moment == EVENTS), None)
        of_disk = issubclass(kind, faults.DiskDisturbance)
        if source.random() < (_OF_DISK if of_disk else _NOTABLE):
            moment = source.choice(
                [
                    *([CHANGES] * 8 if of_disk else [COMMANDS, COMMANDS, CHANGES]),
                    *[BARRIERS, FINAL_BELIEFS][: len(_leaves(scenario)) + 1] * bool(scenario.timeline.holds),
                    *[LOSSES] * bool(drawn),
                ]
            )
            drawn.append(kind(target, source.choice(_COUNTS[moment]), seconds, moment))
            continue
        uniform = source.random() < _LATE
        after = int(source.uniform(_FIRST, last) if uniform else _FIRST * (last / _FIRST) ** source.random())
        if before is not None and source.random() < _SOON:
            after = before.after + int(_SOON_EVENTS ** source.random())
        drawn.append(kind(target, after, seconds))
    return tuple(drawn)


def _loss(source: random.Random, scenario: Scenario, ahead: int) -> Disturbance:
    """A short fault that loses messages while the sensor sends its own."""
    kind = source.choice(_LOSSES)
    seconds = round(10.0 ** source.uniform(-2.0, 0.0), 3) if kind.lasts else None
    flow, leaves = flow_of(scenario, ahead), _leaves(scenario)
    concerned: dict[str, tuple[float, Sequence[str]]] = {
        OF_SENSOR: (1 if is_answered(scenario) or scenario.pace else flow.message, [SENSOR]),
        PROGRESS: (flow.batch, [SENSOR, RECORDER]),
        PROGRESS_OF_RECEIVERS: (flow.batch / len(scenario.receivers), [SENSOR]),
    }
    if SCHEMES[scenario.encoding.spec["scheme"]].needs_acknowledgements:
        concerned[ACKNOWLEDGED] = (1, [LEGITIMATE])
    if scenario.controller is not None:
        concerned[INPUTS] = (scenario.controller.period, [SENSOR, LEGITIMATE, LEGITIMATE, CONTROLLER])
        concerned[DECISIONS] = (flow.batch, [RECORDER])
    if leaves:
        concerned[FINAL_BELIEFS] = (scenario.slots / len(leaves), [RECORDER, *leaves])
    moment = source.choice([*concerned])
    slots, names = concerned[moment]
    if kind is faults.KillProcess:
        targets = [name for name in processes_of(scenario) if name in ROUTERS]
    else:
        targets = [*names] if source.random() < _CONCERNED else [*kind.targets(scenario)]
    return kind(source.choice(targets), source.randint(1, ceil(scenario.slots / slots)), seconds, moment)


def _leaves(scenario: Scenario) -> list[str]:
    """The receivers that leave, each as often as it does."""
    return [name for name, outages in scenario.timeline.outages.items() for _ in outages]
