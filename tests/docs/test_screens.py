"""What commands print on terminals of six widths is what docs/screens shows. `make docs` runs these tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.docs.screens import COMMANDS, WIDTHS, read_page, screens


@pytest.mark.long
@pytest.mark.parametrize("columns", WIDTHS)
def test_a_terminal_shows_what_its_page_shows(columns: int, tmp_path: Path) -> None:
    """Word by word, and no line is wider than the terminal. `python -m tests.docs.screens WIDTH` writes the page again."""
    printed = list(screens(columns, tmp_path))
    assert [screen.words for screen in printed] == [screen.words for screen in read_page(columns)]
    assert not [line for screen in printed for line in screen.wide(columns)]


@pytest.mark.parametrize("columns", WIDTHS)
def test_a_page_has_every_command(columns: int) -> None:
    """With what it printed."""
    page = read_page(columns)
    assert tuple(screen.command for screen in page) == COMMANDS
    assert all(screen.words for screen in page)
