"""The commands in the documents work."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from evedrop.cli import main as cli
from evedrop.model.schemes import SCHEMES

DOCS = Path(__file__).parents[2] / "docs"
PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))


def commands(page: str) -> list[list[str]]:
    """The `evedrop` commands in a page's code blocks, and those of pytest; without what a shell does with their output."""
    text = (DOCS / page).read_text(encoding="utf-8")
    lines = [line.strip().removeprefix("$ ") for line in text.splitlines()]
    texts = [re.split(r"  #| [>|&] ?", line)[0] for line in lines if line.startswith(("evedrop ", "python -m pytest "))]
    return [shlex.split(line) for line in texts if " -m pytest " not in line or "test_theory_errata.py" in line]


@pytest.mark.parametrize("page", PAGES)
def test_every_command_of_the_documents_is_one(page: str) -> None:
    """Options and their values are understood; tests that are named exist."""
    names = (DOCS.parent / "tests" / "model" / "theory" / "test_theory_errata.py").read_text(encoding="utf-8")
    for words in commands(page):
        if words[0] == "python":
            assert (DOCS.parent / words[3]).is_file()
            assert f"def test_{words[-1]}_" in names, words
        elif words[1] != "FILE":
            assert cli.parser_of().parse_args(words[1:]).command is not None


OTHER_OPTIONS = {
    "emulator/evedrop/studies/applications/microgrid/day.py",  # a program of its own
    "emulator/evedrop/live/launch/compose.py",  # those of docker compose
    "emulator/evedrop/simulate/cluster.py",  # those of dask worker
    "emulator/evedrop/cli/pytest_plugin.py",
    "emulator/evedrop/show/report/chart.py",  # names in its style sheet
    "emulator/evedrop/show/report/travel.py",  # git's
    "emulator/evedrop/show/view/picture.py",  # the viewer's
    "emulator/evedrop/show/view/viewer.py",  # the viewer's, and the sandbox's
}
"""Modules that name the options of other programs."""
_PIP = {"--force-reinstall"}


def test_every_option_that_the_code_names_is_one() -> None:
    """A message that advises an option names one that a command has."""
    options = cli.parser_of().options() | _PIP
    sources = [path.relative_to(DOCS.parent).as_posix() for path in sorted((DOCS.parent / "emulator").rglob("*.py"))]
    assert set(sources) > OTHER_OPTIONS
    for source in set(sources) - OTHER_OPTIONS:
        text = (DOCS.parent / source).read_text(encoding="utf-8")
        assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)) <= options, source


@pytest.mark.parametrize("page", PAGES)
def test_a_page_that_names_a_file_of_the_program_says_where_it_is(page: str) -> None:
    """In the repository: in an installed package the folder has another name."""
    text = " ".join((DOCS / page).read_text(encoding="utf-8").split())
    if re.search(r"`emulator/", text):
        assert re.search(r"\b(clone of the repository|of the repository|the checkout)\b", text)


def test_every_scheme_has_a_section_or_shares_one() -> None:
    """The index links each name to its section, and that section is about it."""
    index = (DOCS / "schemes.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[`([a-z-]+)`\]\((schemes/[a-z-]+\.md)#([a-z-]+)\)", index, re.MULTILINE)
    assert {name for name, _, _ in rows} == set(SCHEMES)
    for name, page, anchor in rows:
        assert name in re.split(r"-and-", anchor), name
        headings = re.findall(r"^## (.*)$", (DOCS / page).read_text(encoding="utf-8"), re.MULTILINE)
        assert any(f"`{name}`" in heading for heading in headings), name


def test_the_pages_that_show_commands_have_some() -> None:
    """So that the test above tests something."""
    assert {page: len(commands(page)) >= least for page, least in {"montecarlo.md": 5, "errata.md": 4}.items()} == {
        "montecarlo.md": True,
        "errata.md": True,
    }
