"""A number of things in words."""

from __future__ import annotations

import pytest

from evedrop.counting import counted


@pytest.mark.parametrize(
    ("count", "noun", "words"),
    [
        (0, "slot", "0 slots"),
        (1, "slot", "1 slot"),
        (1000, "slot", "1,000 slots"),
        (1, "entry", "1 entry"),
        (2, "entry", "2 entries"),
    ],
)
def test_one_thing_is_singular(count: int, noun: str, words: str) -> None:
    """All other numbers are plural."""
    assert counted(count, noun) == words
