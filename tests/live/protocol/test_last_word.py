"""The last word of a process: read as it was left, and nothing else is taken for one."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from evedrop.errors import EvedropError, Gap, MalformedMessage, MissingProcesses, NoRouter, Refusal, RunError
from evedrop.live.protocol.last_word import Cause, LastWord, last_word_file, read_last_word

ERRORS: list[tuple[EvedropError, Cause, tuple[str, ...]]] = [
    (MissingProcesses("eve", ("router", "recorder"), "in time"), Cause.MISSING_PROCESSES, ("router", "recorder")),
    (MalformedMessage("evedrop/r/uplink", "3", "4", b"x"), Cause.BROKEN_PROTOCOL, ("sensor",)),
    (Gap("evedrop/r/downlink/eve", 3, 4), Cause.BROKEN_PROTOCOL, ("router",)),
    (Refusal("router", "evedrop/r/uplink", "sensor", "why"), Cause.BROKEN_PROTOCOL, ("sensor",)),
    (MalformedMessage("operator", "3", "4", b"x"), Cause.FAILURE, ()),
    (NoRouter("nobody"), Cause.NO_CONNECTION, ()),
    (RunError("\u00e9"), Cause.FAILURE, ()),
]


@pytest.mark.parametrize(("error", "cause", "blamed"), ERRORS)
def test_a_last_word_is_read_as_it_was_left(
    error: EvedropError, cause: Cause, blamed: tuple[str, ...], tmp_path: Path
) -> None:
    """It has the sentence of the error, and the processes that the error blames."""
    file = last_word_file(tmp_path, "eve")
    LastWord.about(error).leave(file)
    assert read_last_word(file) == LastWord(cause, str(error), blamed)


def test_a_last_word_cannot_steer_a_terminal(tmp_path: Path) -> None:
    """Its sentence is shown as text."""
    LastWord(Cause.FAILURE, "\x1b[2J").leave(tmp_path / "word")
    assert read_last_word(tmp_path / "word") == LastWord(Cause.FAILURE, "\\x1b[2J")


def test_nobody_need_ask_and_a_full_disk_is_no_failure(tmp_path: Path) -> None:
    """The process ends as it would have."""
    LastWord(Cause.FAILURE, "why").leave(None)
    LastWord(Cause.FAILURE, "why").leave(tmp_path / "gone" / "word")
    assert list(tmp_path.iterdir()) == []


GOOD = {"cause": "failure", "sentence": "why"}
MALFORMED = [
    b"",
    b"\xff",
    b"[]",
    b"[" * 100_000,
    json.dumps(GOOD).encode()[:-3],
    *(
        json.dumps({**GOOD, **change}).encode()
        for change in ({"cause": "boredom"}, {"sentence": 3}, {"blamed": [3]}, {"k": 1})
    ),
    json.dumps({**GOOD, "sentence": "x" * 2**17}).encode(),
]


@pytest.mark.parametrize("text", MALFORMED)
def test_anything_else_is_not_a_last_word(text: bytes, tmp_path: Path) -> None:
    """A process may be killed while it writes, and a class of a user's may write what it likes."""
    file = tmp_path / "word"
    file.write_bytes(text)
    assert read_last_word(file) is None


def test_a_pipe_in_its_place_is_not_waited_for(tmp_path: Path) -> None:
    """Nor is a folder read."""
    os.mkfifo(tmp_path / "pipe")
    for name in ("pipe", ".", "gone"):
        assert read_last_word(tmp_path / name) is None
