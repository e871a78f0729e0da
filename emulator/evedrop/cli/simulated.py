"""What `evedrop` is in the simulated world: its commands, called in the interpreter in which all programs of a run live."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

from evedrop.cli.main import parser_of, status_of

_parser = cache(parser_of)


def program(words: Sequence[str]) -> int:
    """Carry out a command; returns its exit status."""
    return status_of(list(words), _parser(words[0]))
