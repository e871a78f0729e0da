"""The file whose age says whether a process is on its network."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from evedrop.live.network import connection
from evedrop.live.network.connection import VARIABLE, HeartbeatFile
from tests.conftest import wait_until


def test_the_file_is_touched_as_long_as_there_is_a_connection(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not before, not while it is lost, and not when the process has left."""
    file, connected, looks = tmp_path / "heartbeat", [False], []

    def look() -> bool:
        looks.append(connected[0])
        return connected[0]

    def look_again(times: int = 3) -> None:
        seen = len(looks)
        wait_until(lambda: len(looks) > seen + times, "more looks at the connection")

    monkeypatch.setenv(VARIABLE, str(file))
    monkeypatch.setattr(connection, "_BEAT_SECONDS", 0.001)
    heart = HeartbeatFile(look)
    heart.start()
    look_again()
    assert not file.exists()
    connected[0] = True
    wait_until(file.exists, "a heartbeat")
    os.utime(file, (1, 1))
    wait_until(lambda: file.stat().st_mtime > 1, "another one")
    connected[0] = False
    look_again()
    os.utime(file, (1, 1))
    look_again()
    assert file.stat().st_mtime == 1
    connected[0] = True
    heart.stop()
    os.utime(file, (1, 1))
    seen = len(looks)
    assert file.stat().st_mtime == 1
    assert len(looks) == seen


def test_a_file_that_cannot_be_written_ends_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process goes on, and looks again."""
    looks: list[None] = []

    def look() -> bool:
        looks.append(None)
        return True

    monkeypatch.setenv(VARIABLE, str(tmp_path / "nowhere" / "heartbeat"))
    monkeypatch.setattr(connection, "_BEAT_SECONDS", 0.001)
    heart = HeartbeatFile(look)
    heart.start()
    wait_until(lambda: len(looks) > 3, "more looks at the connection")
    heart.stop()


def test_without_a_file_nobody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Outside containers there is neither a file nor a thread."""
    monkeypatch.delenv(VARIABLE, raising=False)

    def look() -> bool:
        raise AssertionError("nobody asked")

    heart = HeartbeatFile(look)
    heart.start()
    heart.stop()
