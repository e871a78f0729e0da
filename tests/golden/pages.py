"""The golden pages: what Evedrop says, in full, one page for each command.

A test that provokes a sentence asks for the error's class and place itself, and compares the sentence with the page of the
command:

    golden("check", error)

The page is `tests/golden/COMMAND.txt`. Each of its sections begins with `== ` and the test's name. Where a better word has
changed a sentence, `python -m tests.golden COMMAND` writes the page again; read the difference before you commit it. A new
test writes its section with EVEDROP_GOLDEN=write in the environment. Folders of tests are FOLDER on a page.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import final

import pytest

HERE = Path(__file__).parent
WRITE = "EVEDROP_GOLDEN"
"""The variable of the environment that is `write` where pages are written."""
_HEAD = "== "
_REMEDY = "look at tests/golden/{0}.txt; `python -m tests.golden {0}` writes it again"


def page_of(command: str) -> Path:
    """The file of a command's page."""
    return HERE / f"{command}.txt"


def read_page(command: str) -> dict[str, str]:
    """Test → what it provokes, by a command's page; nothing if there is no page."""
    path = page_of(command)
    if not path.exists():
        return {}
    sections: dict[str, str] = {}
    for part in path.read_text(encoding="utf-8").split(f"\n{_HEAD}")[1:]:
        name, _, text = part.partition("\n")
        sections[name] = text.rstrip("\n")
    return sections


def write_page(command: str, sections: dict[str, str]) -> None:
    """Write a command's page, its sections in order."""
    text = f"What `evedrop {command}` says, by test. tests/golden/pages.py says how to write this page again.\n"
    text += "".join(f"\n{_HEAD}{name}\n{section}\n" for name, section in sorted(sections.items()))
    page_of(command).write_text(text, encoding="utf-8")


@final
class Golden:
    """Compares what a test provokes with the pages; test: its name; folder: its temporary one."""

    def __init__(self, test: str, folder: Path) -> None:
        self._test = test
        self._folder = str(folder)
        self._lines_of: dict[str, list[str]] = {}

    def __call__(self, command: str, *texts: object) -> None:
        """Compare sentences, errors, or lists of sentences with a command's page, after those that were compared before."""
        before = self._lines_of.setdefault(command, [])
        before += [self._line(line) for part in texts for line in _lines(part)]
        text = "\n".join(before)
        if os.environ.get(WRITE) == "write":
            self._write(command, text)
            return
        assert before == self._expected(command)[: len(before)], _REMEDY.format(command)

    def end(self) -> None:
        """The test is over: its sections have no more lines than it compared."""
        for command, lines in self._lines_of.items():
            assert os.environ.get(WRITE) == "write" or lines == self._expected(command), _REMEDY.format(command)

    def _expected(self, command: str) -> list[str]:
        return read_page(command).get(self._test, "").split("\n")

    def _line(self, line: str) -> str:
        return line.replace(self._folder, "FOLDER").rstrip()

    def _write(self, command: str, text: str) -> None:
        with (HERE / "pages.py").open() as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            write_page(command, {**read_page(command), self._test: text})


def _lines(text: object) -> Iterable[str]:
    if isinstance(text, (list, tuple)):
        return [line for part in text for line in _lines(part)]
    return str(text).rstrip("\n").split("\n")


@pytest.fixture
def golden(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Golden]:
    """Compares what this test provokes with the golden pages."""
    pages = Golden(request.node.nodeid, tmp_path)
    yield pages
    pages.end()
