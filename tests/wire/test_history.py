"""The history of a wire: what is in force, and what of a damaged one is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from evedrop.errors import UsageError
from evedrop.system import files
from evedrop.system.world import world
from evedrop.wire.history import WireHistory
from evedrop.wire.journal import WireJournal
from evedrop.wire.run import _begin_results
from tests.conftest import wait_until
from tests.wire.wire_plans import wire_plan

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


def test_a_change_is_soon_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A power cut after it leaves it, as the later records of the link need it; without a change, nothing is synced."""
    plan = wire_plan()
    with WireJournal(tmp_path, plan) as journal:
        synced: list[Path] = []
        monkeypatch.setattr(type(world().disk), "sync", lambda _, path: synced.append(path))
        journal.change("scan", {"loss": LOSS}, {})
        wait_until(lambda: synced, "the journal's thread has synced it")
        journal.history.sync()
        assert synced == [tmp_path / "journal" / "history.jsonl"]


def test_the_file_of_an_earlier_start_stays_if_it_cannot_be_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without wire.toml, whole, no command reads the folder."""
    _begin_results(tmp_path, wire_plan())
    before = (tmp_path / "wire.toml").read_text()

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(world().disk), "sync", refuse)
    _begin_results(tmp_path, wire_plan(scan={"loss": {**LOSS, "quality": 0.5}}))
    assert (tmp_path / "wire.toml").read_text() == before
    assert "wire.toml cannot be written" in capsys.readouterr().err


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


def test_other_settings_of_a_later_start_are_those_of_later_messages(tmp_path: Path) -> None:
    """Messages that an earlier start has numbered keep their fates; a key that is new has the later settings from its first."""
    earlier, later = ({"loss": {**LOSS, "quality": quality}} for quality in (1.0, 0.5))
    history = WireHistory(tmp_path)
    history.begin(wire_plan(scan=earlier), 1.0)
    before = history.changes_of("scan", "old", "put")[0].settings
    history.end({("scan", "old", "put"): 5}, 2.0)
    history.begin(wire_plan(scan=later), 3.0)
    read = WireHistory.read(tmp_path)
    first, second = read.changes_of("scan", "old", "put")
    assert (first.at, first.settings, second.at) == (0, before, 5)
    assert [(change.at, change.settings) for change in read.changes_of("scan", "new", "put")] == [(0, second.settings)]
    assert second.settings != before
