"""The keys and senders of a wire that was killed are read from their file."""

from __future__ import annotations

from pathlib import Path

from evedrop.wire.journal_part import Words
from evedrop.wire.journal_words import JournalWords, words_in

KEYS, SOURCES, LINKS = ["scan", "örtlich/🤖", 'a "b"\n\\'], ["b1", "ﬀ"], ["up", "down"]


def test_words_are_read_as_they_were_given(tmp_path: Path) -> None:
    """Keys and senders apart, each under the code that its records have, whatever characters it contains."""
    words = JournalWords(tmp_path, 3, lambda _: None)
    keys = {words.key_code(key): key for key in KEYS}
    sources = {words.source_code(source): source for source in SOURCES}
    assert words_in(tmp_path, 3, LINKS) == Words(LINKS, keys, sources)
    assert words.words(LINKS) == Words(LINKS, {0: "", **keys}, {0: "", **sources})
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
