"""The results folder of a live run is complete, however the run ends."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from evedrop.errors import NoAnswer
from evedrop.live.protocol.brief import Brief, RecorderPart
from evedrop.live.recorder.intake import Intake
from evedrop.live.recorder.run_end import RunEnd
from evedrop.live.recorder.run_folder import RunFolder
from evedrop.live.recorder.run_score import RunScore
from evedrop.results.crash_proof_tables import last_round
from evedrop.results.reading import Results
from evedrop.score.run_tally import RunTally
from evedrop.score.sums import SlotSums
from tests.conftest import wait_until
from tests.live.protocol.made_briefs import briefed, made


@pytest.mark.parametrize(
    ("why", "told"),
    [
        (NoAnswer("it did not answer within 10 s"), "it did not answer"),
        (MemoryError(), "there is not enough memory"),
        (ValueError("x"), "the recorder failed"),
    ],
)
def test_metrics_that_cannot_be_computed_cost_no_rows(
    why: Exception, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A class does not answer whose link was changed, or memory is short: rows are saved, and the summary says why."""
    scenario = briefed()
    brief = cast("Brief[RecorderPart]", made(scenario)["recorder"])
    tally = RunTally.from_scenario(scenario, scenario.trials)
    score = RunScore(scenario, tally, Intake(brief, scenario, tally).joiner)

    def summary(*_: object) -> None:
        raise why

    monkeypatch.setattr(score, "summary", summary)
    folder, end, one = RunFolder(tmp_path, score, shard=False), RunEnd(), np.ones(10)
    with end.noted(), folder.open():
        for receiver in scenario.receivers:
            folder._writer.slot_rows(0, receiver, SlotSums(*(one for _ in fields(SlotSums))), one)

        def on_disk() -> bool:
            with suppress(MemoryError, ValueError):
                folder.save()
            folder.save_rows()
            return last_round(tmp_path).slots == 10

        wait_until(on_disk, "rows on disk")
        folder.settle(end)
    folder.complete(end)
    results = Results.read(tmp_path)
    assert len(results.slots) == 10 * len(scenario.receivers)
    assert results.summary["slots"] == 10
    assert results.summary["ended"].startswith(end.how)
    assert told in end.how
    assert end.status == 3
