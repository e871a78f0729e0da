"""Evedrop as its users start it: real processes, found and counted, each test in a temporary folder of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from emulator.brief import Brief, read_brief
from emulator.runs.results import Results, load_results

LIMIT = 40.0
"""Seconds after which a condition that a test waits for counts as never met: far above what a busy machine needs."""


def wait_until(condition: Callable[[], Any], what: str, limit: float = LIMIT) -> Any:
    """The first true value of a condition; fails the test when it stays false for so many seconds."""
    deadline = time.monotonic() + limit
    while not (found := condition()):
        if time.monotonic() > deadline:
            pytest.fail(f"within {limit:g} s: {what}")
        time.sleep(0.01)
    return found


def with_mark(mark: str) -> dict[int, str]:
    """Process id → command line of every living process whose command line or environment has `mark` in it."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            command, environment = (folder / "cmdline").read_bytes(), (folder / "environ").read_bytes()
            state = (folder / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue
        if mark.encode() in command + environment and state != "Z" and int(folder.name) != os.getpid():
            found[int(folder.name)] = command.replace(b"\0", b" ").decode(errors="replace")
    return found


def processor_seconds(pid: int) -> float:
    """How long a process has computed."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Done:
    """A command that ended."""

    status: int
    out: str
    err: str

    @property
    def summary(self) -> dict[str, Any]:
        """What --json printed: one object and nothing else."""
        found: dict[str, Any] = json.loads(self.out)
        return found


class Live:
    """A command that runs, its children, and what it leaves behind."""

    def __init__(self, process: subprocess.Popen[str], temporary: Path, folder: Path) -> None:
        self.process = process
        self.temporary = temporary
        self.folder = folder

    def briefs(self) -> dict[str, Path]:
        """Process name → the brief it was given, as far as they are written."""
        return {path.stem: path for path in self.temporary.glob("evedrop-*/*.json")}

    def brief(self, name: str) -> Brief:
        """The brief of one process, as soon as it is there."""
        return read_brief(wait_until(lambda: self.briefs().get(name), f"a brief of {name}"))

    def children(self) -> dict[str, int]:
        """Process name → process id."""
        found = {}
        for pid, command in with_mark(str(self.temporary)).items():
            words = command.split()
            if pid != self.process.pid and words and words[-1].endswith(".json"):
                found[Path(words[-1]).stem] = pid
        return found

    def child(self, name: str) -> int:
        """The process id of one process, as soon as it is there."""
        pid: int = wait_until(lambda: self.children().get(name), f"a process {name}")
        return pid

    def running(self) -> None:
        """Wait until slots go through the run: it was started, for the briefs are gone, and the sensor has worked since."""
        sensor = self.child("sensor")
        wait_until(lambda: not self.briefs(), "a run under way")
        before = processor_seconds(sensor)
        # So much work is several windows of slots: the observer must have scored one, or the sensor would be waiting.
        wait_until(lambda: processor_seconds(sensor) > before + 0.3, "a sensor at work")

    def kill(self, name: str, number: signal.Signals = signal.SIGKILL) -> None:
        """Send one process a signal."""
        os.kill(self.child(name), number)

    def left(self) -> dict[int, str]:
        """Processes of this run that live, the command itself not counted."""
        return {pid: command for pid, command in with_mark(str(self.temporary)).items() if pid != self.process.pid}

    def end(self, limit: float = LIMIT) -> Done:
        """Wait for the command to end by itself."""
        try:
            out, err = self.process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            pytest.fail(f"the command did not end within {limit:g} s")
        return Done(self.process.returncode, out, err)

    def nothing_left(self) -> None:
        """No process and no brief, key or password is left behind."""
        wait_until(lambda: not self.left(), "no process left of the run", 10.0)
        assert list(self.temporary.iterdir()) == []

    @property
    def results(self) -> Results:
        """What is on disk."""
        return load_results(self.folder)


@dataclass(frozen=True)
class Evedrop:
    """Starts the command in a folder of its own."""

    folder: Path

    @property
    def temporary(self) -> Path:
        """Where the command and its children put what is temporary; the mark by which they are found."""
        folder = self.folder / "temporary"
        folder.mkdir(exist_ok=True)
        return folder

    @property
    def environment(self) -> dict[str, str]:
        """What the command is started with."""
        return {**os.environ, "TMPDIR": str(self.temporary), "COLUMNS": "160"}

    def _start(self, arguments: tuple[str, ...], options: Mapping[str, Any]) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "emulator", *arguments],
            **{
                "cwd": self.folder,
                "stdin": subprocess.DEVNULL,
                "stdout": subprocess.PIPE,
                "stderr": subprocess.PIPE,
                "text": True,
                "env": self.environment,
                **options,
            },
        )

    def __call__(self, *arguments: str, **options: Any) -> Done:
        """Run a command to its end."""
        return Live(self._start(arguments, options), self.temporary, self.folder).end()

    def live(self, scenario: str, *arguments: str, out: str = "run", **options: Any) -> Live:
        """Start a live run without a view."""
        every = ("run", scenario, "--view", "off", "--out", out, *arguments)
        return Live(self._start(every, options), self.temporary, self.folder / out)


@pytest.fixture
def evedrop(tmp_path: Path) -> Iterator[Evedrop]:
    """The command, in a new folder; what a failed test leaves running is ended."""
    yield Evedrop(tmp_path)
    for pid in with_mark(str(tmp_path / "temporary")):
        os.kill(pid, signal.SIGKILL)
