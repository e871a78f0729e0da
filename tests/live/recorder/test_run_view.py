"""What the recorder shows of a run."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from evedrop.live.recorder.run_view import RunView
from evedrop.scenario.loading import load
from evedrop.show.view.recording import ViewRecording


@pytest.fixture(autouse=True)
def usual() -> Iterator[float]:
    """How long a thread has the interpreter, which an open view changes; it is as before afterwards."""
    usual = sys.getswitchinterval()
    yield usual
    sys.setswitchinterval(usual)


def test_the_thread_of_a_view_lets_the_others_go_on(tmp_path: Path, usual: float) -> None:
    """It gives the interpreter to the threads that take messages much sooner than Python's default says."""
    view = RunView()
    view.open(load("eavesdroppers"), "run", tmp_path / "recording.rrd")
    assert sys.getswitchinterval() <= usual / 10
    assert view.close()


def test_only_a_recording_that_failed_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would be shown ever after as that of the whole run."""
    path = tmp_path / "recording.rrd"
    view = RunView()
    view.open(load("eavesdroppers"), "run", path)
    assert view.close()
    view.remove_incomplete(path)
    assert path.is_file()

    def full(_: ViewRecording) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(ViewRecording, "_finish", full)
    view = RunView()
    view.open(load("eavesdroppers"), "run", path)
    view.close()
    view.remove_incomplete(path)
    assert not path.exists()
