"""A wire whose folder is removed while it runs says so at once, goes on, and ends with status 3 and true words."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from evedrop import wire
from evedrop.errors import RunError
from evedrop.results.wire_summary import WireSummary
from evedrop.wire.journal import WireJournal
from evedrop.wire.records import Kind, WireFate
from evedrop.wire.running import RunningWire
from tests.conftest import wait_until
from tests.examples import mostly_long
from tests.wire.wire_at_work import program
from tests.wire.wire_plans import wire_plan


def removed_at_once(folder: Path) -> None:
    """Remove a folder so that nobody can see it half removed."""
    shutil.rmtree(folder.rename(folder.with_name("gone")))


LOST: dict[str, tuple[Callable[[Path], object], str, bool]] = {
    "all": (removed_at_once, "out/journal", False),
    "moved": (lambda out: out.rename(out.with_name("elsewhere")), "out/journal", False),
    "journal": (lambda out: removed_at_once(out / "journal"), "out/journal", True),
    "unfinished": (lambda out: removed_at_once(out / "journal" / "unfinished"), "out/journal/unfinished", True),
}
"""What happens to a wire's folder → how, which folder is named, and whether the summary can be written."""


def errors_of(running: RunningWire) -> list[str]:
    """The lines that a wire in a process of its own has written to standard error so far."""
    return "".join(running._errors).splitlines()


def removed_while_it_runs(running: RunningWire, remove: Callable[[Path], object], folder: Path) -> None:
    """Run a wire, and remove its folder in between: it says so at once, by the name of the folder, and goes on."""
    with running:
        robot, base = (program([running.endpoint(side)]) for side in ("robot", "base"))
        got: list[str] = []
        with robot, base, base.declare_subscriber("*", lambda sample: got.append(str(sample.key_expr))):
            wait_until(lambda: robot.put("before", b"") or "before" in got, "messages cross")
            remove(running.folder)
            (message,) = wait_until(lambda: errors_of(running), "it is said at once")
            assert f"{folder} was removed or moved while the wire runs, so the wire no longer has a journal" in message
            wait_until(lambda: robot.put("after", b"") or "after" in got, "messages go on crossing")


@pytest.mark.parametrize("case", mostly_long(LOST, ["all", "unfinished"]))
def test_a_wire_without_its_folder_says_so_at_once(case: str, tmp_path: Path) -> None:
    """Messages still cross; the last sentence says what is left, and the status is 3."""
    remove, folder, summed_up = LOST[case]
    out = tmp_path / "out"
    links = [{"from": "robot", "to": "base"}, {"from": "base", "to": "robot"}]
    running = wire(side=["robot", "base"], link=links, out=out)
    with pytest.raises(RunError, match="was removed or moved while the wire ran, so its records are not there"):
        removed_while_it_runs(running, remove, tmp_path / folder)
    lines = errors_of(running)
    assert not [line for line in lines if "make room" in line or "its records stay" in line]
    assert (out / "summary.json").is_file() == summed_up
    if summed_up:
        summary = WireSummary.read(out / "summary.json")
        assert summary.journal.missing == summary.heard > 0
        assert f"{out} has only the summary" in lines[-1]
    else:
        assert "only the table above is left" in lines[-1]
        assert not out.exists()


def test_what_cannot_be_written_into_a_removed_folder_is_told_once(tmp_path: Path) -> None:
    """An event that comes before the next look says the same, and no more is said about a disk."""
    told: list[str] = []
    with WireJournal(tmp_path, wire_plan(), tell=told.append, part_rows=4) as journal:
        for n in range(3):
            journal.records.record(
                1.0, n, -1, 0.0, journal.words.key_code("scan"), 0, 8, 0, Kind.PUT, WireFate.DELIVERED
            )
        shutil.rmtree(tmp_path / "journal")
        journal.note("cut scan")
        assert journal.place.removed
        assert journal.place.incomplete_since is not None
        for n in range(3, 20):
            journal.records.record(
                1.0, n, -1, 0.0, journal.words.key_code("scan"), 0, 8, 0, Kind.PUT, WireFate.DELIVERED
            )
        journal.note("heal scan")
    (line,) = told
    assert "was removed or moved while the wire runs" in line
    assert (journal.recorded, journal.records.missing) == (20, 20)
