"""The Python of docs/python.md runs as it is, and raises the errors that it shows."""

from __future__ import annotations

import importlib
import inspect
import re
import traceback
from pathlib import Path
from typing import Any

import pytest

import evedrop
from evedrop.cli import api
from evedrop.cli.commands import MODULES

ROOT = Path(__file__).parents[2]
SHOWING_PYTHON = [
    path.relative_to(ROOT).as_posix()
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "docs").rglob("*.ipynb"))]
]
PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(python|pycon)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


@pytest.mark.thorough
def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All blocks in order, in one folder; a block of a session ends with the error that it shows."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    assert {kind for kind, _ in BLOCKS} == {"python", "pycon"}
    for kind, code in BLOCKS:
        if kind == "python":
            exec(compile(code, "docs/python.md", "exec"), names)  # noqa: S102 - the page's own code
            continue
        call, *_, message = re.split(r"^Traceback .*:$\n", code.removeprefix(">>> "), maxsplit=1, flags=re.MULTILINE)
        with pytest.raises(Exception, match="mistakes") as caught:
            exec(call, names)  # noqa: S102 - the same
        assert "".join(traceback.format_exception_only(caught.value)) == message


def test_the_table_has_every_function() -> None:
    """Those of `evedrop`, which has all of `evedrop.cli.api`."""
    named = re.findall(r"^\| `(\w+)\(", PAGE, re.MULTILINE)
    functions = {name for name in evedrop.__all__ if not inspect.isclass(getattr(evedrop, name))}
    assert {name for name in api.__all__ if inspect.isfunction(getattr(api, name))} <= functions
    assert sorted(named) == sorted(functions)


def test_the_public_classes_are_named() -> None:
    """In the section about what is stable."""
    stable = PAGE.partition("## What is stable")[2]
    assert {name for name in evedrop.__all__ if inspect.isclass(getattr(evedrop, name))} <= {
        *re.findall(r"`(\w+)`", stable)
    }


IMPORT = re.compile(r"^\s*\"?(?:from|import) (evedrop[\w.]*)", re.MULTILINE)


@pytest.mark.parametrize("name", SHOWING_PYTHON)
def test_pages_import_public_modules(name: str) -> None:
    """A user who copies a page uses nothing that may change in any version."""
    assert {*IMPORT.findall((ROOT / name).read_text(encoding="utf-8"))} <= {"evedrop", "evedrop.extend"}


def test_the_commands_without_a_function_are_listed() -> None:
    """Of those that run or compute something."""
    commands = {
        " ".join(filter(None, (command.group, command.name)))
        for module in set(MODULES.values())
        for command in importlib.import_module(f"evedrop.cli.commands.{module}").COMMANDS
        if command.section in {"run", "study"}
    }
    (listing,) = re.findall(r"have no\s+function: (.*?);", PAGE, re.DOTALL)
    assert set(re.findall(r"`([\w ]+)`", listing)) == {name for name in commands if name not in evedrop.__all__}
