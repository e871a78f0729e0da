"""Watches the processes of a run from outside: CPU seconds and resident memory, by process name, from /proc."""

from __future__ import annotations

import os
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path

_TICK = os.sysconf("SC_CLK_TCK")


@dataclass
class Usage:
    """What a process used so far."""

    cpu_seconds: float = 0.0
    resident: list[float] = field(default_factory=list)
    """Resident memory in MB, a sample each time it was looked at."""


def watch(process: subprocess.Popen[bytes], interval: float = 0.05) -> dict[str, Usage]:
    """Sample a command and its children until it ends: process name → usage; the command itself is `launcher`."""
    usage: dict[str, Usage] = {}
    while process.poll() is None:
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                _sample(folder, process.pid, usage)
            except OSError:
                continue
        time.sleep(interval)
    return usage


def _sample(folder: Path, parent: int, usage: dict[str, Usage]) -> None:
    fields = (folder / "stat").read_text().rpartition(")")[2].split()
    pid = int(folder.name)
    if pid != parent and int(fields[1]) != parent:
        return
    arguments = (folder / "cmdline").read_bytes().split(b"\0")
    name = "launcher" if pid == parent else Path(arguments[-2].decode()).stem if len(arguments) > 1 else ""
    one = usage.setdefault(name, Usage())
    one.cpu_seconds = (int(fields[11]) + int(fields[12])) / _TICK
    one.resident.append(int(fields[21]) * os.sysconf("SC_PAGE_SIZE") / 1e6)
