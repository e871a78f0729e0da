"""The matrix of a comparison on the terminal, and what is printed around it, at each width."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from rich.cells import cell_len

from evedrop import compare
from evedrop.cli.report import print_comparison
from evedrop.results.comparison import Comparison
from evedrop.show.report.verdict_matrix import matrix_lines
from evedrop.simulate.montecarlo import Plan
from tests.cli.terminal import Terminal


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """Three schemes and eight adversaries, one of which cannot be used with any of the schemes."""
    return compare(
        "numerical",
        schemes=["plain", "innovation", "partial-encryption"],
        adversaries=["naive", "suspicious", "smart", "constant", "genie", "clear-states", "colluding", "tracker"],
        trials=3,
        slots=12,
        out=tmp_path_factory.mktemp("compare") / "run",
        plan=Plan(workers=1),
    )


@pytest.mark.parametrize("columns", [20, 24, 40, 60, 80, 100, 120, 200])
def test_every_verdict_has_its_mark(compared: Comparison, columns: int) -> None:
    """In the row of its scheme and the column of its adversary's letter, in one block or in several."""
    marks: dict[tuple[str, str], str] = {}
    lines = list(matrix_lines(compared, columns))
    schemes = list(compared.schemes)
    for block in range(0, len(lines) - 2, len(schemes) + 2):
        head, *rows, legend = lines[block : block + len(schemes) + 2]
        assert max(map(cell_len, (head, *rows))) <= columns
        names = dict(entry.split("=") for entry in legend.split(", "))
        for scheme, row in zip(schemes, rows, strict=True):
            marks |= {(scheme, names[letter]): row[i] for i, letter in enumerate(head) if letter != " "}
    expected = {
        (name, who): "·" if cell.verdict is None else cell.verdict.glyph
        for name, scheme in compared.schemes.items()
        for who, cell in scheme.cells.items()
        if who != "tracker"
    }
    assert marks == expected
    assert lines[-1] == "not defined with any of these schemes: tracker"
    assert "✔=perfectly secret" in lines[-2]


@pytest.mark.parametrize("columns", [40, 60, 80, 100, 120, 200])
@pytest.mark.parametrize("verbose", [False, True])
def test_a_comparison_fits_the_terminal(
    compared: Comparison, columns: int, verbose: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The matrix, one conclusion and the way to the rest, in fewer lines than a screen has; --verbose has the tables, too."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("TERM", "dumb")
    print_comparison(compared, "runs/compared", verbose)
    lines = terminal.getvalue().splitlines()
    assert max(map(cell_len, lines)) <= columns
    words = " ".join(terminal.getvalue().split())
    assert words.count("dominates") == 1
    assert ("closest adversary" in words and "not defined:" in words) is verbose or columns == 40
    assert verbose or len(lines) <= 24
    assert ("--verbose" in words) is not verbose
