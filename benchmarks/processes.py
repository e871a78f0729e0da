"""Watches the processes of a run from outside: CPU seconds and memory, from /proc."""

from __future__ import annotations

import os
import resource
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_TICK = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class ProcessUsage:
    """One process of a run, at one moment."""

    pid: int
    name: str
    """`launcher`, the name in its brief such as `smart`, or the name of another program."""
    role: str
    """As `name`, but `eavesdropper` for each of them."""
    cpu_seconds: float
    """Processor seconds so far."""
    resident: float
    """Resident memory in MB; memory that processes share counts in each."""

    @property
    def private(self) -> float:
        """Memory in MB that no other process has."""
        lines = Path(f"/proc/{self.pid}/smaps_rollup").read_text(encoding="ascii").splitlines()
        return sum(int(line.split()[1]) for line in lines if line.startswith("Private_")) * 1024 / 1e6


def processes_of(launcher: int) -> list[ProcessUsage]:
    """The launcher of a run and all its descendants, by process id."""
    stats = dict(_stats())
    inside = {launcher} & stats.keys()
    while more := {pid for pid, fields in stats.items() if int(fields[1]) in inside} - inside:
        inside |= more
    usages = []
    for pid in sorted(inside):
        fields = stats[pid]
        try:
            role, name = ("launcher", "launcher") if pid == launcher else _names(pid)
        except OSError:
            continue
        seconds = (int(fields[11]) + int(fields[12])) / _TICK
        usages.append(ProcessUsage(pid, name, role, seconds, int(fields[21]) * _PAGE / 1e6))
    return usages


def _stats() -> Iterator[tuple[int, list[str]]]:
    """Process id → the fields of /proc/PID/stat from the state on."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            yield int(folder.name), (folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        except OSError:
            continue


def _names(pid: int) -> tuple[str, str]:
    """Role and name of a process, from its command line `python … -m evedrop ROLE …/NAME.json`."""
    words = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").split()
    if "evedrop" in words[:-2] and words[-1].endswith(".json"):
        return words[words.index("evedrop") + 1], Path(words[-1]).stem
    other = next((word for word in words if word.startswith("evedrop.")), Path(words[0]).name if words else "ended")
    return other, other


def children_seconds() -> float:
    """The processor seconds of all processes that this one has started and waited for."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def watch_cpu(process: subprocess.Popen[bytes], interval: float = 0.05) -> dict[str, float]:
    """Watch a command until it ends: process name → its processor seconds."""
    seconds: dict[str, float] = {}
    while process.poll() is None:
        seconds.update({usage.name: usage.cpu_seconds for usage in processes_of(process.pid)})
        time.sleep(interval)
    return seconds
