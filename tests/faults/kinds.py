"""The faults: what each does, and what a run promises when it happens."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from tests.faults.disturbed import CLEANER, FORK_SERVERS, Disturbed
from tests.faults.hosts import CONNECTION, HOST_CLEANER, HOST_FORK_SERVER, PROGRAM, SSH, host_of, part_of
from tests.faults.moments import Moment, Usual

SIGNALS = {"hang up": signal.SIGHUP, "interrupt": signal.SIGINT, "terminate": signal.SIGTERM}
RESULTS = "results"
EVERYBODY = "everybody"
_APPEARS_SECONDS = 5.0
_PATIENT_SECONDS = (
    20.0  # of the longest outage, where short interruptions must not end a run, however busy the machine is
)
_FILE_BYTES = 4096  # of the largest file, where no disk can be filled
_ROUTERS = ("router", "relay")
_UNWRITTEN = (
    "results cannot be written",
    "results of the shards cannot be merged",
    "cannot be written",
    "cannot be started",
    "was removed while the run went on",
)
NETWORK = ("flap", "cut", "silence")
_WITHOUT = (
    "not enough memory",
    "no further process or thread can be started",
    "cannot be started",
    "fork server",
    "resource",
)
"""What a machine that lacks something may be told to lack."""
LIMITS = {"few processes": ("processes", 5, 90), "little memory": ("memory", 200, 3000)}
"""Limits of a whole run: the resource, and the least and most of it (processes and threads; megabytes of addresses)."""
CONFUSED = "confuse"
"""A message arrives on a key that it does not name, too, as connections that flap have been seen to deliver them."""
NEEDS = {"few processes": "a limit of processes", "break the disk": "a disk that breaks"}
"""Kind of fault → the facility that it needs."""
KILLING = ("kill", "stop and kill")


@dataclass(frozen=True)
class Fault:
    """One fault of a case."""

    kind: str
    target: str
    """A process, a part of a host, `everybody` of the network, or the `results`."""
    moment: Moment
    shard: int = 0
    seconds: float | None = None
    """How long it lasts; None for good, or where it does not last."""
    count: int = 1
    """How often a connection flaps; or the limit that the run has."""

    def __str__(self) -> str:
        lasts = "" if self.seconds is None else f" {self.seconds:.1f} s"
        often = f" {self.count} times" if self.kind == "flap" else ""
        if self.kind in LIMITS:
            return f"{self.kind}: {self.count}"
        if self.kind == CONFUSED:
            return f"confuse keys after every {self.count} deliveries"
        good = " for good" if self.seconds is None and self.kind in ("stop", "cut", "silence") else ""
        where = f" (shard {self.shard + 1})" if self.shard else ""
        return f"{self.kind} {self.target}{where}{often}{lasts}{good} at {self.moment}"

    def strike(self, run: Disturbed, usual: Usual) -> float | None:
        """Wait for the moment and do it; when, by the monotonic clock, or None if it hit nothing."""
        if not self.moment.wait(run, usual):
            return None
        begun = time.monotonic()
        hit = _STRIKES[self.kind](self, run)
        if self.kind in SIGNALS:  # perhaps only when the launcher heeded it
            begun = time.monotonic()
        return begun if hit else None

    def survived(self, longest_outage: float) -> bool:
        """Whether the run must go on to the end as if nothing had happened."""
        if self.target == CLEANER or part_of(self.target) == HOST_CLEANER:
            return True
        # On a busy machine a router takes its time to be back, and so do connections.
        patient = longest_outage >= _PATIENT_SECONDS
        if self.is_ignored:
            return patient
        if part_of(self.target) == CONNECTION and self.kind != "silence":
            return False  # ssh does not connect again
        if self.kind in (*NETWORK, "stop"):
            return patient and self.seconds is not None
        return patient and (self.kind == CONFUSED or (self.kind == "kill" and self.target in _ROUTERS))

    @property
    def is_ignored(self) -> bool:
        """Whether a host's program, or the client of the connection with it, is suspended for good while the run goes on.

        Nobody needs them then, and the run ends within half a minute of its last slot. Source: docs/hosts.md, how it ends.
        """
        return self.kind == "stop" and self.seconds is None and part_of(self.target) in (PROGRAM, SSH)

    @property
    def blamed(self) -> tuple[str, ...]:
        """What a failure that this fault causes may name."""
        if host := host_of(self.target):
            named = (f"host {host}",)
            return (*named, "fork server") if part_of(self.target) == HOST_FORK_SERVER else named
        if self.target == RESULTS:
            return _UNWRITTEN
        if self.kind in LIMITS:
            # Where the system refuses Zenoh a thread, Zenoh may wait for it, in a router that does not listen, or abort.
            few = ("router did not listen", "can't spawn worker thread")
            return (*_WITHOUT, *few) if self.kind == "few processes" else _WITHOUT
        if self.target in FORK_SERVERS:
            return ("fork server",)
        if self.target == EVERYBODY:
            return (*_ROUTERS, "recorder")
        # Whose own connection is gone cannot tell who is at fault: to it all others vanish behind the router.
        return (self.target, *(_ROUTERS if self.target in ("recorder", *_ROUTERS) else ()))


_T = TypeVar("_T")


def _awaited(look: Callable[[], list[_T]], run: Disturbed) -> list[_T]:
    """The first non-empty answer, within some seconds."""
    targets: list[_T] = []
    for _ in range(int(_APPEARS_SECONDS / 0.02)):
        targets = look()
        if targets or run.over.wait(0.02):
            break
    return targets


def _process(fault: Fault, run: Disturbed) -> list[int]:
    """The target's process id, as soon as there is one."""
    return _awaited(lambda: run.pids(fault.target, fault.shard), run)


def _heeds(pid: int) -> bool:
    """Whether a process has come to the first line of ours, which has it heed signals: what Python did before is not a run's."""
    with suppress(OSError, StopIteration):
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        caught = int(next(line for line in lines if line.startswith("SigCgt")).split()[1], 16)
        return bool(caught >> (signal.SIGTERM - 1) & 1)
    return False


def _send(number: signal.Signals) -> Callable[[Fault, Disturbed], bool]:
    def strike(fault: Fault, run: Disturbed) -> bool:
        hit = False
        if fault.kind in SIGNALS and (fault.target == "launcher" or part_of(fault.target) == PROGRAM):
            _awaited(lambda: [pid for pid in run.pids(fault.target, fault.shard) if _heeds(pid)], run)
        for pid in _process(fault, run):
            with suppress(ProcessLookupError):
                os.kill(pid, number)
                hit = True
        return hit

    return strike


def _stop(fault: Fault, run: Disturbed) -> bool:
    process = _process(fault, run)
    for pid in process:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)
    run.over.wait(fault.seconds)  # for good: until the launcher has ended, which ends or frees it
    if fault.is_ignored:
        return bool(process)  # it is freed or ended with the connection
    for pid in process:
        if pid in run.pids(fault.target, fault.shard):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
    return bool(process)


def _stop_and_kill(fault: Fault, run: Disturbed) -> bool:
    pids = _process(fault, run)
    for number in (signal.SIGSTOP, signal.SIGKILL):
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, number)
        if number == signal.SIGSTOP:
            run.over.wait(fault.seconds)
    return bool(pids)


def _limited(fault: Fault, run: Disturbed) -> bool:
    """The run was started with it."""
    del fault, run
    return True


def _flap(fault: Fault, run: Disturbed) -> bool:
    hit = False
    _awaited(lambda: run.wires(fault.target, fault.shard), run)
    for _ in range(fault.count):
        for wire in run.wires(fault.target, fault.shard):
            hit = hit or wire.connections > 0
            wire.cut()
            wire.heal()
        if run.over.wait((fault.seconds or 0.0) / fault.count):
            break
    return hit


def _cut(fault: Fault, run: Disturbed) -> bool:
    return _held(fault, run, "cut")


def _silence(fault: Fault, run: Disturbed) -> bool:
    return _held(fault, run, "silence")


def _held(fault: Fault, run: Disturbed, how: str) -> bool:
    wires = _awaited(lambda: run.wires(fault.target, fault.shard), run)
    for wire in wires:
        getattr(wire, how)()
    run.over.wait(fault.seconds)
    for wire in wires:
        wire.heal()
    return bool(wires)


def _fill(fault: Fault, run: Disturbed) -> bool:
    """Fill the disk; without a disk of our own, forbid the processes that write results to let any file grow."""
    del fault
    if run.fill():
        return True
    hit = False
    for name in ("recorder", "launcher"):
        for shard in range(run.variant.shards):
            for pid in run.pids(name, shard):
                with suppress(ProcessLookupError):
                    _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
                    resource.prlimit(pid, resource.RLIMIT_FSIZE, (_FILE_BYTES, hard))
                    hit = True
    return hit


def _break(fault: Fault, run: Disturbed) -> bool:
    del fault
    return run.break_disk()


def _rename(fault: Fault, run: Disturbed) -> bool:
    del fault
    with suppress(OSError):
        os.rename(run.out, run.renamed)
        return True
    return False


def _remove(fault: Fault, run: Disturbed) -> bool:
    del fault
    there = run.out.exists()
    shutil.rmtree(run.out, ignore_errors=True)
    return there


_STRIKES: Mapping[str, Callable[[Fault, Disturbed], bool]] = {
    "kill": _send(signal.SIGKILL),
    **{kind: _send(number) for kind, number in SIGNALS.items()},
    "stop": _stop,
    "stop and kill": _stop_and_kill,
    **dict.fromkeys((*LIMITS, CONFUSED), _limited),
    "flap": _flap,
    "cut": _cut,
    "silence": _silence,
    "fill the disk": _fill,
    "break the disk": _break,
    "rename": _rename,
    "remove": _remove,
}
KINDS = tuple(_STRIKES)
