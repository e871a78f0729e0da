"""The words of a wire's records: the keys and senders, for which the records have codes.

A line of the file `NNN.words` has a code and its text, so the records of a wire that was killed can be read. The end of the file
is mapped into memory, as records are: a call of the system for each word costs many times as much, above all since other threads
run meanwhile. Until it is closed, zeros follow the last line. Since a wire keeps the records of a key until it ends, there is a
limit on the keys that programs use: one for each side, so that programs of one side cannot use up the keys of others.

Source: docs/wire/results.md, the journal; docs/wire/semantics.md, many keys.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import final

from evedrop.system.files import lines_in
from evedrop.system.world import world
from evedrop.wire.history import Numbered
from evedrop.wire.plan import WireLink, numbered_as
from evedrop.wire.records import (
    Words,
)

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
        self._file = world().disk.open(_path(unfinished, start), "a+b")
        self._size = os.fstat(self._file.fileno()).st_size
        self._map: mmap.mmap | None = None
        self._start = self._end = 0  # of the bytes of the file that are mapped
        self._miss, self._admits = miss, admits
        self._naming, self._admitting = world().lock(), world().lock()
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

    def words(self, links: Sequence[str]) -> Words:
        """All codes so far and what they stand for. links: the names of the links, in the order of their codes."""
        return Words(links, dict(enumerate(self._texts["key"])), dict(enumerate(self._texts["source"])))

    def close(self) -> None:
        """Close the file."""
        self._unmap()
        self._file.close()

    def _new_code(self, kind: str, text: str) -> int:
        with self._naming:
            codes, texts = self._codes[kind], self._texts[kind]
            code = codes.get(text)
            if code is None:
                code = len(texts)
                texts.append(text)
                self._write(f'["{kind}", {code}, {json.dumps(text)}]\n'.encode())
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
        made = world().disk.map(self._file, start, length)
        if self._map is not None:
            self._map.close()
        self._map, self._start, self._end = made, start, start + length

    def _unmap(self) -> None:
        """Let the file end with its last line."""
        if self._map is not None:
            self._map.close()
            self._map, self._start, self._end = None, 0, 0
            with contextlib.suppress(OSError):  # zeros after the last line do no harm
                self._file.truncate(self._size)


def words_in(unfinished: Path, start: int, links: list[str]) -> Words:
    """The words of a start that has not ended, from its file."""
    words = Words(links, {}, {})
    with contextlib.suppress(FileNotFoundError):
        for line in lines_in(_path(unfinished, start)):
            with contextlib.suppress(ValueError, TypeError, OverflowError, RecursionError):  # a line may be damaged
                kind, code, text = json.loads(line)
                (words.keys if kind == "key" else words.sources)[int(code)] = (
                    str(text).encode("utf-8", "replace").decode()
                )
    return words


def _path(unfinished: Path, start: int) -> Path:
    return unfinished / f"{start:03d}.words"


MOST_KEYS = 2**18
"""The keys that a wire keeps for the programs of a side; each takes some 1 kB."""
MOST_CHARACTERS = 2**25
"""The characters of these keys."""


@final
class KeyLimit:
    """The keys of a wire that are new, counted for each side. Threads may call its methods at the same time."""

    def __init__(self, links: Iterable[WireLink], earlier: Iterable[Numbered], tell: Callable[[str], None]) -> None:
        """earlier: the streams that earlier starts numbered; their keys count, too. tell: for warnings.

        The stream of `KEY/@adv/…` counts as a key until one of these comes, for there is no telling how many there were.
        """
        self._tell = tell
        self._used: dict[str, tuple[int, int]] = {}  # side → keys, characters
        self._full: set[str] = set()
        self._earlier: set[str] = set()
        self._lock = world().lock()
        sources = {link.name: link.source for link in links}
        for link, key, _ in earlier:
            if key not in self._earlier:
                self._earlier.add(key)
                self._take(key, sources.get(link, ""))

    def admits(self, key: str, side: str) -> bool:
        """Whether there is room for a new key that a program of a side uses; then it has its place from now on."""
        with self._lock:
            if key in self._earlier:
                return True
            if (numbered := numbered_as(key)) in self._earlier:  # the first such key has the place of its stream
                self._earlier.remove(numbered)
                return True
            keys, characters = self._used.get(side, (0, 0))
            if keys < MOST_KEYS and characters + len(key) <= MOST_CHARACTERS:
                self._take(key, side)
                return True
            if side in self._full:
                return False
            self._full.add(side)
        self._tell(
            f"programs at the side {side} have used {keys:,} keys of {characters:,} characters, and the wire keeps no more of "
            "them; messages with new keys are dropped as too_many_keys; let these programs use fewer keys"
        )
        return False

    def _take(self, key: str, side: str) -> None:
        keys, characters = self._used.get(side, (0, 0))
        self._used[side] = (keys + 1, characters + len(key))
