"""The progress line of a run, as a terminal shows it."""

from __future__ import annotations

import io
import sys

import pytest

from evedrop.cli.progress_line import ProgressLine
from evedrop.news import Held


class Terminal(io.StringIO):
    """What was written to a terminal."""

    def isatty(self) -> bool:
        """It is one."""
        return True


def test_a_held_run_shows_how_far_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if it is held before its first progress is told, as after a short step."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with ProgressLine(50, "slots") as line:
        line.tell(Held(20))
    assert "held before slot 20" in terminal.getvalue()
    assert "20/50" in terminal.getvalue()
