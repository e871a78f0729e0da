"""Runs the command blocks of a page in order, and compares their output with what the page shows.

In a fence of the language `console`, a line that begins with `$ ` is a command, and the lines below it are its output, errors
included. Output that is not shown is not compared, but the command must succeed. `…` stands for any text within a line,
and on a line of its own for any lines. All commands of a page share a folder. A comment directly above a fence says more:

    <!-- file: mine.toml -->        the text is written to this file, as it is if its first line is `# mine.toml`
    <!-- exit status: 1 -->         of the last command; otherwise all must be 0
    <!-- with: other.md, third.md -->  the files of these pages, from the same folder of pages, are there, too
    <!-- not run: needs docker -->  shown only

`python -m tests.docs.consoles PAGE` writes the output into the page wherever the page's differs.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
_FENCE = re.compile(
    r"^(?:<!-- (?P<note>[^\n]*?) -->\n)?^```(?P<language>[\w-]*)[^\n]*\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL
)
_COLUMNS = 110
_COMMAND = re.compile(r"^(\$ )?(evedrop|python3?|pip|make|docker|pytest|ssh|dask|sudo) ", re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """A fence: the comment above it, its language, its text, and where the text begins in the page."""

    note: str
    language: str
    text: str
    begins: int

    @property
    def file(self) -> str | None:
        """The name of the file that it contains, by the comment above it or its own first line."""
        match = re.match(r"# ([\w./-]+\.(?:py|toml))\n", self.text)
        return self._note("file") or (match[1] if match else None)

    @property
    def others(self) -> list[str]:
        """The pages whose files its commands use, too."""
        names = self._note("with")
        return names.split(", ") if names else []

    @property
    def not_run(self) -> str | None:
        """Why its commands are not run."""
        return self._note("not run")

    @property
    def status(self) -> int:
        """The exit status of its last command."""
        return int(self._note("exit status") or 0)

    @property
    def is_run(self) -> bool:
        """Whether its commands are run."""
        return self.language == "console" and self.not_run is None

    @property
    def has_commands(self) -> bool:
        """Whether it has a command for a shell, run or not."""
        return self.language in {"", "sh", "text", "console"} and _COMMAND.search(self.text) is not None

    def commands(self) -> Iterator[tuple[str, str]]:
        """Each command with its output."""
        for part in re.split(r"^\$ ", self.text, flags=re.MULTILINE)[1:]:
            match = re.match(r"((?:.*\\\n)*.*\n)", part)
            assert match is not None
            yield match[1].rstrip("\n"), part[match.end() :]

    def _note(self, kind: str) -> str | None:
        name, _, value = self.note.partition(": ")
        return value if name == kind else None


def blocks(page: Path) -> list[Block]:
    """The fences of a page."""
    matches = _FENCE.finditer(page.read_text(encoding="utf-8"))
    return [Block(match["note"] or "", match["language"], match["text"], match.start("text")) for match in matches]


def matches(printed: str, shown: str) -> bool:
    """Whether output is as shown; spaces at the ends of lines, and empty lines around it, do not count."""
    printed, shown = _trimmed(printed), _trimmed(shown)
    pattern = re.escape(shown)
    pattern = re.sub(r"^…\\\n", r"(?:.*\n)*?", pattern, flags=re.MULTILINE)
    return re.fullmatch(pattern.replace("…", ".*?"), printed) is not None


@dataclass(frozen=True)
class Carried:
    """A command that was run: what the page shows, what it printed, and whether it ended as it should."""

    command: str
    shown: str
    printed: str
    status: int
    expected_status: int

    @property
    def is_right(self) -> bool:
        """Whether it ended with its status, and printed what the page shows."""
        return self.status == self.expected_status and (not self.shown or matches(self.printed, self.shown))

    def __str__(self) -> str:
        """The difference, to be read."""
        return (
            f"$ {self.command}\nexit status {self.status}, expected {self.expected_status}\n"
            f"--- the page shows\n{self.shown}--- printed\n{self.printed}---"
        )


def carry_out(page: Path, folder: Path) -> Iterator[tuple[Block, list[Carried]]]:
    """Each block of commands with what its commands did, in order."""
    for block in blocks(page):
        _write(block, folder)
        for name in block.others:
            for other in blocks(page.parent / name):
                _write(other, folder)
        if block.is_run:
            commands = list(block.commands())
            yield (
                block,
                [
                    _carried(command, shown, block.status if i == len(commands) - 1 else 0, folder)
                    for i, (command, shown) in enumerate(commands)
                ],
            )


def _write(block: Block, folder: Path) -> None:
    if block.file is not None:
        (folder / block.file).parent.mkdir(parents=True, exist_ok=True)
        (folder / block.file).write_text(block.text, encoding="utf-8")


def _carried(command: str, shown: str, status: int, folder: Path) -> Carried:
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST_", "COV_"))}
    environment |= {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "COLUMNS": str(_COLUMNS),
        "LC_ALL": "C.UTF-8",
    }
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        timeout=600,
    )
    return Carried(command, shown, done.stdout, done.returncode, status)


def rewrite(page: Path) -> list[Carried]:
    """Write what the commands print into the page where it shows something else; returns those commands."""
    wrong: list[Carried] = []
    text = page.read_text(encoding="utf-8")
    shift = 0
    with tempfile.TemporaryDirectory() as folder:
        for block, done in carry_out(page, Path(folder)):
            wrong += [carried for carried in done if not carried.is_right]
            new = "".join(
                f"$ {carried.command}\n{carried.shown if carried.is_right or not carried.shown else _trimmed(carried.printed)}"
                for carried in done
            )
            begins = block.begins + shift
            text = text[:begins] + new + text[begins + len(block.text) :]
            shift += len(new) - len(block.text)
    page.write_text(text, encoding="utf-8")
    return wrong


def _trimmed(text: str) -> str:
    lines = "\n".join(line.rstrip() for line in text.splitlines()).strip("\n")
    return f"{lines}\n" if lines else ""


if __name__ == "__main__":
    for name in sys.argv[1:]:
        for one in rewrite(Path(name).resolve()):
            print(one)  # noqa: T201
