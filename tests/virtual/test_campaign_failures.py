"""The failures that the pages show are those of the code."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.virtual.failures import TEXTS, again


@pytest.mark.parametrize("path", sorted(TEXTS.glob("*.txt")), ids=lambda path: path.stem)
def test_a_shown_failure_is_what_the_simulated_world_says(path: Path) -> None:
    """After a change, `python -m tests.virtual.failures` writes the texts again: read the difference before you commit it."""
    text = path.read_text("utf-8")
    assert again(text) == text
    assert "    MISS " in text
