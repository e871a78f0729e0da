"""`evedrop list`, `evedrop show` and `evedrop new`: list and print the built-in scenarios, and write one to start from."""

from __future__ import annotations

import argparse

from evedrop.cli.command import Command
from evedrop.cli.options import argument


def list_scenarios(_: argparse.Namespace) -> int:
    """Print the name and title of each built-in scenario, even if it needs an extra that is not installed."""
    import tomllib

    from evedrop.cli.names import print_names
    from evedrop.scenarios import shipped

    print_names({name: tomllib.loads(path.read_text(encoding="utf-8"))["title"] for name, path in shipped().items()})
    return 0


def new(options: argparse.Namespace) -> int:
    """Write a scenario to start from."""
    from evedrop.scenarios import write_new

    write_new(options.file, options.origin)
    print(f"{options.file} written; change it, then: evedrop run {options.file}")
    return 0


def show(options: argparse.Namespace) -> int:
    """Print the file of a built-in scenario."""
    from evedrop.scenarios import built_in_text

    print(built_in_text(options.name), end="")
    return 0


def _origin(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--from", dest="origin", metavar="NAME", help="copy this built-in scenario")


def _name(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="the name of a built-in scenario, as evedrop list prints it")


COMMANDS = (
    Command("list", list_scenarios, "list built-in scenarios", section="make", example="list", page="scenario"),
    Command(
        "show",
        show,
        "print the file of a built-in scenario",
        (_name,),
        section="make",
        example="show vehicle",
        page="scenario",
    ),
    Command(
        "new",
        new,
        "write a scenario to start from: commented, or a copy of a built-in one",
        (argument("file", "FILE"), _origin),
        section="make",
        example="new my-scenario.toml --from vehicle",
        page="scenario",
    ),
)
