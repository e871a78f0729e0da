"""The keys and senders of a wire's messages, each with the code that stands for it in records.

A line of the file `NNN.words` has a code and its text, so the records of a wire that was killed can be read. The end of the
file is mapped into memory, as records are: a call of the system for each word costs many times as much, above all since other
threads run meanwhile. Until it is closed, zeros follow the last line.

Source: docs/wire.md, the journal.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import final

from evedrop.wire.journal_part import Words, mapped_end

_ROOM = 2**18  # bytes of the file that are mapped at once, unless a word is longer


@final
class JournalWords:
    """The keys and senders of one start of a wire. Threads may call its methods at the same time."""

    def __init__(
        self,
        unfinished: Path,
        start: int,
        miss: Callable[[OSError], None],
        admits: Callable[[str, str], bool] = lambda _key, _side: True,
    ) -> None:
        """unfinished: the folder of the file; miss: called when the disk has no room for a word.

        admits: whether there is room for a new key of a side, as `KeyLimit`. Raises OSError.
        """
        self._file = os.open(_path(unfinished, start), os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
        self._size = os.fstat(self._file).st_size
        self._map: mmap.mmap | None = None
        self._start = self._end = 0  # of the bytes of the file that are mapped
        self._miss, self._admits = miss, admits
        self._naming, self._admitting = threading.Lock(), threading.Lock()
        self._codes: dict[str, dict[str, int]] = {"key": {"": 0}, "source": {"": 0}}
        self._texts: dict[str, list[str]] = {"key": [""], "source": [""]}

    def key_code(self, key: str, side: str = "") -> int:
        """The code of a key that a program of a side uses; 0 if the key is new and the limit is reached."""
        code = self._codes["key"].get(key)
        if code:
            return code
        with self._admitting:  # another thread may ask for the same key, whose place counts once
            if code := self._codes["key"].get(key):
                return code
            return self._new_code("key", key) if self._admits(key, side) else 0

    def source_code(self, source: str) -> int:
        """The code of a sender; 0 for "", a sender that is not known."""
        return self._codes["source"].get(source) or self._new_code("source", source)

    def key_of(self, code: int) -> str:
        """The key that has a code."""
        return self._texts["key"][code]

    @property
    def key_codes(self) -> Mapping[str, int]:
        """Key → code."""
        return self._codes["key"]

    def words(self, links: list[str]) -> Words:
        """All codes so far and what they stand for. links: the names of the links, in the order of their codes."""
        return Words(links, dict(enumerate(self._texts["key"])), dict(enumerate(self._texts["source"])))

    def close(self) -> None:
        """Close the file."""
        self._unmap()
        os.close(self._file)

    def _new_code(self, what: str, text: str) -> int:
        with self._naming:
            codes, texts = self._codes[what], self._texts[what]
            code = codes.get(text)
            if code is None:
                code = len(texts)
                texts.append(text)
                self._write(f'["{what}", {code}, {json.dumps(text)}]\n'.encode())
                codes[text] = code  # last, because other threads read it without the lock
            return code

    def _write(self, line: bytes) -> None:
        size = self._size + len(line)
        if size > self._end:
            try:
                self._make_room(len(line))
            except OSError as error:
                self._miss(error)
                return
        assert self._map is not None  # noqa: S101 - it ends at `_end`
        self._map[self._size - self._start : size - self._start] = line
        self._size = size

    def _make_room(self, least: int) -> None:
        """Map the rest of the file, and room for some bytes at least. Raises OSError if the disk is full."""
        start = self._size - self._size % mmap.ALLOCATIONGRANULARITY
        length = max(_ROOM, self._size - start + least)
        made = mapped_end(self._file, start, length)
        if self._map is not None:
            self._map.close()
        self._map, self._start, self._end = made, start, start + length

    def _unmap(self) -> None:
        """Let the file end with its last line."""
        if self._map is not None:
            self._map.close()
            self._map, self._start, self._end = None, 0, 0
            os.ftruncate(self._file, self._size)


def words_in(unfinished: Path, start: int, links: list[str]) -> Words:
    """The words of a start that has not ended, from its file."""
    words = Words(links, {}, {})
    with contextlib.suppress(FileNotFoundError):
        for line in _path(unfinished, start).read_bytes().splitlines():
            with contextlib.suppress(ValueError, TypeError, OverflowError, RecursionError):  # the last line may be torn
                what, code, text = json.loads(line)
                (words.keys if what == "key" else words.sources)[int(code)] = (
                    str(text).encode("utf-8", "replace").decode()
                )
    return words


def _path(unfinished: Path, start: int) -> Path:
    return unfinished / f"{start:03d}.words"
