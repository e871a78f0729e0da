"""Processes that draw and hang: the command ends with a sentence."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from evedrop.errors import RunError
from evedrop.show.view import picture, video
from evedrop.show.view.picture import ended, give, received

HANGS = [sys.executable, "-c", "import time; time.sleep(3600)"]


@pytest.fixture
def process() -> Iterator[subprocess.Popen[bytes]]:
    """One that gives back what it gets."""
    with subprocess.Popen(["cat"], bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as cat:
        yield cat
        cat.kill()


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit is over soon, and what draws a recording hangs."""
    monkeypatch.setattr(picture, "DRAWING_SECONDS", 0.1)
    for module in (picture, video):
        monkeypatch.setattr(module, "guarded", lambda *_, **__: HANGS)
    monkeypatch.setattr(picture, "check", lambda _: None)


def test_bytes_go_through(process: subprocess.Popen[bytes]) -> None:
    """As many as are asked for, and fewer at the end."""
    assert process.stdin is not None
    assert process.stdout is not None
    give(process.stdin, bytes(50_000))
    assert received(process.stdout, 40_000) == bytes(40_000)
    process.stdin.close()
    assert received(process.stdout, 40_000) == bytes(10_000)
    assert ended(process) == 0


@pytest.mark.usefixtures("short")
def test_a_picture_whose_process_hangs_ends(tmp_path: Path) -> None:
    """With status 3, and without a file."""
    with pytest.raises(RunError, match=r"the process that draws drew nothing for 0.1 s, and was ended"):
        picture.picture_apart(tmp_path / "r.rrd", tmp_path / "r.png")
    assert [*tmp_path.iterdir()] == []


@pytest.mark.usefixtures("short")
def test_a_video_whose_encoder_hangs_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While it gets pictures, and at its end."""
    monkeypatch.setattr(video, "ffmpeg", lambda: "ffmpeg")
    file = video.Mp4File(tmp_path / "r.mp4", 15.0)
    try:
        with pytest.raises(RunError, match="took no further picture"):
            file.add(bytes(10**6))
        with pytest.raises(RunError, match="did not end"):
            file.finish()
    finally:
        file.stop()
