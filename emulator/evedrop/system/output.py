"""The output of a command: a reader that has left, a full disk and a narrow encoding end no work, and leave no file unwritten.

A command writes to `sys.stdout` and `sys.stderr` as if that could not fail. What cannot be written is lost; what the encoding
lacks is spelled in ASCII. Text may come from others: from the author of a class, of a results folder, of a message. So control
characters, which could steer the terminal or reorder what it shows, are written escaped.
"""

from __future__ import annotations

import codecs
import contextlib
import io
import json
import os
import re
import sys
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any, TextIO, cast, final

_SPELLED = "evedrop.spelled"
"""The name of the error handler that spells characters in ASCII."""
_SPELLINGS = {
    "−": "-", "–": "-", "—": "-", "·": "-", "─": "-", "…": "...", "±": "+/-", "×": "x", "÷": "/", "≥": ">=", "≤": "<=",
    "≈": "~", "√": "sqrt ", "∞": "inf", "°": " deg ", "‰": " per mille", "€": "EUR", "′": "'", "’": "'", "‘": "'", "“": '"',
    "”": '"', "„": '"', "µ": "mu", "✔": "V", "✓": "v", "✗": "x",
    "\N{COMBINING CIRCUMFLEX ACCENT}": "_hat", "\N{COMBINING TILDE}": "_tilde",
    "\N{COMBINING MACRON}": "_bar",
}  # fmt: skip
_GREEK = re.compile("GREEK (SMALL|CAPITAL) LETTER (?:FINAL )?([A-Z]+)$")
_MARKS = {"<super>": "^", "<sub>": "_"}
"""The beginning of a character's decomposition → the mark of an exponent, of an index."""
_BIDIRECTIONAL = "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"
"""The characters that change the direction of text, as they stand in the brackets of a regular expression."""
_STEERING = re.compile(f"[\0-\x08\x0b-\x1f\x7f-\x9f{_BIDIRECTIONAL}]")


def escaped(text: str) -> str:
    r"""Text with its control characters escaped, such as \x1b and \u202e; tabs and ends of lines stay.

    These are C0, DEL, C1, and the characters that change the direction of text.
    """
    if text.isascii() and text.isprintable():
        return text
    return _STEERING.sub(
        lambda match: rf"\x{ord(match[0]):02x}" if match[0] < "\xa0" else rf"\u{ord(match[0]):04x}", text
    )


def columns_of(stream: TextIO) -> int | None:
    """The width of a stream's terminal, in columns, or that of the variable COLUMNS; None if it is not a terminal."""
    if not stream.isatty():
        return None
    with contextlib.suppress(ValueError):
        if (columns := int(os.environ.get("COLUMNS", ""))) > 0:
            return columns
    try:
        return os.get_terminal_size(stream.fileno()).columns or _USUAL_COLUMNS
    except OSError:
        return _USUAL_COLUMNS


_USUAL_COLUMNS = 80
_WORD = re.compile(r"\s*\S+")
_EXCERPT = re.compile(r"\s+\d* \| ")  # of a file, with carets below it, which must stay below
_ARGUMENT = re.compile(r"""\s*(?:'[^']*'|"[^"]*"|\S)+""")


def wrapped(text: str, columns: int | None, hanging: int = 2) -> str:
    """Text in lines of at most this many columns, broken between words; the lines of a paragraph hang below its first.

    A word that is longer than a line, such as a path, stays whole. columns: None leaves the text as it is.
    """
    if columns is None:
        return text
    lines = _within_excerpts(text.split("\n"), columns)
    return "\n".join("\n".join(_broken(line, columns, hanging, _WORD)) for line in lines)


def _within_excerpts(lines: list[str], columns: int) -> list[str]:
    """The lines of a text; those of an excerpt without their beginning, where the carets below would otherwise be cut off."""
    shown = list(lines)
    for i in range(1, len(lines)):
        margin = _EXCERPT.match(lines[i])
        if margin is None or not _EXCERPT.match(lines[i - 1]) or "^" not in lines[i]:
            continue
        begin = margin.end()
        most = columns - 1 - min(lines[i].count("^"), columns // 2)  # where the carets may begin
        beyond = lines[i].index("^") - most
        if beyond > 0:
            cut = begin + beyond + 1
            shown[i - 1] = f"{lines[i - 1][:begin]}…{lines[i - 1][cut:]}"
            shown[i] = f"{lines[i][:begin]} {lines[i][cut:]}"
    return shown


def wrapped_command(line: str, columns: int | None) -> str:
    """A command of the shell, with a backslash wherever it is broken between arguments."""
    return line if columns is None else " \\\n".join(_broken(line, columns - 2, 4, _ARGUMENT))


def _broken(line: str, columns: int, hanging: int, part: re.Pattern[str]) -> list[str]:
    if _EXCERPT.match(line):
        return [line if len(line) <= columns else f"{line[: columns - 1]}…"]
    lines, room = [""], columns
    indent = " " * (len(line) - len(line.lstrip()) + hanging)
    for word in part.findall(line):
        if lines[-1].strip() and (wide := _cells(word)) > room:
            lines.append(indent + word.lstrip())
            room = columns - len(indent) - wide + len(word) - len(word.lstrip())
        else:
            lines[-1] += word
            room -= _cells(word)
    return lines


def _cells(text: str) -> int:
    """The columns that a text takes."""
    if text.isascii():
        return len(text)
    import unicodedata  # noqa: PLC0415 - as below

    return sum(
        0 if unicodedata.combining(character) else 1 + (unicodedata.east_asian_width(character) in "WF")
        for character in text
    )


def takes_styles(stream: TextIO) -> bool:
    """Whether a stream is a terminal that knows styles and movements of the cursor, as far as TERM says."""
    return stream.isatty() and os.environ.get("TERM", "").lower() not in {"", "dumb", "unknown"}


RED, YELLOW = "\x1b[1;31m", "\x1b[33m"
_PLAIN = "\x1b[0m"


def tell(text: str, alarm: str = "", colour: str = RED, stream: TextIO | None = None) -> None:
    """Write a paragraph, wrapped between words on a terminal; alarm: the word that is coloured there, unless NO_COLOR is set."""
    stream = sys.stdout if stream is None else stream
    shown = escaped(wrapped(text, columns_of(stream))) + "\n"
    if alarm and takes_styles(stream) and not os.environ.get("NO_COLOR"):
        shown = shown.replace(alarm, f"{colour}{alarm}{_PLAIN}", 1)
    getattr(stream, "styled", stream).write(shown)


def say(text: str, alarm: str = "", colour: str = RED) -> None:
    """Write a line to standard error as `tell` does, unless its terminal is gone."""
    with contextlib.suppress(OSError, AttributeError):
        tell(f"evedrop: {text}", alarm, colour, sys.stderr)


_WARNING = "warning:"


def warn(text: str) -> None:
    """Write a warning to standard error, as `say` does."""
    say(f"{_WARNING} {text}", _WARNING, YELLOW)


def is_warning(line: str) -> bool:
    """Whether `warn` wrote this line, not on a terminal."""
    return line.startswith(f"evedrop: {_WARNING}")


_OF_JSON: ContextVar[TextIO | None] = ContextVar("of_json", default=None)
"""Where JSON is printed, while all else that is printed goes to standard error."""


@contextlib.contextmanager
def json_alone() -> Iterator[None]:
    """Let standard output have JSON alone during the block: what a class of the user's prints goes to standard error."""
    token = _OF_JSON.set(sys.stdout)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        _OF_JSON.reset(token)


def print_json(value: object) -> None:
    """Print a value as one line of JSON, whose content does not depend on the encoding of standard output."""
    out = _OF_JSON.get() or sys.stdout
    encoding = getattr(out, "encoding", None) or "utf-8"
    text = json.dumps(value, ensure_ascii=codecs.lookup(encoding).name != "utf-8")
    text = _STEERING.sub(lambda match: f"\\u{ord(match[0]):04x}", text)  # which JSON would leave as they are
    out.write(f"{text}\n")


def _descriptor(stream: io.TextIOWrapper) -> int | None:
    """The file descriptor of a stream; None for one without, as where tests or notebooks take the output."""
    try:
        return stream.fileno()
    except OSError:
        return None


@final
class Output:
    """A text stream that never fails, and escapes control characters; after the first error, what is written to it is lost."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._terminal = stream.isatty()
        self.failed: OSError | None = None
        """The first error, unless the reader or the terminal is gone, which is what its user wanted."""
        self._over = False

    def write(self, text: str) -> int:
        """Write text with its control characters escaped, if that is possible; returns its length."""
        self.write_styled(escaped(text))
        return len(text)

    def write_styled(self, text: str) -> None:
        """Write text as it is, if that is possible."""
        if not self._over:
            try:
                self._stream.write(text)
            except OSError as error:
                self._end(error)

    @property
    def styled(self) -> Styled:
        """The same stream for text that styles and moves the cursor on purpose."""
        return Styled(self)

    def flush(self) -> None:
        """Write what is buffered, if that is possible."""
        if not self._over:
            try:
                self._stream.flush()
            except OSError as error:
                self._end(error)

    @contextlib.contextmanager
    def at(self, descriptor: int, of: int) -> Iterator[None]:
        """While the block runs, write to another descriptor of the same file, if the stream's own is `of`."""
        former = self._stream
        if not isinstance(former, io.TextIOWrapper) or _descriptor(former) != of:
            yield
            return
        self.flush()
        with open(descriptor, "w", encoding=former.encoding, errors=former.errors, closefd=False) as stream:
            stream.reconfigure(line_buffering=former.line_buffering or former.write_through)
            self._stream = stream
            try:
                yield
            finally:
                self.flush()
                self._stream = former

    def _end(self, error: OSError) -> None:
        self._over = True
        if not (self._terminal or isinstance(error, ConnectionError)):
            self.failed = error
        # The interpreter flushes the buffer again when it exits.
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@final
class Styled:
    """An `Output` without escaping, for a console that escapes the text of others by itself."""

    def __init__(self, output: Output) -> None:
        self._output = output

    def write(self, text: str) -> int:
        """Write text as it is, if that is possible; returns its length."""
        self._output.write_styled(text)
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._output, name)


@contextlib.contextmanager
def standard_streams() -> Iterator[Output]:
    """Replace standard output and standard error by streams that never fail; gives standard output.

    A stream that the shell has closed is replaced by one that goes nowhere.
    """
    codecs.register_error(_SPELLED, _spelled)
    with contextlib.ExitStack() as stack:
        out, err = (stack.enter_context(_unfailing(stream)) for stream in (sys.stdout, sys.stderr))
        stack.enter_context(contextlib.redirect_stderr(cast(TextIO, err)))
        stack.enter_context(contextlib.redirect_stdout(cast(TextIO, out)))
        yield out


@contextlib.contextmanager
def _unfailing(stream: TextIO | None) -> Iterator[Output]:
    """An output to a stream, which is flushed in the end."""
    with contextlib.ExitStack() as stack:
        if stream is None:
            stream = stack.enter_context(open(os.devnull, "w", encoding="utf-8"))
        if isinstance(stream, io.TextIOWrapper):
            stack.callback(_set_errors, stream, stream.errors)
            _set_errors(stream, _SPELLED)
        output = Output(stream)
        stack.callback(output.flush)
        yield output


def _set_errors(stream: io.TextIOWrapper, errors: str | None) -> None:
    with contextlib.suppress(OSError, ValueError):  # it flushes first
        stream.reconfigure(errors=errors)


def spelled(text: str, encoding: str) -> str:
    """A text as a stream of this encoding shows it, for who must know its width."""
    if text.isascii() or codecs.lookup(encoding).name == "utf-8":
        return text
    codecs.register_error(_SPELLED, _spelled)
    return text.encode(encoding, _SPELLED).decode(encoding)


def _spelled(error: UnicodeError) -> tuple[str, int]:
    """Replace characters that an encoding lacks; an error handler, see `codecs.register_error`."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    parts: list[str] = []
    before = ""
    for character in error.object[error.start : error.end]:
        mark, text = _spelling(character)
        parts += [text] if mark == before else [mark, text]
        before = mark
    return "".join(parts), error.end


def _spelling(character: str) -> tuple[str, str]:
    """A mark, ^ for an exponent and _ for an index, and a character in ASCII: by its name if Greek, otherwise by its number."""
    import unicodedata  # noqa: PLC0415 - few commands need it

    if character in _SPELLINGS:
        return "", _SPELLINGS[character]
    if match := _GREEK.match(unicodedata.name(character, "")):
        return "", match[2].capitalize() if match[1] == "CAPITAL" else match[2].lower()
    how, *numbers = unicodedata.decomposition(character).split() or [""]
    if how in _MARKS and len(numbers) == 1:
        base = chr(int(numbers[0], 16))
        return _MARKS[how], base if base.isascii() else _spelling(base)[1]
    return "", character.encode("ascii", "backslashreplace").decode()
