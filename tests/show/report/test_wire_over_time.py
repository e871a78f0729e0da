"""Lanes, losses and delays of a wire over time: as counted from the rows of its journal, for any length of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evedrop.errors import UsageError
from evedrop.results.wire_summary import WIRE_FILE, WireSummary
from evedrop.show.report.wire_over_time import LANE, WireOverTime
from evedrop.wire.file import resolved_wire
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.on_disk import write_wire_report
from evedrop.wire.records import Kind, WireFate
from evedrop.wire.scorekeeper import WireScorekeeper
from tests.pages import checked
from tests.wire.wire_rows import START, robot_plan, traffic

SECONDS, CUT = 60.0, (20.0, 26.0)


@pytest.fixture(scope="module")
def wire(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a wire of one minute with three links, two of which are cut for six seconds."""
    folder, plan = tmp_path_factory.mktemp("wire"), robot_plan()
    with WireJournal(folder, plan) as journal:
        keeper = WireScorekeeper(plan, journal)
        for row in traffic(plan, SECONDS, {"scan": 50.0, "command": 20.0, "listener": 10.0}, CUT):
            at = journal.history.began + float(row["time"]) - START
            key = journal.words.key_code("k")
            fate = WireFate(int(row["fate"]))
            journal.records.record(
                at, int(row["n"]), -1, float(row["delay"]), key, 0, 64, int(row["link"]), Kind.PUT, fate
            )
        journal.close()
        assert keeper.finish(folder) == 0
    (folder / WIRE_FILE).write_text(resolved_wire(plan))
    summary = json.loads((folder / "summary.json").read_text())
    (folder / "summary.json").write_text(json.dumps({**summary, "seconds": SECONDS}))
    return folder


def test_every_message_counts_in_its_step(wire: Path) -> None:
    """All of the summary; the cut links have lost everything in its seconds; delays are those of the model; none is invented."""
    summary = WireSummary.read(wire / "summary.json")
    history = WireOverTime.read(wire, summary, journal_tables(wire, summary.start))
    assert history.step == 0.2
    for name, account in summary.links.items():
        link = history.links[name]
        assert int(link.heard.sum()) == account.heard
        assert int(link.heard.sum() - link.lost.sum()) == account.delivered
        of_cut = (history.seconds > CUT[0]) & (history.seconds < CUT[1])
        words = {LANE.words[code] for code in link.codes[of_cut]}
        assert (words == {"cut"}) == (name != "listener")
        assert "cut" not in {LANE.words[code] for code in link.codes[~of_cut]}
        assert link.delayed == (name != "listener")
    coarser = history.coarser
    assert (coarser.step, len(coarser.seconds)) == (1.0, 60)
    scan = coarser.links["scan"]
    assert int(scan.heard.sum()) == summary.links["scan"].heard
    assert np.isnan(scan.delay(0.5)[22])
    assert np.nanmedian(scan.delay(0.5)) == pytest.approx(0.02, rel=0.05)
    assert np.nanmedian(scan.delay(0.95)) > 0.025
    assert not np.nan_to_num(coarser.links["listener"].delay(0.95)).any()


def test_the_page_of_a_wire_has_lanes_and_charts(wire: Path) -> None:
    """A lane for each link, and charts of losses and delays with their axes."""
    write_wire_report(wire)
    page = checked(wire)
    assert page.tags["img"] == 3
    assert page.tags["svg"] == 2
    assert {"fraction lost", "delay (s)", "seconds since the start", "cut"} <= set(page.texts)


def test_rows_that_are_not_in_a_parquet_file_yet_count(tmp_path: Path) -> None:
    """Of a wire that still runs: the page has its lanes."""
    plan = robot_plan()
    (tmp_path / WIRE_FILE).write_text(resolved_wire(plan))
    with WireJournal(tmp_path, plan) as journal:
        key = journal.words.key_code("k")
        for n in range(300):
            at = journal.history.began + 0.01 * n
            journal.records.record(at, n, -1, 0.0, key, 0, 64, 0, Kind.PUT, WireFate.DELIVERED)
        assert not [*(tmp_path / "journal").glob("*.parquet")]
        write_wire_report(tmp_path)
        page = checked(tmp_path)
        assert "Over time" in page.headings
        assert page.tags["img"] == 1


def test_a_wire_of_another_start_or_without_a_journal(wire: Path, tmp_path: Path) -> None:
    """No row of another start counts; what cannot be read is said in its part of the page."""
    summary = WireSummary.read(wire / "summary.json")
    with pytest.raises(UsageError, match="cannot be read"):
        WireOverTime.read(tmp_path, summary, journal_tables(tmp_path, summary.start))
    text = (wire / "journal" / "history.jsonl").read_text()
    (tmp_path / "journal").mkdir()
    (tmp_path / "journal" / "history.jsonl").write_text(
        text + text.splitlines()[0].replace('"start": 1', '"start": 2') + "\n"
    )
    history = WireOverTime.read(tmp_path, replace(summary, start=2, seconds=0.0), journal_tables(tmp_path, 2))
    assert not any(link.heard.any() for link in history.links.values())
