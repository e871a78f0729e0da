"""What stands for each disturbance of real processes in the simulated world, or why nothing does.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from evedrop.scenario.tables import Scenario
from evedrop.virtual import faults, host_faults, host_parts
from evedrop.virtual.cases import SimulatedCase
from evedrop.virtual.disturbance import EVERYBODY as ALL
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.processes import FORK_SERVERS as SERVERS
from evedrop.virtual.processes import LAUNCHER
from tests.faults.disturbed import CLEANER, FORK_SERVERS
from tests.faults.hosts import CONNECTION, HOST_CLEANER, HOST_FORK_SERVER, PROGRAM, SESSION, SSH
from tests.faults.kinds import CONFUSED, EVERYBODY, RESULTS
from tests.virtual.wire_cases import SimulatedWireCase

OF_KINDS: Mapping[str, type[Disturbance]] = {
    "kill": faults.KillProcess,
    "hang up": faults.HangUpProcess,
    "interrupt": faults.InterruptProcess,
    "terminate": faults.TerminateProcess,
    "stop": faults.StopProcess,
    "stop and kill": faults.StopAndKillProcess,
    "few processes": faults.LackThreads,
    "little memory": faults.LackMemory,
    CONFUSED: faults.ConfuseKeys,
    "flap": faults.FlapConnection,
    "cut": faults.CutConnection,
    "silence": faults.FreezeConnection,
    "fill the disk": faults.FillDisk,
    "break the disk": faults.BreakWrite,
    "rename": faults.RenameResults,
    "remove": faults.RemoveResults,
}
"""Kind of fault of real processes → its twin."""
OF_PARTS: Mapping[str, str] = {
    SSH: host_parts.SSH,
    PROGRAM: host_parts.PROGRAM,
    SESSION: host_parts.SESSION,
    HOST_FORK_SERVER: host_parts.HOST_FORK_SERVER,
    CONNECTION: host_parts.CONNECTION,
}
"""Part of a host → the part of a simulated one."""
OF_CONNECTIONS: Mapping[str, type[Disturbance]] = {
    "cut": host_faults.CutSsh,
    "silence": host_faults.FreezeSsh,
}
"""Kind of fault of a connection with a host → its twin."""
OF_TARGETS: Mapping[str, str] = {
    "launcher": LAUNCHER,
    EVERYBODY: ALL,
    RESULTS: RESULTS,
    **dict(zip(FORK_SERVERS, reversed(SERVERS), strict=True)),
}
"""What is hit, besides the processes of a scenario, whose names are the same → what is hit in the simulated world."""
OF_VARIANTS: Mapping[str, Callable[[Scenario], object]] = {
    "plain": lambda scenario: scenario.eavesdroppers,
    "fast": lambda scenario: scenario.pace == 0.0,
    "batch": lambda scenario: 1 < scenario.record_trials < scenario.trials,
    "events": lambda scenario: scenario.as_tables().get("event"),
    "acknowledged": lambda scenario: scenario.acknowledgements,
    "loop": lambda scenario: scenario.controller,
    "relayed": lambda scenario: scenario.relayed,
    "shards": lambda scenario: scenario.shards > 1,
}
"""Variant of the real runs → what makes a drawn scenario one."""
OF_HOSTED: Mapping[str, Callable[[SimulatedCase], object]] = {
    "hosts": lambda case: case.hosts and not case.scenario.relayed,
    "sites": lambda case: case.hosts and case.scenario.relayed,
}
"""Variant of the real runs over ssh → what makes a drawn case one."""
OF_FAMILIES: Mapping[str, type[SimulatedWireCase]] = {"wire": SimulatedWireCase}
"""Kind of cases other than runs → its twin."""
WITHOUT_TWIN: Mapping[str, str] = {
    CLEANER: "a simulated machine removes the folder of a process that has died",
    "viewed": "the viewer is a program of Rerun, and no process of a run waits for it",
    "study": "its workers exchange no messages, and neither threads nor time decide their results",
    HOST_CLEANER: "a simulated host removes the folder of a program that has died",
}
"""What nothing stands for → why: targets, parts of hosts, variants, and kinds of cases."""
