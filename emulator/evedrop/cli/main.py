"""The command line: finds the command, and handles errors. The commands are in evedrop.cli.commands."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from evedrop.cli.commands import GROUP, MODULES, ROLES
from evedrop.cli.next_step import print_next_step, print_start
from evedrop.cli.parser import Parser
from evedrop.cli.tables import written_tables
from evedrop.cli.words import words_of_commands
from evedrop.errors import EvedropError, Interrupted, RunError, UsageError
from evedrop.system.files import shown
from evedrop.system.lacks import lack_of, refuse_scipy_without_room, report_refusal
from evedrop.system.output import json_alone, say, standard_streams, warn

if TYPE_CHECKING:
    from evedrop.cli.command import Command

__all__ = ["is_role", "main", "parser_of", "status_of"]

_Parsers: TypeAlias = "argparse._SubParsersAction[Parser]"


def is_role(arguments: Sequence[str]) -> bool:
    """Whether the arguments begin with the role of a process."""
    return bool(arguments) and arguments[0] in ROLES


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns its exit status, which output that cannot be written makes 2 only if it would be 0."""
    with standard_streams() as output:
        status = status_of(sys.argv[1:] if arguments is None else list(arguments))
        output.flush()
        if output.failed is not None and status in {0, 1}:  # otherwise an error has been reported
            say(f"standard output: {output.failed.strerror}; free some space, or check its permissions")
            return status or UsageError.exit_status
        return status


def status_of(given: list[str], parser: Parser | None = None) -> int:
    """Run the command line, and report its errors and what the machine lacks; parser: for its first word, if there is one."""
    if not given and "_ARGCOMPLETE" not in os.environ:
        print_start()
        return UsageError.exit_status
    refuse_scipy_without_room()
    try:
        return _status_of_command(given, parser)
    except BaseException as error:  # a panic of Zenoh is not an Exception
        if (lack := lack_of(error)) is None:
            raise
    say(lack)  # after the error has been let go of, and the memory that it holds
    return RunError.exit_status


def _status_of_command(given: list[str], parser: Parser | None) -> int:
    if "_ARGCOMPLETE" in os.environ:  # a shell asks for completions
        import argcomplete

        argcomplete.autocomplete(parser_of())
    try:
        options = (parser or parser_of(given[0] if given else "")).parse_whole(given)
    except SystemExit as left:  # argparse has printed the help, or said what it expected
        return int(left.code or 0)
    except (
        EvedropError
    ) as error:  # importing a command's module refuses the value of a variable such as EVEDROP_KERNELS
        say(error.illustrated, "evedrop:")
        return error.exit_status
    command: Callable[[argparse.Namespace], int] = options.command
    described: Command = options.described
    try:
        _check_names(options)
        alone = json_alone() if getattr(options, "json", False) else nullcontext()
        with alone, written_tables(options), words_of_commands():
            status = command(options)
        if status == 0:
            print_next_step(described, options)
        return status
    except EvedropError as error:
        sys.stdout.flush()
        say(error.illustrated, "evedrop:")
        if error.resumable is not None and hasattr(options, "resume"):
            say(f"go on with: {_resuming(given, options, error.resumable)}")
        return error.exit_status
    except KeyboardInterrupt:
        return Interrupted.exit_status
    except OSError as error:
        if lack_of(error) is not None:
            raise
        sys.stdout.flush()
        return report_refusal(error)


def _resuming(given: Sequence[str], options: argparse.Namespace, folder: str) -> str:
    """The command that goes on with the study that a command line began, in a folder."""
    place = [] if str(options.out) == folder else ["--out", folder]
    resume = [] if options.resume else ["--resume"]
    return shlex.join(["evedrop", *given, *place, *resume])


def _check_names(options: argparse.Namespace) -> None:
    """Raise UsageError for file names that results and messages cannot show."""
    try:
        here = str(Path.cwd())
    except OSError:
        return
    texts = [text for value in vars(options).values() for text in (value if isinstance(value, list) else [value])]
    for text in [here, *texts]:
        if isinstance(text, (str, Path)) and shown(text) != str(text):
            subject = "the current folder" if text is here else "it"
            raise UsageError(
                f"{shown(text)}: {subject} is not named in UTF-8, as results and messages are; use another name"
            )


def parser_of(first: str = "") -> Parser:
    """The parser; first: the first argument. If it names a command, only that command's module is loaded."""
    parser = Parser(
        prog="evedrop",
        description="A network emulator for secrecy in remote state estimation, and fault injection for programs that use Zenoh.",
        epilog="first: evedrop demo, then evedrop docs tutorial. evedrop COMMAND --help describes a command; "
        "evedrop docs lists the pages of the documentation.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version")
    top = parser.add_commands()
    groups: dict[str, _Parsers] = {}
    for command in _commands(first):
        where, does = top, command.does
        if command.group is not None:
            if command.group not in groups:
                groups[command.group] = _added(top, command.group, f"commands about {command.group}").add_commands()
            where = groups[command.group]
        added = _added(where, command.name, does, _epilog(command))
        added.set_defaults(command=command.run, described=command, parser=added)
        for option in command.options:
            option(added)
        name = command.name if command.group is None else f"{command.group} {command.name}"
        parser.sections.setdefault(command.section, {})[name] = does
    return parser


def _added(parsers: _Parsers, name: str, does: str, epilog: str = "") -> Parser:
    return parsers.add_parser(name, help=does, description=f"{does[0].upper()}{does[1:]}.", epilog=epilog)


def _epilog(command: Command) -> str:
    """An example, and where to read more."""
    lines = [f"example:\n  evedrop {command.example}"] if command.example else []
    lines += [f"more: evedrop docs {command.page}"] if command.page else []
    return "\n\n".join(lines)


def _commands(first: str) -> Iterator[Command]:
    """The commands in the module of this first word; all commands if it is not the first word of a built-in one."""
    modules = [MODULES[first]] if first in MODULES else list(dict.fromkeys(MODULES.values()))
    commands: list[Command] = []
    for name in modules:
        commands += import_module(f"evedrop.cli.commands.{name}").COMMANDS
    order = [*MODULES]
    yield from sorted(commands, key=lambda command: order.index(command.group or command.name))
    if first not in MODULES:
        yield from _commands_of_packages()


def _commands_of_packages() -> Iterator[Command]:
    """The commands of installed packages; warns of those that cannot be loaded, or that have the name of another."""
    from importlib.metadata import entry_points

    taken = {*MODULES}
    for point in entry_points(group=GROUP):
        try:
            commands = _usable(import_module(point.value).COMMANDS)
        except Exception as error:  # a mistake in the package
            warn(f"the commands of {point.value} cannot be loaded ({type(error).__name__}: {error})")
            continue
        for command in commands:
            if command.name in taken or command.group is not None:
                warn(f"the command {command.name} of {point.value} is left out: expected a new name, and no group")
            else:
                taken.add(command.name)
                yield command


def _usable(commands: Iterable[Command]) -> list[Command]:
    """The commands of a package. Raises whatever is wrong with them, or with the functions that add their options."""
    from evedrop.cli.command import Command

    listed = list(commands)
    for command in listed:
        if not isinstance(command, Command):
            raise TypeError(f"COMMANDS has {command!r:.60}, which is no Command")
        tried = Parser()
        for option in command.options:
            option(tried)
    return listed


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"evedrop {version('evedrop')}")
        parser.exit()
