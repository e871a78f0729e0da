"""The command blocks of the pages print what the pages show."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.docs.consoles import ROOT, blocks, carry_out, matches

PAGES = {
    path.relative_to(ROOT).as_posix(): path for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
}
RUN = [name for name, path in PAGES.items() if any(block.is_run for block in blocks(path))]
NOT_RUN = {
    "README.md": 2,
    "docs/compare.md": 1,
    "docs/containers.md": 6,
    "docs/control.md": 2,
    "docs/hosts.md": 6,
    "docs/install.md": 3,
    "docs/integrity.md": 1,
    "docs/links.md": 1,
    "docs/microgrid.md": 3,
    "docs/montecarlo.md": 1,
    "docs/papers.md": 1,
    "docs/programs.md": 2,
    "docs/performance.md": 1,
    "docs/testing.md": 3,
    "docs/run.md": 2,
    "docs/tutorial.md": 1,
    "docs/view.md": 3,
    "docs/wire/file.md": 3,
}
"""The number of command blocks of each page that are not run; those of other pages need a reason."""


@pytest.mark.long
@pytest.mark.parametrize("name", RUN)
def test_the_commands_of_a_page_print_what_it_shows(name: str, tmp_path: Path) -> None:
    """In order, in one folder. `python -m tests.docs.consoles PAGE` writes what they print into the page."""
    wrong = [str(command) for _, done in carry_out(PAGES[name], tmp_path) for command in done if not command.is_right]
    assert not wrong, "\n".join(wrong)


def test_no_further_block_of_commands_is_left_out() -> None:
    """The blocks that are not run are counted."""
    left_out = {
        name: sum(block.has_commands and not block.is_run for block in blocks(path)) for name, path in PAGES.items()
    }
    assert {name: count for name, count in left_out.items() if count} == NOT_RUN


def test_what_is_shown_only_says_why() -> None:
    """A block that is not run names its reason."""
    consoles = [block for path in PAGES.values() for block in blocks(path) if block.language == "console"]
    assert consoles
    assert all(block.is_run or block.not_run for block in consoles)
    assert all(list(block.commands()) for block in consoles)


@pytest.mark.parametrize(
    ("printed", "shown", "same"),
    [
        ("found 0.25 \n", "found 0.25\n", True),
        ("found 0.25\n", "found 0.26\n", False),
        ("took 0.7 s\n", "took … s\n", True),
        ("took 0.7 s\n2 failed\n", "took … s\n", False),
        ("a\nb\nc\nd\n", "a\n…\nd\n", True),
        ("a\nd\n", "a\n…\nd\n", True),
        ("a\nb\nc\n", "a\n…\nd\n", False),
        ("a\nb\n", "a\n", False),
        ("a.b\n", "a+b\n", False),
    ],
)
def test_output_is_compared(printed: str, shown: str, same: bool) -> None:
    """To the last character, but for spaces at the ends of lines and for what is left out."""
    assert matches(printed, shown) is same


def test_a_page_that_is_wrong_is_found(tmp_path: Path) -> None:
    """A file, one of another page, a wrong number or status, and a command that fails without a word."""
    page = tmp_path / "page.md"
    (tmp_path / "other.md").write_text("```toml\n# b.toml\n```\n")
    page.write_text(
        "<!-- file: a.txt -->\n```text\n1\n```\n\n```console\n$ cat a.txt\n1\n$ cat a.txt; echo \\\n  3\n1\n2\n$ false\n```\n"
        "<!-- with: other.md -->\n```console\n$ cat b.toml\n# b.toml\n```\n"
        "<!-- exit status: 3 -->\n```console\n$ true\n$ exit 3\n```\n"
        "<!-- not run: it never ends -->\n```console\n$ sleep 1000\n```\n"
    )
    done = [[command.is_right for command in commands] for _, commands in carry_out(page, tmp_path)]
    assert done == [[True, False, False], [True], [True, True]]
