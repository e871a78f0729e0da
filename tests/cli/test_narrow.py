"""What fits a terminal: tables, sentences and colours at each width, in a pipe, with NO_COLOR and without TERM."""

from __future__ import annotations

import io
import re
import sys
from collections import Counter
from contextlib import redirect_stdout
from typing import Any

import pytest
from rich.cells import cell_len
from rich.console import Console

from evedrop.cli.console import ProgressLine
from evedrop.cli.main import main
from evedrop.cli.parser import name_lines
from evedrop.cli.report import terminal
from evedrop.model.metrics.text import estimate
from evedrop.scenario.progress_events import RunProgress
from evedrop.show.report.text_table import TextTable
from evedrop.show.terminal_tables import fitted
from evedrop.system.output import YELLOW, say, standard_streams
from tests.cli.terminal import Terminal


def table() -> TextTable:
    """Two rows, of which the second repeats the first cell."""
    made = TextTable.headed(["scheme", "adversary"], ["its error", "ratio"], title="A comparison", least=["its error"])
    made.add("innovation", "bayesian", estimate(0.123, 0.004), estimate(1.2e5, 3e3))
    made.add("", "naive", estimate(56.7, 8.9), "")
    return made


def shown(columns: int, **how: Any) -> list[str]:
    """The lines of a terminal of this width."""
    out = io.StringIO()
    console = Console(file=out, width=columns)
    console.print(fitted(table(), console, **how))
    return [line.rstrip() for line in out.getvalue().splitlines()]


def test_columns_are_as_wide_as_their_characters_are_spelled() -> None:
    """In an encoding that lacks them: every column begins at the same place in all lines."""
    made = TextTable.headed(["receiver"], ["tr P̂ ≥ …", "z"])
    made.add("a", estimate(0.123, 0.004), "1.0")
    made.add("bb", "–", "–20.5")
    out = io.BytesIO()
    stream = io.TextIOWrapper(out, encoding="ascii")
    with redirect_stdout(stream), standard_streams():
        terminal().show(made)
    lines = [line for line in out.getvalue().decode().splitlines() if line.strip()]
    stream.close()
    assert "tr P_hat >= ..." in lines[1]
    assert len({len(line) for line in lines}) == 1


WIDTHS = [40, 60, 80, 100, 120, 200]


def test_a_table_leaves_out_standard_errors_then_columns() -> None:
    """First those that matter least, then from the right; it says which, and keeps every row on one line."""
    assert "± 0.004" in "".join(shown(80))
    assert [line.split() for line in shown(60)[2:]] == [
        ["scheme", "adversary", "its", "error", "ratio"],
        ["─" * 55],
        ["innovation", "bayesian", "0.123", "±", "0.004", "1.20e5", "±", "3e3"],
        ["naive", "57", "±", "9"],
        [],
    ]
    assert [line.split() for line in shown(44)[2:]][2:4] == [
        ["innovation", "bayesian", "0.123", "1.20e5"],
        ["naive", "57"],
    ]
    assert shown(44)[-1] == "no room for: ± standard errors"
    assert " ".join(shown(34)[-2:]) == "no room for: ± standard errors, its error"
    assert " ".join(shown(25)[-3:]).strip() == "no room for: ± standard errors, its error, ratio"
    assert "innovation" in "".join(shown(25))


def test_a_table_that_cannot_fit_breaks_its_cells() -> None:
    """None of their letters is lost."""
    narrow = shown(14)
    assert max(map(cell_len, narrow)) <= 14
    assert Counter("".join(narrow)) >= Counter("innovationbayesian")


@pytest.mark.parametrize("columns", WIDTHS)
def test_no_table_is_wider_than_the_terminal_or_cut(columns: int) -> None:
    """At each width, and with every form of the head."""
    for how in ({}, {"tight": True}, {"heads": "short"}, {"sections": True, "tight": True}):
        lines = shown(columns, **how)
        assert max(map(cell_len, lines)) <= columns
        assert "…" not in "".join(lines)


def test_a_table_stays_a_table_as_long_as_it_fits() -> None:
    """Nothing is left out on a terminal that is as wide as its widest line."""
    wide = max(map(len, shown(200, tight=True))) + 1  # for the space at the end of each line
    assert "no room" not in "".join(shown(wide, tight=True))
    assert "± 3e3" in "".join(shown(wide))


@pytest.mark.parametrize("columns", WIDTHS)
def test_sentences_are_wrapped_between_words(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a terminal; a path stays whole, and a command can be typed as it is shown."""
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", str(columns))
    path = "/a/folder/of/results/with/a/name/that/is/longer/than/a/line"
    sentence = "its error grew beyond all bounds, while the legitimate estimator's x̂ stayed where the state was; " * 2
    command = (
        f"    see it again: evedrop run {path} --set 'expect=[ 1, 2 ]' --set legitimate.link.quality=0.5 --trials 1"
    )
    console = terminal()
    with console.capture() as caught:
        console.say(f"{sentence}{path}")
    lines = caught.get().splitlines()
    assert " ".join(caught.get().split()) == f"{sentence}{path}"
    assert all(cell_len(line) <= columns for line in lines if path not in line)
    with console.capture() as caught:
        console.command(command)
    assert "".join(caught.get().split("\\\n")).split() == command.split()
    assert "'expect=[ 1, 2 ]'" in caught.get()
    assert all(cell_len(line) <= columns for line in caught.get().splitlines() if path not in line)


def test_a_sentence_is_one_line_in_a_pipe() -> None:
    """However long it is, so that grep and diff see it whole."""
    console = terminal()
    with console.capture() as caught:
        console.say("word " * 100)
    assert caught.get().count("\n") == 1


@pytest.mark.parametrize(
    ("on_terminal", "environment", "red"),
    [
        (True, {"TERM": "xterm-256color"}, True),
        (True, {"TERM": "xterm-256color", "NO_COLOR": "1"}, False),
        (True, {"TERM": "dumb"}, False),
        (True, {"TERM": ""}, False),
        (True, {}, False),
        (False, {"TERM": "xterm-256color"}, False),
    ],
    ids=["terminal", "NO_COLOR", "dumb", "empty TERM", "no TERM", "pipe"],
)
def test_failures_are_red_where_there_are_colours(
    on_terminal: bool, environment: dict[str, str], red: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a terminal that knows colours, unless NO_COLOR is set; elsewhere there is not one escape sequence, in tables neither."""
    for name in ("TERM", "NO_COLOR", "COLORTERM", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    out, err = (Terminal() if on_terminal else io.StringIO() for _ in range(2))
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", err)
    terminal().say("the expectation FAILED")
    made = TextTable.headed(["receiver", "verdict"], [])
    made.add("smart", "✗ broken")
    terminal().show(made)
    say("warning: this is slow", "warning:", YELLOW)
    assert ("\x1b[1;31mFAILED" in out.getvalue()) is red
    assert ("\x1b[1;31m✗" in out.getvalue()) is red
    assert ("\x1b[33mwarning:" in err.getvalue()) is red
    coloured = re.search(r"\x1b\[[0-9;]*3[0-9]", out.getvalue() + err.getvalue())
    assert (coloured is not None) is red
    assert red or "NO_COLOR" in environment or "\x1b" not in out.getvalue() + err.getvalue()


@pytest.mark.parametrize("term", ["dumb", ""])
def test_the_progress_line_is_not_for_a_terminal_that_cannot_move_its_cursor(
    term: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is written there."""
    err = Terminal()
    monkeypatch.setattr(sys, "stderr", err)
    monkeypatch.setenv("TERM", term)
    with ProgressLine(50, "slots") as line:
        line.on_event(RunProgress(10, 43.0, "slots/s", {"legitimate": 0.5}))
    assert err.getvalue().strip() == ""


def test_names_and_descriptions_fit_a_narrow_terminal() -> None:
    """A description is wrapped beside its name, or below it where there is no room; none of its words is lost."""
    described = {"one": "a description of several words", "two": "short"}
    assert list(name_lines(described, 5, 30)) == [
        "one  a description of several",
        "     words",
        "two  short",
    ]
    assert list(name_lines(described, 5, 24)) == [
        "one",
        "    a description of",
        "    several words",
        "two",
        "    short",
    ]
    assert next(name_lines(described, 5, 3)) == "one"  # however narrow it is


@pytest.mark.parametrize("command", [["list"], ["docs"], ["paper"]])
def test_lists_fit_a_narrow_terminal(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a terminal, no line is wider than it; elsewhere each entry has one line."""
    assert main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "40")
    assert main(command) == 0
    narrow = capsys.readouterr().out
    assert max(map(len, lines)) > 40 >= max(map(len, narrow.splitlines()))
    narrow, _, advice = narrow.partition("\nnext, ")
    assert "evedrop" in advice
    assert "".join(narrow.split()) == "".join("".join(lines).split())


def test_a_head_may_be_wrapped() -> None:
    """A table fits if its cells and the words of its heads do; no head is cut."""
    made = TextTable.headed(["receiver"], ["encoding.state_probability"], ["mean squared error of all trials"])
    made.add("smart", "0.5", "0.5 ± 0.1")
    out = io.StringIO()
    console = Console(file=out, width=40)
    console.print(fitted(made, console))
    assert "no room" not in out.getvalue()
    words = {"encoding.", "state_", "probability", "mean", "squared", "error", "of", "all", "trials"}
    assert words <= set(out.getvalue().split())
