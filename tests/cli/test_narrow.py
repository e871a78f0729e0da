"""Tables on narrow terminals: nothing is cut off."""

from __future__ import annotations

import io
import sys

import pytest
from rich.console import Console

from evedrop.cli.main import main
from evedrop.cli.parser import name_lines
from evedrop.cli.report import terminal
from evedrop.show.report.text_table import TextTable
from evedrop.show.terminal_tables import fitted, rich_table


def table() -> TextTable:
    """Two rows, of which the second repeats the first cell."""
    made = TextTable.headed(["scheme", "adversary", "its error", "ratio"], [], title="A comparison")
    made.add("innovation", "bayesian", "0.123 ± 0.004", "1.2e+05 ± 3e+03")
    made.add("", "naive", "56.7 ± 8.9", "")
    return made


def lines(columns: int) -> list[str]:
    """The lines of a terminal of this width."""
    out = io.StringIO()
    console = Console(file=out, width=columns)
    console.print(fitted(rich_table(table()), console))
    return out.getvalue().splitlines()


def shown(columns: int) -> list[str]:
    """What a terminal of this width shows."""
    return [line.rstrip() for line in lines(columns)]


@pytest.mark.parametrize("columns", [32, 44])
def test_a_table_that_does_not_fit_is_shown_row_by_row(columns: int) -> None:
    """Every entry is there in full, on a line of its own, under the first cell of its row."""
    assert shown(columns) == [
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
    assert any("scheme" in line and "ratio" in line for line in shown(80))


def test_a_table_stays_a_table_as_long_as_it_fits() -> None:
    """On a terminal that is as wide as its widest line, and not on one that is a column narrower."""
    wide = max(map(len, lines(80)))
    assert {len(line) for line in lines(wide) if line.strip()} == {wide}
    assert any("scheme" in line and "ratio" in line for line in shown(wide))
    assert shown(wide - 1)[2] == "scheme innovation"


def test_a_report_fits_a_narrow_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a narrow terminal, a table is printed row by row."""
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "32")
    console = terminal()
    with console.capture() as caught:
        console.show(table())
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
    made = TextTable.headed(["receiver", "mean squared error of all trials"], [])
    made.add("smart", "0.5 ± 0.1")
    drawn = rich_table(made)
    console = Console(file=io.StringIO(), width=30)
    assert fitted(drawn, console) is drawn
