"""What the recorder shows of a run."""

from __future__ import annotations

import sys
from pathlib import Path

from evedrop.live.recorder.run_view import RunView
from evedrop.scenario.loading import load


def test_the_thread_of_a_view_lets_the_others_go_on(tmp_path: Path) -> None:
    """It gives the interpreter to the threads that take messages much sooner than Python's default says."""
    view, usual = RunView(), sys.getswitchinterval()
    try:
        view.open(load("eavesdroppers"), "run", tmp_path / "recording.rrd")
        assert sys.getswitchinterval() <= usual / 10
        assert view.close()
    finally:
        sys.setswitchinterval(usual)
