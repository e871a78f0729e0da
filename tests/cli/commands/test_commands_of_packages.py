"""Commands: of an installed package, and those here, which the registry lists in one line each."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

from evedrop.cli.commands import MODULES
from tests.conftest import Evedrop
from tests.packages import install

DOCS = Path(__file__).parents[3] / "docs"
COMMAND = (
    (DOCS / "your-own" / "command.md").read_text(encoding="utf-8").partition("# greeting.py\n")[2].partition("```")[0]
)
"""The module of docs/your-own/command.md."""


def test_a_package_adds_a_command_by_its_metadata(evedrop: Evedrop) -> None:
    """One file and one line: it is in the help, has options, and its result is the exit status."""
    install(evedrop.folder, {"greeting.py": COMMAND}, {"evedrop.commands": {"greet": "greeting"}})
    environment = {**evedrop.environment, "PYTHONPATH": str(evedrop.folder)}
    assert "greet         say hello" in evedrop.process("--help", env=environment).out
    done = evedrop.process("greet", "you", env=environment)
    assert (done.status, done.out, done.err) == (0, "hello you\n", "")


def test_a_package_that_is_broken_breaks_no_help(evedrop: Evedrop) -> None:
    """One that cannot be imported, and one that takes the name of a command, are named; all other commands are there."""
    broken, taking = "raise RuntimeError('not today')\n", COMMAND.replace('"greet", greet', '"run", greet')
    commands = {"broken": "broken", "run": "taking"}
    install(evedrop.folder, {"broken.py": broken, "taking.py": taking}, {"evedrop.commands": commands})
    environment = {**evedrop.environment, "PYTHONPATH": str(evedrop.folder)}
    done = evedrop.process("--help", env=environment)
    assert done.status == 0
    assert "run a scenario live" in done.out
    assert done.err.splitlines() == [
        "evedrop: warning: the commands of broken cannot be loaded (RuntimeError: not today)",
        "evedrop: warning: the command run of taking is left out: expected a new name, and no group",
    ]
    assert evedrop.process("list", env=environment).err == ""


def test_every_command_is_in_the_module_that_the_registry_says() -> None:
    """And every module has commands only that the registry lists."""
    modules: dict[str, str] = {}
    for name in dict.fromkeys(MODULES.values()):
        for command in import_module(f"evedrop.cli.commands.{name}").COMMANDS:
            modules[command.group or command.name] = name
    assert modules == dict(MODULES)


@pytest.mark.parametrize(
    ("commands", "why"),
    [
        ('Command("greet", greet, "say hello")', "TypeError"),
        ('("greet",)', "TypeError: COMMANDS has 'greet', which is no Command"),
        ('(Command("greet", greet, "say hello", (3,)),)', "TypeError"),
    ],
    ids=["no tuple", "a word", "a wrong option"],
)
def test_commands_that_are_none_break_no_help(evedrop: Evedrop, commands: str, why: str) -> None:
    """The comma of a tuple of one is easily forgotten."""
    lone = f"{COMMAND.rpartition('COMMANDS')[0]}COMMANDS = {commands}\n"
    install(evedrop.folder, {"lone.py": lone}, {"evedrop.commands": {"greet": "lone"}})
    done = evedrop.process("--help", env={**evedrop.environment, "PYTHONPATH": str(evedrop.folder)})
    assert (done.status, f"the commands of lone cannot be loaded ({why}" in done.err) == (0, True), done.err
