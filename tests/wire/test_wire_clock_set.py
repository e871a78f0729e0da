"""The system's clock may be set while a wire runs: all that a start of it records has the times of one steady clock."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zenoh

from evedrop.show.report.wire_over_time import WireOverTime
from evedrop.system.world import world
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.records import Kind, WireFate
from evedrop.wire.scorekeeper import WireScorekeeper
from evedrop.wire.tables import WireExpectTable
from tests.conftest import wait_until
from tests.wire.wire_at_work import at_work, both_ways, is_declared

GAP = WireExpectTable(metric="robot-base.gap_seconds", above=19.0, below=1000.0)


@pytest.mark.parametrize("by", [0.0, 3600.0, -3600.0])
def test_a_clock_that_is_set_while_a_wire_runs_changes_no_result(
    by: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is set in a gap of 20 s: the gap, what is expected of it, and the page over time are as without that."""
    passed, set_by, time, monotonic = [0.0], [0.0], world().time, world().monotonic
    monkeypatch.setattr(world(), "monotonic", lambda: monotonic() + passed[0])
    monkeypatch.setattr(world(), "time", lambda: time() + passed[0] + set_by[0])
    plan = both_ways(expectations=(GAP,))
    with at_work(plan, tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        keeper, cut = WireScorekeeper(plan, wire.journal), wire.relay.links["robot-base"]
        base.declare_queryable("question", lambda query: query.reply("question", b"yes"))
        wait_until(lambda: is_declared(wire, "base", "queryable", "question"), "the queryable is declared")
        for n in range(3):
            cut.cut = n == 1
            robot.put("scan", b"", congestion_control=zenoh.CongestionControl.BLOCK)
            wire.when_heard(n + 1)
            passed[0] += 10.0
            set_by[0] = by
        assert [*robot.get("question")]
        wire.journal.note("an event")
        wire.journal.place.beat()
        wire.journal.flush()
        summary = keeper.summary()
    assert [WireFate(fate) for fate in wire.rows["fate"]] == [
        WireFate.DELIVERED, WireFate.CUT, WireFate.DELIVERED, WireFate.DELIVERED, WireFate.DELIVERED
    ]  # fmt: skip
    link = summary.links["robot-base"]
    assert link.gap_messages == 1
    assert 20.0 <= link.gap_seconds < 1000.0
    assert [expectation.held for expectation in summary.expectations] == [True]
    seconds = wire.rows["time"] - wire.journal.history.began
    assert wire.rows["kind"][3:].tolist() == [Kind.QUERY, Kind.REPLY]
    assert (seconds >= 0.0).all()
    assert (np.diff(seconds) >= [10.0, 10.0, 10.0, 0.0]).all()
    times = [*seconds, *(event.time for event in wire.journal.history.events), summary.seconds]
    assert max(times) < 1000.0
    assert times[-2] >= 30.0
    assert wire.journal.history.over - wire.journal.history.began == pytest.approx(wire.journal.seconds, abs=100.0)
    over_time = WireOverTime.read(tmp_path, summary, journal_tables(tmp_path))
    heard = over_time.links["robot-base"].heard
    assert heard[heard > 0.0].tolist() == [1.0] * 4
