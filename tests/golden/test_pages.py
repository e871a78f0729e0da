"""The golden pages name tests that there are, and a wrong sentence is noticed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.golden import pages
from tests.golden.pages import HERE, WRITE, Golden, read_page, write_page

ROOT = Path(__file__).parents[2]
COMMANDS = sorted(path.stem for path in HERE.glob("*.txt"))


@pytest.mark.parametrize("command", COMMANDS)
def test_every_section_is_of_a_test(command: str) -> None:
    """A section whose test is gone or has another name is compared with nothing."""
    sections = read_page(command)
    assert sections
    for name in sections:
        file, _, test = name.partition("::")
        assert f"def {test.partition('[')[0]}(" in (ROOT / file).read_text(encoding="utf-8"), name


def test_a_wrong_sentence_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another word, a line too many, a line that is missing; folders of tests are no difference."""
    monkeypatch.delenv(WRITE, raising=False)
    monkeypatch.setattr(pages, "HERE", tmp_path)
    write_page("check", {"a::b": "FOLDER/x: one\ntwo", "a::c": "three"})
    right = Golden("a::b", tmp_path)
    right("check", [f"{tmp_path}/x: one"], ValueError("two"))
    right.end()
    with pytest.raises(AssertionError, match=r"tests/golden/check\.txt"):
        Golden("a::b", tmp_path)("check", "one")
    with pytest.raises(AssertionError):
        Golden("a::c", tmp_path)("check", "three\nfour")
    short = Golden("a::b", tmp_path)
    short("check", f"{tmp_path}/x: one")
    with pytest.raises(AssertionError):
        short.end()


def test_a_page_is_written_section_by_section(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order, and the others stay."""
    monkeypatch.setenv(WRITE, "write")
    monkeypatch.setattr(pages, "HERE", tmp_path)
    (tmp_path / "pages.py").touch()
    for name in ("b::b", "a::a"):
        Golden(name, tmp_path)("run", name, ["more", "lines"])
    assert read_page("run") == {"a::a": "a::a\nmore\nlines", "b::b": "b::b\nmore\nlines"}
