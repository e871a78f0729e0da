"""Evedrop as its users type it: in this process or in one of its own, each test in a temporary folder of its own.

Nothing here or in the tests is decided by time: they wait for what they need, and a limit only bounds a failure.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from evedrop import preloaded
from evedrop.cli import main as cli
from evedrop.model.kernels import choice
from evedrop.names import KERNELS_VARIABLE
from evedrop.results.reading import Results
from tests.commands import LARGEST_FILE, NEWS, TELLING, CommandProcess, ForkedCommand
from tests.examples import register_profiles
from tests.golden.pages import golden
from tests.privileged import say_what_was_skipped

__all__ = ["golden"]

FORKABLE = frozenset({"env", "cwd", "start_new_session", "stdout", "umask"})
"""The options of Popen that a forked command can have, too; it has a session of its own in any case."""
LIMIT = 300.0
"""Seconds after which a test gives up waiting for a condition: far more than a machine with a load of 40 needs."""

register_profiles()

# Where no C compiler worked, every run begins with a warning, which most tests do not expect: ask for numpy, as users can.
if choice.KERNELS == choice.FALLBACK:
    os.environ[KERNELS_VARIABLE] = choice.KERNELS = "numpy"

# `nohup make test`, and a job in the background of a script, ignore these; the commands that tests start would too.
if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection() -> Iterator[None]:
    """Collect without the garbage collector: it finds nothing, and takes a third of the time. Nor does it look there later."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.freeze()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> Iterator[None]:
    """The last lines say what this machine could not test."""
    yield
    say_what_was_skipped(terminalreporter)


def wait_until(condition: Callable[[], Any], awaited: str | Callable[[], str], limit: float = LIMIT) -> Any:
    """The first true value of a condition; fails the test if it stays false for this number of seconds.

    what: the condition in words, or a function that gives them, with what is known by then.

    It sleeps longer between looks that take long, for what it waits for needs a processor, too.
    """
    deadline = time.monotonic() + limit
    while True:
        began = time.monotonic()
        if result := condition():
            return result
        looked = time.monotonic()
        if looked > deadline:
            pytest.fail(f"within {limit:g} s: {awaited if isinstance(awaited, str) else awaited()}")
        time.sleep(min(0.1, max(0.01, 4 * (looked - began))))


def with_mark(mark: str) -> dict[int, str]:
    """Process id → command line of every living process whose command line or environment has `mark` in it."""
    commands = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            command, environment = (folder / "cmdline").read_bytes(), (folder / "environ").read_bytes()
            state = (folder / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue
        if mark.encode() in command + environment and state != "Z" and int(folder.name) != os.getpid():
            commands[int(folder.name)] = command.replace(b"\0", b" ").decode(errors="replace")
    return commands


@dataclass(frozen=True)
class Done:
    """A command that ended."""

    status: int
    out: str
    err: str

    @property
    def summary(self) -> dict[str, Any]:
        """What --json printed: one object and nothing else."""
        summary: dict[str, Any] = json.loads(self.out)
        return summary


def cause_of(ended: str) -> str:
    """Why a run ended, by its summary, without the moment of its metrics, which a killed recorder's summary may add."""
    return re.sub(r" \(the metrics are as of [^)]*\)", "", ended)


class Live:
    """A command that runs, its children, and what it leaves behind."""

    def __init__(self, process: CommandProcess, temporary: Path, folder: Path, news: Path | None = None) -> None:
        self.process = process
        self.temporary = temporary
        self.folder = folder
        self._news = news

    def briefs(self) -> dict[str, Path]:
        """Process name → the brief it was given, as far as they are written."""
        return {path.stem: path for path in self.temporary.glob("evedrop-*/*.json")}

    def children(self) -> dict[str, int]:
        """Process name → process id."""
        children: dict[str, int] = {}
        for pid, command in with_mark(str(self.temporary)).items():
            words = command.split()
            if pid != self.process.pid and words and words[-1].endswith(".json"):
                name = Path(words[-1]).stem
                # A process that has just forked, to start another program, is there twice: the first is itself.
                children[name] = min(pid, children.get(name, pid))
        return children

    def child(self, name: str) -> int:
        """The process id of one process, as soon as it is there."""
        pid: int = wait_until(lambda: self.children().get(name), f"a process {name}")
        return pid

    def done(self) -> int:
        """How much it says it has done, in the unit of its progress line: slots of a run, trial-slots of a study."""
        return max((int(line.split()[0]) for line in self._told()), default=0)

    def told(self, event: str) -> int:
        """How often it has told of an event."""
        return sum(line.split()[1] == event for line in self._told())

    def _told(self) -> list[str]:
        if self._news is None or not self._news.exists():
            return []
        return self._news.read_text().rpartition("\n")[0].splitlines()  # the last line may be half written

    def held(self) -> None:
        """Wait until a run that begins paused is held before its first slot, and can be steered."""
        wait_until(lambda: self.told("held") or self.process.poll() is not None, "a run that is held")
        assert self.process.poll() is None, "the run must not end before it is steered"

    def running(self, more_than: int = 0) -> None:
        """Wait until it says that more than so much is done: what it measured is more than nothing."""
        wait_until(lambda: self.done() > more_than or self.process.poll() is not None, "a run under way")
        assert self.process.poll() is None, "the run must not end before it is disturbed"

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
        return Done(self.process.wait(), out, err)

    def nothing_left(self) -> None:
        """No process and no brief, key or password is left behind."""
        wait_until(lambda: not self.left(), "no process left of the run")
        assert list(self.temporary.iterdir()) == []

    @property
    def results(self) -> Results:
        """What is on disk."""
        return Results.read(self.folder)


@dataclass(frozen=True)
class Evedrop:
    """The command, typed in a folder of its own."""

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

    def start(
        self, command: list[str], arguments: tuple[str, ...], options: Mapping[str, Any]
    ) -> subprocess.Popen[str]:
        """Start Python with this command."""
        return subprocess.Popen(
            [sys.executable, *command, *arguments],
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

    def __call__(self, *arguments: str) -> Done:
        """Type a command and wait for its end. It runs in this process: most of a short one's time goes into imports.

        A process of a run does not: a signal would end it at once, and so this one.
        """
        if cli.is_role(arguments):
            return self.process(*arguments)
        with (
            contextlib.chdir(self.folder),
            patch.dict(os.environ, self.environment),
            patch.object(tempfile, "tempdir", None),
            open(os.devnull) as nothing,
            patch.object(sys, "stdin", nothing),
            tempfile.TemporaryFile("w+", encoding="utf-8", dir=self.folder) as out,
            tempfile.TemporaryFile("w+", encoding="utf-8", dir=self.folder) as err,
        ):
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                status = cli.main(arguments)
            texts = []
            for file in (out, err):
                file.seek(0)
                texts.append(file.read())
        return Done(status, *texts)

    def process(self, *arguments: str, **options: Any) -> Done:
        """The same in a process of its own; options are those of Popen."""
        if options.keys() <= FORKABLE:
            return Live(self._forked(arguments, self.environment, options), self.temporary, self.folder).end()
        return self.begun(*arguments, **options).end()

    def _forked(
        self, arguments: tuple[str, ...], environment: dict[str, str], options: Mapping[str, Any]
    ) -> ForkedCommand:
        folder = options.get("cwd", self.folder)
        return ForkedCommand(
            arguments, options.get("env", environment), folder, options.get("stdout"), options.get("umask")
        )

    def begun(self, *arguments: str, **options: Any) -> Live:
        """The same in a new interpreter, without waiting for its end."""
        return Live(self.start(["-m", "evedrop"], arguments, options), self.temporary, self.folder)

    def started(
        self, *arguments: str, out: str = "run", largest_file: int = 0, interpreter: bool = False, **options: Any
    ) -> Live:
        """Start a command in a process of its own, to be followed and disturbed.

        largest_file: in bytes; 0: no limit. The process is forked from one that has made the imports, unless `interpreter` or
        other options of Popen than those in FORKABLE ask for an interpreter of its own.
        """
        news = self.folder / f"{out.replace('/', '-')}.news"
        words = (*arguments, "--out", out)
        options["env"] = {**options.get("env", self.environment), NEWS: str(news), LARGEST_FILE: str(largest_file)}
        if interpreter or options.keys() - FORKABLE:
            process: CommandProcess = self.start(["-P", str(TELLING)], words, options)
        else:
            process = self._forked(words, self.environment, options)
        return Live(process, self.temporary, self.folder / out, news)

    def live(self, scenario: str, *arguments: str, **options: Any) -> Live:
        """Start a live run without a view."""
        return self.started("run", scenario, "--view", "off", *arguments, **options)


@pytest.fixture(scope="session", autouse=True)
def imports_once() -> Iterator[None]:
    """The live runs that tests start from this process need not make their imports again."""
    with preloaded():
        yield


@pytest.fixture
def evedrop(tmp_path: Path) -> Iterator[Evedrop]:
    """The command, in a new folder; what a failed test leaves running is ended."""
    yield Evedrop(tmp_path)
    for pid in with_mark(str(tmp_path / "temporary")):
        os.kill(pid, signal.SIGKILL)
