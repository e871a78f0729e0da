"""A wire in a process of its own, opened from Python."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np
import pytest

from evedrop.cli.pytest_plugin import _opening
from evedrop.errors import EvedropError, RunError, ScenarioError, UsageError
from evedrop.live.network.operator import Answer
from evedrop.wire import running
from evedrop.wire.file import wire_of
from evedrop.wire.running import RunningWire, wire
from evedrop.wire.tables import seconds_of

PLAN = wire_of(
    {
        "side": {"robot": {"listen": "tcp/127.0.0.1:17501"}, "base": {"listen": "tcp/127.0.0.1:17502"}},
        "link": [{"name": "radio", "from": "robot", "to": "base", "quality": 0.5}],
    }
)


def test_a_file_that_cannot_be_written_keeps_the_wire_from_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a full disk; nothing is left behind."""
    folders: list[Path] = []

    def full(path: Path, _: str) -> None:
        folders.append(path.parent)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(running, "write_private", full)
    with pytest.raises(UsageError, match=r"cannot write the wire's file \(No space left on device\); set TMPDIR"):
        RunningWire(PLAN, tmp_path).__enter__()
    assert [folder.exists() for folder in folders] == [False]


def test_a_wire_that_is_refused_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is wrong with it."""
    monkeypatch.chdir(tmp_path)
    link = [{"from": "robot", "to": "base", "quality": 0.5}]
    for wrong in ({"seconds": "long"}, {"seconds": -1.0}, {"sides": 3}):
        with pytest.raises((UsageError, ScenarioError)):
            wire(side=["robot", "base"], link=link, **wrong)
    assert not [*tmp_path.iterdir()]


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[subprocess.Popen[str]]]:
    """Let wires be processes that begin for ever; gives those that were started."""
    processes: list[subprocess.Popen[str]] = []

    def start(*_: str) -> subprocess.Popen[str]:
        processes.append(program("import time; time.sleep(600)"))
        return processes[-1]

    monkeypatch.setattr(running, "_started", start)
    yield processes
    for process in processes:
        with process:
            process.kill()


def program(code: str) -> subprocess.Popen[str]:
    """A process with this program, in place of a wire."""
    return subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize(
    ("errors", "status", "error", "message"),
    [
        (["warning: a", "scam is no link", "  (or is it?)"], 2, UsageError, "^scam is no link\\n  \\(or is it\\?\\)$"),
        (["warning: a", "warning: b"], 4, RunError, "ended with status 4; warning: a; warning: b$"),
        ([], 4, RunError, "ended with status 4$"),
    ],
)
def test_a_warning_is_not_the_reason_of_a_failure(
    errors: list[str], status: int, error: type[Exception], message: str, tmp_path: Path
) -> None:
    """It follows only where there is no other one."""
    lines = "".join(f"{'' if line.startswith(' ') else 'evedrop: '}{line}\n" for line in errors)
    code = f"import sys; sys.stderr.write({lines!r}); sys.exit({status})"
    with pytest.raises(error, match=message):
        RunningWire(PLAN, tmp_path, start=lambda *_: program(code)).__enter__()


def test_ctrl_c_while_a_wire_begins_ends_it(
    started: list[subprocess.Popen[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing else would: `__exit__` is not called."""

    def interrupted(_: RunningWire) -> NoReturn:
        raise KeyboardInterrupt

    monkeypatch.setattr(RunningWire, "status", interrupted)
    with pytest.raises(KeyboardInterrupt):
        RunningWire(PLAN, tmp_path).__enter__()
    assert [process.poll() for process in started] == [-signal.SIGTERM]


def test_a_wire_that_nobody_could_listen_to_is_ended(
    started: list[subprocess.Popen[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the machine lacks threads."""

    def lacking(_: threading.Thread) -> NoReturn:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", lacking)
    with pytest.raises(RuntimeError, match="can't start new thread"):
        RunningWire(PLAN, tmp_path).__enter__()
    assert [process.poll() for process in started] == [-signal.SIGTERM]


def test_results_are_where_the_program_was_when_it_made_the_wire(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Although it changes its folder later."""
    monkeypatch.chdir(tmp_path)
    wire = RunningWire(PLAN, Path("wire"))
    monkeypatch.chdir("/")
    assert wire.folder == tmp_path / "wire"


def test_results_of_a_test_are_where_pytest_was_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Although it changes its folder before it has a wire, or before it opens one."""
    for name in ("elsewhere", "there"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    options = SimpleNamespace(evedrop_out=Path("art"))
    config = SimpleNamespace(option=options, invocation_params=SimpleNamespace(dir=tmp_path))
    node = SimpleNamespace(name="test_a", user_properties=[])
    made: Callable[..., Any] = lambda **entries: RunningWire(PLAN, entries["out"])  # noqa: E731 - with its type
    request: Any = SimpleNamespace(config=config, node=node)
    opened = _opening(request, tmp_path, made)
    monkeypatch.chdir(tmp_path / "there")
    folder = tmp_path / "art" / "test_a" / "wire-1"
    assert opened().folder == folder
    assert folder.parent.is_dir()
    assert node.user_properties == [("evedrop_results", str(folder))]


def test_a_state_that_is_refused_is_not_that_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As one that is too large to be sent."""
    monkeypatch.setattr(RunningWire, "_ask", lambda *_: Answer(refused=("the answer has 2 GB",)))
    with pytest.raises(UsageError, match=r"^the answer has 2 GB$"):
        RunningWire(PLAN, tmp_path).status()


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        ("20 ms", "0.02 s"),
        ("2 h", "7200.0 s"),
        (np.int64(60), "60.0 s"),
        (123456.75, "123456.75 s"),
        (1e6, "1000000.0 s"),
    ],
)
def test_a_wire_lasts_as_long_as_it_is_told(seconds: Any, words: str, tmp_path: Path) -> None:
    """A number, or a text with a unit; not a rounded one."""
    commands: list[tuple[str, ...]] = []

    def start(*command: str) -> NoReturn:
        commands.append(command)
        raise EvedropError

    with pytest.raises(EvedropError):
        RunningWire(PLAN, tmp_path, seconds, start).__enter__()
    assert words in commands[0]
    assert seconds_of(words, "--for") == seconds_of(str(seconds), "--for")
