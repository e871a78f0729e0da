"""Rerun's page for browsers, with its script and its program, read from the file of Rerun's command.

Rerun's command contains these files as they are, and serves them at a port. We read them from the command instead: another user
of the machine may take a port first and serve a page of his own, but he cannot change the installed package.

Source: docs/view.md, who sees it; WebAssembly Core Specification 3.0 (W3C), binary format of modules.
"""

from __future__ import annotations

import mmap
import os
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import final

from evedrop.errors import UsageError

_PIECE = 2**18
_LARGEST_TEXT = 2**22
"""In bytes; the page and the script are shorter."""

_MAGIC = b"\0asm\x01\0\0\0"
_ORDER = (1, 2, 3, 4, 5, 13, 6, 7, 8, 9, 12, 10, 11)
"""The ids of a module's sections in the order in which they come; those of the id 0 come anywhere, and begin with a name."""
_NAMED, _CODE = 0, 10
_MOST_SECTIONS = 1000


@final
class RerunPage:
    """The page, the script and the WebAssembly program of an installed Rerun.

    The command's file stays open, so the parts belong together even if another version is installed meanwhile.
    """

    def __init__(self, command: Path) -> None:
        """command: the file of Rerun's command. Raises UsageError if it cannot be read, or contains no such page."""
        try:
            self._file = os.open(command, os.O_RDONLY | os.O_CLOEXEC)
            weakref.finalize(self, os.close, self._file)  # when no browser is being served any more
            with mmap.mmap(self._file, 0, access=mmap.ACCESS_READ) as content:
                page = _text(content, b"<!doctype html>", b"re_viewer.js", b"</html>")
                self.script = _text(content, b"let wasm_bindgen", b"WebAssembly", b"\n})(")
                self.program = _program(content)
            self.html = b"".join(self.pieces(page)).decode()
        except (OSError, EOFError, ValueError) as error:
            raise UsageError(
                f"the page of the view cannot be read from {command} ({error}); install a version of rerun-sdk that Evedrop is "
                "tested with (tools/constraints/project.txt), or choose the native view or no view"
            ) from error

    def pieces(self, part: range) -> Iterator[bytes]:
        """`script` or `program`, piece by piece. Raises EOFError if the file has been cut short meanwhile."""
        for at in range(part.start, part.stop, _PIECE):
            piece = os.pread(self._file, min(_PIECE, part.stop - at), at)
            if not piece:
                raise EOFError("the file was cut short")
            yield piece


def _text(content: mmap.mmap, begin: bytes, word: bytes, end: bytes) -> range:
    """Where a text is that begins so, contains a word, and whose last line begins with `end`. Raises ValueError."""
    at = content.find(begin)
    while at >= 0:
        stop = content.find(end, at, at + _LARGEST_TEXT)
        if stop >= 0 and content.find(word, at, stop) >= 0:
            return range(at, content.find(b"\n", stop + 1) + 1)
        at = content.find(begin, at + 1)
    raise ValueError(f"it does not contain {begin.decode()} … {word.decode()}")


def _program(content: mmap.mmap) -> range:
    """Where a WebAssembly module is. Raises ValueError."""
    at = content.find(_MAGIC)
    while at >= 0:
        sections = dict(_sections(content, at + len(_MAGIC)))
        if _CODE in sections:
            return range(at, max(sections.values()))
        at = content.find(_MAGIC, at + 1)
    raise ValueError("it does not contain a WebAssembly module")


def _sections(content: mmap.mmap, at: int) -> Iterator[tuple[int, int]]:
    """The sections from a position on, as far as they can be of one module: the id of each, and its end."""
    following = [*_ORDER]
    for _ in range(_MOST_SECTIONS):
        number = content[at] if at < len(content) else -1
        size, begin = _unsigned(content, at + 1)
        at = begin + size
        if number == _NAMED:
            length, name = _unsigned(content, begin)
            if at > len(content) or name + length > at or not content[name : name + length].isascii() or not length:
                return
        elif number in following and at <= len(content):
            following = following[following.index(number) + 1 :]
        else:
            return
        yield number, at


def _unsigned(content: mmap.mmap, at: int) -> tuple[int, int]:
    """A number in LEB128, and the position after it."""
    number = 0
    for i, byte in enumerate(content[at : at + 5]):
        number |= (byte & 0x7F) << 7 * i
        if byte < 0x80:
            return number, at + i + 1
    return len(content), at  # there is no number here: no section is so long
