"""Names with their descriptions, in two columns that fit the terminal."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping

_LEAST = 20  # columns for a description; on a narrower terminal it is below its name


def name_lines(described: Mapping[str, str], width: int, columns: int) -> Iterator[str]:
    """The lines of the two columns; width: of the first one; columns: of the terminal."""
    below = columns - width < _LEAST
    for name, description in described.items():
        lines = textwrap.wrap(description, max(1, columns - (4 if below else width))) or [""]
        first = "" if below else lines.pop(0)
        yield f"{name:<{width}}{first}".rstrip()
        yield from (" " * (4 if below else width) + line for line in lines)


def print_names(described: Mapping[str, str]) -> None:
    """Print names with their descriptions; one in a line if standard output is not a terminal."""
    on_terminal = sys.stdout.isatty()
    columns = shutil.get_terminal_size().columns if on_terminal else sys.maxsize
    for line in name_lines(described, max(map(len, described)) + 2, columns):
        print(line)
