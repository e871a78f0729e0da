"""A wire in a process of its own, opened from Python."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from evedrop.errors import RunError, UsageError
from evedrop.wire import running
from evedrop.wire.file import wire_of
from evedrop.wire.running import RunningWire

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
