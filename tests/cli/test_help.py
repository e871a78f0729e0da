"""Help, hints for mistyped words, the pages of the documentation, and completion."""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from evedrop.cli.command import Command
from evedrop.cli.main import main, parser_of
from tests.conftest import LIMIT

SECTIONS = ["make", "run", "study", "steer", "inspect", "processes"]


def commands() -> list[Command]:
    """All built-in commands."""
    from importlib import import_module

    from evedrop.cli.commands import MODULES

    names = list(dict.fromkeys(MODULES.values()))
    return [command for name in names for command in import_module(f"evedrop.cli.commands.{name}").COMMANDS]


def parsed(command: Command) -> argparse.Namespace:
    """The options in the example of a command, which has no others; among them the command's `parser`."""
    words = shlex.split(command.example.partition(" >>")[0])
    options, unknown = parser_of(words[0]).parse_known_args(words)
    assert not unknown
    assert command.name in words[:2]
    return options


@pytest.mark.parametrize("command", commands(), ids=lambda command: command.name)
def test_every_command_has_a_section_and_an_example_that_is_understood(command: Command) -> None:
    """The example names the command, and the parser takes all of it."""
    assert command.section in SECTIONS
    assert parsed(command).command is command.run


@pytest.mark.parametrize("command", commands(), ids=lambda command: command.name)
def test_the_page_of_a_command_exists(command: Command, capsys: pytest.CaptureFixture[str]) -> None:
    """The help names a page that `evedrop docs` prints."""
    if command.page:
        assert main(["docs", command.page]) == 0
        assert capsys.readouterr().out.startswith("# ")


def test_help_lists_all_commands_in_sections(capsys: pytest.CaptureFixture[str]) -> None:
    """In the order of the sections, each command once."""
    assert list(parser_of().sections) == SECTIONS
    assert main(["--help"]) == 0
    output = capsys.readouterr().out
    assert [line.rstrip(":") for line in output.splitlines() if line.endswith(":")] == SECTIONS


@pytest.mark.parametrize("columns", [40, 80])
def test_help_fits_a_narrow_terminal(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """No line is wider than the terminal: neither of the help of all commands, nor of one of them."""
    monkeypatch.setenv("COLUMNS", str(columns))
    for parser in [parser_of(), *(parsed(command).parser for command in commands())]:
        assert max(map(len, parser.format_help().splitlines())) <= columns, parser.prog


def test_a_usage_is_broken_the_same_with_every_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """At spaces, with the sign of repetition beside its word."""
    monkeypatch.setenv("COLUMNS", "42")
    (link,) = (command for command in commands() if command.name == "link")
    usage = parsed(link).parser.format_help().partition("\n\n")[0]
    indent = " " * len("usage: evedrop link ")
    expected = ["usage: evedrop link [options] RUN NAME", f"{indent}KEY=VALUE", f"{indent}[KEY=VALUE ...]"]
    assert usage.splitlines() == expected


def test_an_example_that_is_broken_stays_the_same_command(monkeypatch: pytest.MonkeyPatch) -> None:
    """A shell reads its lines as one."""
    monkeypatch.setenv("COLUMNS", "40")
    for command in commands():
        example = parsed(command).parser.format_help().partition("example:\n")[2].partition("\n\n")[0]
        (line,) = example.replace("\\\n", "").splitlines()
        assert shlex.split(line)[1:] == shlex.split(command.example)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["rn", "vehicle"], "unknown command rn; did you mean run?"),
        (["links", "fitt", "x.csv"], "unknown command fitt; did you mean fit?"),
        (["run", "vehicle", "--vew", "off"], "unknown option --vew; did you mean --view?"),
        (["run", "vehicle", "--slot", "4"], "unknown option --slot; did you mean --slots?"),
        (["run", "vehicle", "--slot=4"], "unknown option --slot=4; did you mean --slots?"),
        (["run", "vehicle", "--view", "wob"], "expected one of auto, native, web, off; did you mean web?"),
        (["completion", "fsh"], "'fsh'; expected one of bash, zsh, fish; did you mean fish?"),
        (["show", "vehicel"], "there is no built-in scenario vehicel; did you mean vehicle?"),
        (["docs", "lnks"], "there is no page lnks; did you mean links?"),
    ],
)
def test_a_mistyped_word_gets_a_hint(given: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    """And no option is taken by its first letters."""
    assert main(given) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("rate", ["0.9", "61", "nan", "fast"])
def test_a_number_out_of_range_is_refused_with_its_range(rate: str, capsys: pytest.CaptureFixture[str]) -> None:
    """By the parser, before anything is loaded."""
    assert main(["view", "run", "--video", "run.mp4", "--fps", rate]) == 2
    message = f"argument --fps: {rate} is not a number of frames per second from 1 to 60"
    assert message in capsys.readouterr().err
    assert parser_of("view").parse_whole(["view", "run", "--fps", "60"]).fps == 60.0


def test_a_word_that_resembles_no_other_gets_no_hint(capsys: pytest.CaptureFixture[str]) -> None:
    """A hint that is wrong would mislead."""
    assert main(["xyzzy"]) == 2
    assert capsys.readouterr().err.splitlines()[0] == "evedrop: unknown command xyzzy"


@pytest.mark.parametrize(
    ("given", "message"),
    [(["links"], "COMMAND"), (["--version", "rn"], "evedrop "), (["links", "--help", "fitt"], "links")],
)
def test_argparse_finds_what_comes_before_a_command(
    given: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """An option in its place is carried out, and a command that is missing is named."""
    assert main(given) == (0 if "--version" in given or "--help" in given else 2)
    told = capsys.readouterr()
    assert message in told.out + told.err
    assert "unknown command" not in told.err


def test_docs_lists_every_page(capsys: pytest.CaptureFixture[str]) -> None:
    """With its title."""
    assert main(["docs"]) == 0
    output = capsys.readouterr().out
    pages = (Path(__file__).parents[2] / "docs").rglob("*.md")
    assert {line.split()[0].rpartition("/")[2] for line in output.splitlines()} == {page.stem for page in pages}


def test_docs_lists_the_pages_of_a_folder(capsys: pytest.CaptureFixture[str]) -> None:
    """When the argument is a folder, such as `wire`, and not a page."""
    assert main(["docs", "wire"]) == 0
    names = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert "wire/tutorial" in names
    assert all(name.startswith("wire/") for name in names)


def test_new_copies_a_built_in_scenario(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The copy is what `show` prints."""
    assert main(["new", str(tmp_path / "mine.toml"), "--from", "vehicle"]) == 0
    capsys.readouterr()
    assert main(["show", "vehicle"]) == 0
    assert (tmp_path / "mine.toml").read_text(encoding="utf-8") == capsys.readouterr().out


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_shell_code_for_evedrop(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    """One for each shell."""
    assert main(["completion", shell]) == 0
    assert "evedrop" in capsys.readouterr().out


def test_a_shell_gets_the_commands_that_begin_alike() -> None:
    """As a shell asks for them: by the environment, on file descriptor 8."""
    line = "evedrop mon"
    asked = {
        **os.environ,
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_SUPPRESS_SPACE": "1",
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
        "COMP_TYPE": "9",
        "IFS": "\n",
    }
    command = [sys.executable, "-m", "evedrop"]
    done = subprocess.run(
        ["bash", "-c", 'exec "$@" 8>&1 9>&2', "_", *command],
        env=asked,
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT,
    )
    assert "montecarlo" in done.stdout
