"""The history of a wire: what is in force, and what of a damaged one is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from evedrop.errors import UsageError
from evedrop.system import files
from evedrop.wire.history import WireHistory

LOSS = {"model": "bernoulli", "quality": 1.0}


def history_of(folder: Path, **settings: Any) -> WireHistory:
    """A history with one start, of a link with these settings."""
    start = {"start": 1, "time": 1.0, "seed": 1, "links": {"scan": {"loss": LOSS, **settings}}}
    (folder / "history.jsonl").write_text(json.dumps(start) + "\n")
    return WireHistory.read(folder)


def test_a_change_that_cannot_be_written_is_in_force(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For new keys as for those that were known; so is the note of a way past the wire. The caller is told."""
    history = history_of(tmp_path)

    def refuse(*_: object) -> bytes:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.LineFile, "append", refuse)
    with pytest.raises(OSError, match="No space"):
        history.change("scan", {"loss": {**LOSS, "quality": 0.0}}, {}, 2.0)
    assert history.changes_of("scan", "new", "put")[-1].settings == {"loss": {**LOSS, "quality": 0.0}}
    with pytest.raises(OSError, match="No space"):
        history.note("a way past the wire", 3.0, bypass=True)
    assert [event.line for event in history.events] == ["a way past the wire"]


@pytest.mark.parametrize(
    ("name", "value"), [("duplicate", "x"), ("reorder", -1), ("corrupt", True), ("duplicate", 7.0)]
)
def test_a_damaged_probability_is_refused(name: str, value: Any, tmp_path: Path) -> None:
    """Before the first message has it."""
    with pytest.raises(UsageError, match=f"in which {name} is .*; expected a number from 0 to 1"):
        history_of(tmp_path, **{name: value}).expect_settings()


def test_no_delay_is_a_delay_that_is_right(tmp_path: Path) -> None:
    """As a link without one has it."""
    history_of(tmp_path, delay=None).expect_settings()
