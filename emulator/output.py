"""The output of a command, whose terminal may be gone, or may be a pipe without a reader."""

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


def warn(text: str) -> None:
    """Write a warning to standard error, as `say` does."""
    say(f"warning: {text}")


@contextlib.contextmanager
def named_output() -> Iterator[None]:
    """Mark errors of standard output with its name, so that other errors are not taken for them."""
    if sys.stdout is None:
        yield
    else:
        with contextlib.redirect_stdout(_Named(sys.stdout, OUTPUT)):
            yield


@final
class _Named:
    """A stream whose errors carry a file name."""

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
    """Flush standard output; ignores errors, because another error is being reported."""
    _flush(sys.stdout)


def let_go() -> None:
    """Flush both streams for the last time; if one fails, the interpreter would otherwise exit with a status of its own."""
    for stream in (sys.stdout, sys.stderr):
        _flush(stream)


def silence() -> None:
    """Discard further standard output, including the flush when the interpreter exits."""
    _discard(sys.stdout)


def _flush(stream: TextIO | None) -> None:
    """Flush a stream; discards the text if its reader is gone."""
    try:
        if stream is not None:
            stream.flush()
    except (OSError, ValueError):
        _discard(stream)


def _discard(stream: TextIO | None) -> None:
    with contextlib.suppress(OSError, ValueError):
        if stream is not None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
