"""What a command writes to its terminal, which may be gone, or be a pipe that nobody reads any more."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any, TextIO, TypeVar, final

T = TypeVar("T")

OUTPUT = "standard output"
"""The file name in errors of standard output."""


def say(text: str) -> None:
    """Write a line to standard error, unless its terminal is gone."""
    with contextlib.suppress(OSError, AttributeError):
        sys.stderr.write(f"evedrop: {text}\n")


@contextlib.contextmanager
def named_output() -> Iterator[None]:
    """Have errors of standard output say that they are: no other may be taken for one."""
    if sys.stdout is None:
        yield
    else:
        with contextlib.redirect_stdout(_Named(sys.stdout, OUTPUT)):
            yield


@final
class _Named:
    """A stream whose errors have a file name."""

    def __init__(self, stream: TextIO, name: str) -> None:
        self._stream = stream
        self._name = name

    def write(self, text: str) -> int:
        return self._tried(lambda: self._stream.write(text))

    def flush(self) -> None:
        self._tried(self._stream.flush)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _tried(self, act: Callable[[], T]) -> T:
        try:
            return act()
        except OSError as error:
            error.filename = self._name
            raise


def finish() -> None:
    """Write what is left for standard output; nobody need take it, for something else has gone wrong."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        silence()


def silence() -> None:
    """Have nothing more written to standard output, not even at the interpreter's end."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
