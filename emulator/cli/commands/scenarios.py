"""`evedrop list` and `evedrop new`: list the shipped scenarios, and write one to start from."""

from __future__ import annotations

import argparse

from evedrop.cli.options import argument
from evedrop.command import Command


def list_scenarios(_: argparse.Namespace) -> int:
    """Print a line for each shipped scenario, even if it needs an extra that is not installed."""
    import tomllib

    from evedrop.loading import shipped

    scenarios = shipped()
    width = max(map(len, scenarios)) + 2
    for name, path in scenarios.items():
        print(f"{name:<{width}}{tomllib.loads(path.read_text(encoding='utf-8'))['title']}")
    return 0


def new(options: argparse.Namespace) -> int:
    """Write a commented scenario to start from."""
    from evedrop.loading import write_new

    write_new(options.file)
    print(f"{options.file} written; change it, then: evedrop run {options.file}")
    return 0


COMMANDS = (
    Command("list", list_scenarios, "the shipped scenarios, one line each"),
    Command("new", new, "write a commented scenario to start from", (argument("file", "FILE"),)),
)
