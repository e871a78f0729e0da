"""The progress line of a run, as a terminal shows it."""

from __future__ import annotations

import sys

import pytest
from rich.cells import cell_len
from rich.text import Text

from evedrop.cli.console import ProgressLine
from evedrop.scenario.progress_events import Held, RunProgress, Started
from tests.cli.terminal import Terminal


def test_a_held_run_shows_how_far_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if it is held before its first progress is told, as after a short step."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with ProgressLine(50, "slots") as line:
        line.on_event(Held(20))
    assert "held before slot 20" in terminal.getvalue()
    assert "20/50" in terminal.getvalue()


def test_a_study_shows_no_total_before_it_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sweep counts its points while the line is already there."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with ProgressLine(None, "trial-slots") as line:
        line.on_event(Started())
        before = terminal.getvalue()
        line.on_event(RunProgress(5, 1.0, "trial-slots/s", {}, 20))
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
        line.on_event(Started())
        line.on_event(RunProgress(500_000, 123_456.0, "trial-slots/s", {"legitimate": 0.5, "smart": 2.0}))
    last = terminal.getvalue().split("500000/2000000")[-1]
    assert "trial-slots" in last
    assert "left" in last
    assert "123,456" not in terminal.getvalue()
    assert "…" not in terminal.getvalue()


ERRORS = {"legitimate": 0.0081, "naive": 3.2e2, "suspicious": 0.61, "smart": 0.0234}


@pytest.mark.parametrize("columns", [40, 60, 80, 100, 120, 200])
@pytest.mark.parametrize("unit", ["slots", "trial-slots"])
def test_slots_and_the_time_left_fit_every_width(monkeypatch: pytest.MonkeyPatch, columns: int, unit: str) -> None:
    """Of a long study too, with many receivers; an error that is only rounding is 0."""
    errors = {"legitimate": 8e-31, **{f"eavesdropper-{i}": 10.0**i for i in range(8)}}
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", str(columns))
    with ProgressLine(200_000_000, unit) as line:
        line.on_event(RunProgress(50_000_000, 12_345_678.0, f"{unit}/s", errors))
        line.on_event(RunProgress(123_456_789, 12_345_678.0, f"{unit}/s", errors))
    written = [line for line in Text.from_ansi(terminal.getvalue()).plain.splitlines() if "123456789" in line]
    assert written
    assert all(cell_len(line) <= columns for line in written)
    assert all("123456789/200000000" in line and " left" in line for line in written)
    assert columns < 200 or all("legitimate 0 " in line for line in written), written
    assert "e-31" not in terminal.getvalue()


@pytest.mark.parametrize(
    ("columns", "shown", "cut"),
    [
        (40, "2999/3000 slots 00:0", True),
        (60, "running 2999/3000 slots 00:0", True),
        (80, "running 2999/3000 slots 00:0", True),
        (100, "running 2999/3000 slots 00:0", True),
        (140, "running 2999/3000 slots 00:0", False),
    ],
)
def test_the_errors_never_hide_how_far_a_run_is(
    monkeypatch: pytest.MonkeyPatch, columns: int, shown: str, cut: bool
) -> None:
    """A terminal shows the slots, the rate and the time left on one line, and the errors of the receivers that still fit."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("NO_COLOR", "1")
    with ProgressLine(3000, "slots") as line:
        line.on_event(Started())
        line.on_event(RunProgress(10, 43.0, "slots/s", ERRORS))
        line.on_event(RunProgress(2999, 43.0, "slots/s", ERRORS))
    written = Text.from_ansi(terminal.getvalue()).plain.splitlines()
    assert all(cell_len(line) <= columns for line in written)
    assert not any(line.strip() in {"left", "slots"} for line in written), "nothing goes on in a second line"
    last = [line for line in written if "2999/3000" in line][-1]
    assert shown in last
    assert " left" in last
    assert ("smart" not in last) is cut
    assert ("legitimate 0.0081  …" in last) is (columns == 80), last


def test_a_held_run_on_a_narrow_terminal_says_that_it_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 40 columns too; and it guesses no time left."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "40")
    with ProgressLine(400, "slots") as line:
        line.on_event(RunProgress(100, 43.0, "slots/s", ERRORS))
        line.on_event(Held(120))
    last = [line for line in Text.from_ansi(terminal.getvalue()).plain.splitlines() if "held before" in line][-1]
    assert "held before slot 120 120/400 slots" in last
    assert "left" not in last
