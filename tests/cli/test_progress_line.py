"""The progress line of a run, as a terminal shows it."""

from __future__ import annotations

import io
import sys

import pytest

from evedrop.cli.progress_line import ProgressLine
from evedrop.news import Held, RunProgress, Started


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


def test_a_study_shows_no_total_before_it_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sweep counts its points while the line is already there."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with ProgressLine(None, "trial-slots") as line:
        line.tell(Started())
        before = terminal.getvalue()
        line.tell(RunProgress(5, 1.0, "trial-slots/s", {}, 20))
    assert "0/0" not in terminal.getvalue()
    assert ("0/?" in before, "left" in before) == (True, False)
    assert "5/20" in terminal.getvalue().removeprefix(before)
    assert "left" in terminal.getvalue().removeprefix(before)


def test_a_narrow_terminal_shows_what_is_done_and_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 40 columns the speed and the errors are left out, and nothing is cut off."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "40")
    with ProgressLine(2_000_000, "trial-slots") as line:
        line.tell(Started())
        line.tell(RunProgress(500_000, 123_456.0, "trial-slots/s", {"legitimate": 0.5, "smart": 2.0}))
    last = terminal.getvalue().split("500000/2000000")[-1]
    assert "trial-slots" in last
    assert "left" in last
    assert "123,456" not in terminal.getvalue()
    assert "…" not in terminal.getvalue()
