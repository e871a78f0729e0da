"""The failures that the pages show are those of the code."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.virtual.failures import TEXTS, again

QUICKEST = TEXTS / "window-forgets.txt"


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=() if path == QUICKEST else pytest.mark.campaign)
        for path in sorted(TEXTS.glob("*.txt"))
    ],
)
def test_a_shown_failure_is_what_the_simulated_world_says(path: Path) -> None:
    """After a change, `python -m tests.virtual.failures` writes the texts again: read the difference before you commit it."""
    text = path.read_text("utf-8")
    assert again(text) == text
    assert "    MISS " in text
