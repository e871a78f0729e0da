"""Pads are a keystream of AES: no text calls them a one-time pad, or promises secrecy against unlimited means."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FILES = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "docs/notebooks/*.ipynb", "emulator/**/*.py", "scenarios/*.toml")
    for path in ROOT.glob(pattern)
    if path.name != "CHANGELOG.md"
)
PROMISES = re.compile(r"(?<!not a )one-time pads?|(?<!not against )unlimited means", re.IGNORECASE)


def test_no_text_promises_more_than_a_stream_cipher() -> None:
    """In pages, scenarios and docstrings."""
    findalls = {path.name: PROMISES.findall(" ".join(path.read_text(encoding="utf-8").split())) for path in FILES}
    assert {name: words for name, words in findalls.items() if words} == {}


def test_the_section_about_the_cipher_says_what_it_is() -> None:
    """An ideal pad in the model, AES-256 in the program, and what follows."""
    text = " ".join((ROOT / "docs" / "schemes" / "encryption.md").read_text(encoding="utf-8").split())
    assert "modelled as an ideal pad, uniform and used once, and implemented as a stream cipher: AES-256" in text
    assert "computational secrecy" in text


@pytest.mark.parametrize(
    ("text", "promises"),
    [("under a one-time pad", True), ("is a cipher, not a one-time pad", False), ("and unlimited means", True)],
)
def test_a_promise_is_recognised(text: str, promises: bool) -> None:
    """So that the first test tests something."""
    assert bool(PROMISES.search(text)) is promises
