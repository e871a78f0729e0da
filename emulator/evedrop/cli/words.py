"""Advice in the words of Python: what is an option of a command is an argument of a function.

Messages and sentences are written for the command line, because most of them are kept in files, which programs and commands
read. They are put into the words of Python where a program gets to see them, and nowhere else.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from typing import ParamSpec, TypeVar

from evedrop.errors import EvedropError

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

WIDTH = 100
"""Characters of the lines that Python shows."""

_OF_COMMAND: ContextVar[bool] = ContextVar("_OF_COMMAND", default=False)
_ADVICE: Sequence[tuple[re.Pattern[str], str | Callable[[re.Match[str]], str]]] = (
    (re.compile(r"\bmontecarlo --rare\b"), "montecarlo(…, plan=Plan(rare=True))"),
    (
        re.compile(r"\bevedrop compare SCENARIO --schemes (\S+) --out DIR\b"),
        lambda match: f"compare(SCENARIO, schemes={match[1].split(',')}, out=DIR)",
    ),
    (re.compile(r"--(covariance-only|error-coordinates)\b"), r'mode="\1"'),
    (re.compile(r"--(trials|listen|relay)(?: (?=\S)|(?=:))"), r"\1="),
)
"""Advice for a command → the same for a program."""


@contextlib.contextmanager
def words_of_commands() -> Iterator[None]:
    """In the block, the functions speak of options, because a command calls them."""
    token = _OF_COMMAND.set(True)
    try:
        yield
    finally:
        _OF_COMMAND.reset(token)


def for_programs() -> bool:
    """Whether advice is for a program; otherwise it is for the command that is running."""
    return not _OF_COMMAND.get()


def in_python(text: str) -> str:
    """A text for a program in place of a command; the same text while a command runs."""
    if for_programs():
        for advice, words in _ADVICE:
            text = advice.sub(words, text)
    return text


def speaks_python(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """The same function, whose errors advise in the words of Python."""

    @functools.wraps(function)
    def call(*arguments: _Arguments.args, **named: _Arguments.kwargs) -> _Result:
        try:
            return function(*arguments, **named)
        except EvedropError as error:
            error.args = tuple(in_python(part) if isinstance(part, str) else part for part in error.args)
            raise

    return call
