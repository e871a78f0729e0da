"""What commands say last on a terminal, and what `evedrop` alone says: commands that there are."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import pytest

from evedrop.cli.command import Command
from evedrop.cli.commands import ROLES
from evedrop.cli.main import main, parser_of
from evedrop.cli.next_step import next_step
from evedrop.errors import UsageError
from tests.cli.terminal import Terminal
from tests.cli.test_help import commands, parsed


@pytest.mark.parametrize("command", commands(), ids=lambda command: command.name)
def test_every_command_leads_to_one_that_is_understood(command: Command) -> None:
    """From its example, unless a program starts or reads it."""
    options = parsed(command)
    if command.name == "demo":
        options.scenario = "vehicle"
    step = next_step(command, options)
    if step is None:
        assert command.name in {"new", "docs", "completion", "health", "host", *ROLES}
        return
    assert parser_of(step[1][0]).parse_args(step[1]).command is not None


@pytest.mark.parametrize(
    ("words", "last"),
    [
        (["list"], "next, to run one live: evedrop run vehicle"),
        (["check", "my own.toml"], "next, to run it live: evedrop run 'my own.toml'"),
        (["wire", "wire.toml", "--check"], "next, to start it: evedrop wire wire.toml"),
        (["check", "--scheme", "plain"], "next, to read more: evedrop docs "),
    ],
)
def test_the_line_is_the_last_one_of_a_terminal(
    words: list[str], last: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the arguments that the command was given, as a shell reads them."""
    monkeypatch.chdir(tmp_path)
    assert main(["new", "my own.toml"]) == 0
    monkeypatch.setattr(sys, "stdout", terminal := Terminal())
    assert main(["wire", "--example"]) == 0
    Path("wire.toml").write_text(terminal.getvalue())
    assert main(words) == 0
    assert terminal.getvalue().splitlines()[-1].startswith(last)


def test_neither_programs_nor_failures_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not on a pipe, not beside JSON, not in a file to save, and not after an error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdout", terminal := Terminal())
    assert main(["paper", "--json"]) == 0
    assert main(["wire", "--example"]) == 0
    assert main(["check", "missing.toml"]) == UsageError.exit_status
    assert "next, " not in terminal.getvalue()


def test_pipes_do_not_get_it(capsys: pytest.CaptureFixture[str]) -> None:
    """Standard output of a program that reads it."""
    assert main(["list"]) == 0
    assert "next, " not in capsys.readouterr().out


def test_alone_it_says_what_to_try(capsys: pytest.CaptureFixture[str]) -> None:
    """Each command is one; the exit status is that of bad usage."""
    assert main([]) == UsageError.exit_status
    printed = capsys.readouterr()
    assert printed.out == ""
    lines = [line.strip().partition("  ")[0] for line in printed.err.splitlines() if line.startswith("  evedrop ")]
    assert len(lines) == 5
    for words in (shlex.split(line.partition(" >")[0])[1:] for line in lines):
        assert words == ["--help"] or parser_of(words[0]).parse_args(words).command is not None
