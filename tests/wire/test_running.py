"""A wire in a process of its own, opened from Python."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from evedrop.errors import UsageError
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
