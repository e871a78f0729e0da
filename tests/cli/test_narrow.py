"""Tables on narrow terminals: nothing is cut off."""

from __future__ import annotations

import io
import sys

import pytest
from rich.console import Console
from rich.table import Table

from evedrop.cli.main import main
from evedrop.cli.names import name_lines
from evedrop.cli.narrow import fitted
from evedrop.cli.report import terminal


def table() -> Table:
    """Two rows, of which the second repeats the first cell."""
    made = Table(title="A comparison")
    for head in ("scheme", "adversary", "its error", "ratio"):
        made.add_column(head, no_wrap=True)
    made.add_row("innovation", "bayesian", "0.123 ± 0.004", "1.2e+05 ± 3e+03")
    made.add_row("", "naive", "56.7 ± 8.9", "")
    return made


def said(columns: int) -> list[str]:
    """What a terminal of this width shows."""
    out = io.StringIO()
    console = Console(file=out, width=columns)
    console.print(fitted(table(), console))
    return [line.rstrip() for line in out.getvalue().splitlines()]


@pytest.mark.parametrize("columns", [32, 44])
def test_a_table_that_does_not_fit_is_shown_row_by_row(columns: int) -> None:
    """Every entry is there in full, on a line of its own, under the first cell of its row."""
    assert said(columns) == [
        "A comparison",
        "",
        "scheme innovation",
        "  adversary  bayesian",
        "  its error  0.123 ± 0.004",
        "  ratio      1.2e+05 ± 3e+03",
        "",
        "scheme innovation",
        "  adversary  naive",
        "  its error  56.7 ± 8.9",
    ]


def test_a_table_that_fits_stays_a_table() -> None:
    """On a terminal of 80 columns it has its heads in one line."""
    assert any("scheme" in line and "ratio" in line for line in said(80))


def test_a_table_stays_a_table_as_long_as_it_fits() -> None:
    """On a terminal that is as wide as its widest line, and not on one that is a column narrower."""
    wide = max(map(len, said(80)))
    assert len({len(line) for line in said(wide)[1:]} & {wide}) == 1
    assert said(wide - 1)[2] == "scheme innovation"


def test_a_report_fits_a_narrow_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a narrow terminal, a table is printed row by row."""
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "32")
    console = terminal()
    with console.capture() as caught:
        console.print(table())
    assert "scheme innovation" in caught.get()


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
    assert "".join(narrow.split()) == "".join("".join(lines).split())


def test_a_head_may_be_wrapped() -> None:
    """A table fits if its cells and the words of its heads do."""
    made = Table()
    for head in ("receiver", "mean squared error of all trials"):
        made.add_column(head, no_wrap=True)
    made.add_row("smart", "0.5 ± 0.1")
    console = Console(file=io.StringIO(), width=30)
    assert fitted(made, console) is made
