"""What to try next: the last line of a command on a terminal, and what `evedrop` alone says.

The line is advice for a person: it is printed on a terminal only, after success, and never with `--json` or `--quiet`.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from typing import TYPE_CHECKING

from evedrop.cli.commands import ROLES
from evedrop.cli.parser import name_lines
from evedrop.system.output import columns_of, tell

if TYPE_CHECKING:
    from evedrop.cli.command import Command

_USUAL = 100  # columns, where there is no terminal
_START = {
    "evedrop demo": "a vehicle and three eavesdroppers, live: a minute",
    "evedrop montecarlo vehicle --trials 200": "the same 200 times, in memory",
    "evedrop wire --example > robot.toml": "bad links between your own programs",
    "evedrop docs tutorial": "fifteen minutes, step by step",
    "evedrop --help": "all commands",
}
"""Command → what it does."""
_NEXT = {
    "list": ("to run one live", "run vehicle"),
    "show": ("to change a copy of it", "new my-scenario.toml --from {name}"),
    "check": ("to run it live", "run {scenarios[0]}"),
    **dict.fromkeys(("demo", "run"), ("to repeat it 200 times in memory", "montecarlo {scenario} --trials 200")),
    "montecarlo": ("to watch a trial live", "run {scenario}"),
    "wire": ("to see it again", "view {out}"),
    "wire --check": ("to start it", "wire {file}"),
    "partition": ("to end it", "heal {run} {one} {other}"),
    "pause": ("to advance it by a slot", "step {run} 1"),
    "step": ("to let it run", "resume {run}"),
    **dict.fromkeys(("link", "heal", "resume"), ("to see the effect", "status {run}")),
    "view": ("to put everything on one page", "report {run}"),
    "selftest": ("to see a run", "demo"),
    "docs": ("to begin", "docs tutorial"),
}
"""Command → why, and what to type after `evedrop`, with options of the command in braces. Other commands lead to their pages."""
_ALONE = ("new", "wire --example", "docs PAGE", "completion", "health", "host", *ROLES)
"""Commands without such a line: `new` says what comes next into a pipe too, and programs read or start the others."""


def print_start() -> None:
    """Say on standard error what Evedrop is, and what to try first."""
    columns = columns_of(sys.stderr) or _USUAL
    tell("Evedrop shows who can follow a process over a lossy network, and who cannot.\n", stream=sys.stderr)
    for line in name_lines(_START, max(map(len, _START)) + 2, columns - 2):
        tell(f"  {line}", stream=sys.stderr)


def print_next_step(command: Command, options: argparse.Namespace) -> None:
    """Print the line, where a person reads it."""
    if not sys.stdout.isatty() or getattr(options, "json", False) or getattr(options, "quiet", False):
        return
    if (step := next_step(command, options)) is not None:
        why, words = step
        tell(f"next, {why}: {shlex.join(['evedrop', *words])}")


def next_step(command: Command, options: argparse.Namespace) -> tuple[str, list[str]] | None:
    """Why, and the words of a command after `evedrop`; None for a command that stands alone."""
    use = _use(command.name, options)
    if use in _ALONE or not (use in _NEXT or command.page):
        return None
    why, words = _NEXT.get(use, ("to read more", f"docs {command.page}"))
    return why, [word.format_map(vars(options)) for word in words.split()]


def _use(name: str, options: argparse.Namespace) -> str:
    """The name of a command, with what makes it another one."""
    if name == "wire":
        return "wire --example" if options.example else "wire --check" if options.check else name
    if name == "docs":
        return "docs PAGE" if options.page else name
    return "check CLASS" if name == "check" and not options.scenarios else name
