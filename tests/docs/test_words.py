"""README and docs/ stay short."""

from __future__ import annotations

from pathlib import Path

from tests.docs.site_tools import site_tool


def test_the_pages_have_at_most_as_many_words_as_they_may() -> None:
    """`make docs` prints them by page."""
    words = site_tool("words")
    assert sum(words.words().values()) <= words.LIMIT


def test_words_have_a_letter_or_a_digit(tmp_path: Path) -> None:
    """In README and below docs/, code included, and nowhere else."""
    (tmp_path / "docs" / "wire").mkdir(parents=True)
    (tmp_path / "README.md").write_text("# One two\n")
    (tmp_path / "docs" / "a.md").write_text("a `b c`\n\n```console\n$ d\n```\n\n```golden x\n00 ff\n```\n")
    (tmp_path / "docs" / "wire" / "b.md").write_text("x\n")
    (tmp_path / "CHANGELOG.md").write_text("not counted\n")
    assert site_tool("words").words(tmp_path) == {"docs/a.md": 5, "README.md": 2, "docs/wire/b.md": 1}
