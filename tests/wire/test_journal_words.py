"""The keys and senders of a wire that was killed are read from their file."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from evedrop.wire.journal_words import JournalWords, words_in
from evedrop.wire.records import Words
from tests.disks import simulated

KEYS, SOURCES, LINKS = ["scan", "örtlich/🤖", 'a "b"\n\\'], ["b1", "ﬀ"], ["up", "down"]


def test_words_are_read_as_they_were_given(tmp_path: Path) -> None:
    """Keys and senders apart, each under the code that its records have, whatever characters it contains."""
    words = JournalWords(tmp_path, 3, lambda _: None)
    keys = {words.key_code(key): key for key in KEYS}
    sources = {words.source_code(source): source for source in SOURCES}
    assert words_in(tmp_path, 3, LINKS) == Words(LINKS, keys, sources)
    assert words.words(LINKS) == Words(LINKS, {0: "", **keys}, {0: "", **sources})
    words.close()


class Overtaken(dict[str, int]):
    """Codes of keys. When one is looked up for the first time, another thread names it right after that."""

    def __init__(self, codes: Mapping[str, int]) -> None:
        super().__init__(codes)
        self.then: Callable[[], object] | None = None

    def get(self, key: str, default: Any = None) -> Any:
        """As of any dictionary."""
        value, then, self.then = super().get(key, default), self.then, None
        if then is not None:
            then()
        return value


def test_a_key_that_two_threads_name_at_once_is_admitted_once(tmp_path: Path) -> None:
    """Or else it would take two places of the limit, and be refused by one of the two at its end."""
    asked: list[tuple[str, str]] = []

    def admits(key: str, side: str) -> bool:
        asked.append((key, side))
        return len(asked) == 1

    words = JournalWords(tmp_path, 1, lambda _: None, admits)
    codes = words._codes["key"] = Overtaken(words._codes["key"])
    codes.then = lambda: words.key_code("scan", "base")
    assert words.key_code("scan", "robot") == words.key_code("scan", "base") == 1
    assert asked == [("scan", "base")]
    words.close()


def test_words_of_any_length_and_number_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file grows with them, and ends with the last one when it is closed."""
    monkeypatch.setattr("evedrop.wire.journal_words._ROOM", mmap.ALLOCATIONGRANULARITY)
    words = JournalWords(tmp_path, 1, lambda _: None)
    keys = {words.key_code(key): key for n in range(300) for key in (f"key/{n}", f"{n}/{'ö' * 40 * n}")}
    keys[words.key_code("last")] = "last"  # after which the file has room for more
    assert len(keys) == 601
    assert words_in(tmp_path, 1, LINKS) == Words(LINKS, keys, {})
    words.close()
    assert words_in(tmp_path, 1, LINKS) == Words(LINKS, keys, {})
    assert (tmp_path / "001.words").read_bytes().endswith(b'"]\n')


def test_a_word_for_which_the_disk_has_no_room_has_its_code_all_the_same(tmp_path: Path) -> None:
    """The file lacks it, and goes on with those after it once there is room."""
    missed: list[OSError] = []
    with simulated(tmp_path) as (_, disk):
        words = JournalWords(disk.root, 1, missed.append)
        disk.room = 0
        assert [words.key_code(key) for key in ("a", "b", "a")] == [1, 2, 1]
        disk.make_room()
        assert [error.errno for error in missed] == [28, 28]
        assert words.key_code("c") == 3
        assert words_in(disk.root, 1, LINKS) == Words(LINKS, {3: "c"}, {})
        assert words.words(LINKS).keys == {0: "", 1: "a", 2: "b", 3: "c"}
        words.close()


def test_a_start_without_words_has_none(tmp_path: Path) -> None:
    """And those of another start are not taken."""
    words = JournalWords(tmp_path, 1, lambda _: None)
    words.key_code("scan")
    words.close()
    assert words_in(tmp_path, 2, LINKS) == Words(LINKS, {}, {})


def test_a_line_that_is_torn_or_damaged_names_nothing(tmp_path: Path) -> None:
    """The other lines do; what is not UTF-8 text in JSON becomes text that a table can hold."""
    lines = [
        b'["key", 1, "scan"]',
        b'["key", "x", "pose"]',
        b'["key", 2]',
        b"7",
        b"[" * 100_000,
        b'["source", 1e999, "b"]',
        b'["key", 3, "\\ud800"]',
        b'["source", 1, 5]',
        b'["key", 4, "sc',
    ]
    (tmp_path / "001.words").write_bytes(b"\n".join(lines))
    assert words_in(tmp_path, 1, LINKS) == Words(LINKS, {1: "scan", 3: "?"}, {1: "5"})
