"""Results folders of runs that did not complete are read as far as they go."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import fields
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from evedrop import montecarlo
from evedrop.errors import UsageError
from evedrop.results import crash_proof_tables, reading
from evedrop.results.crash_proof_tables import TableRound, last_round
from evedrop.results.folder import UNFINISHED
from evedrop.results.reading import Results
from evedrop.results.writer import ResultsWriter
from evedrop.scenario.loading import load
from evedrop.score.sums import SlotSums
from tests.disturbed import LOOP, disturbed


def test_inputs_are_there_although_the_metrics_are_older(tmp_path: Path) -> None:
    """Those of before the first slot have no controller; a run that is killed soon after has rows."""
    scenario = tmp_path / "loop.toml"
    scenario.write_text(disturbed(5, more=LOOP.format("period = 1")), encoding="utf-8")
    montecarlo(scenario, out=tmp_path / "out")
    path = tmp_path / "out" / "summary.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "controller": None}))
    inputs = Results.read(tmp_path / "out").inputs
    assert inputs is not None
    assert len(inputs) == 5


@pytest.mark.parametrize(
    "read",
    [
        lambda results: results.slots,
        lambda results: results.part("slots", ["slot"]),
        lambda results: pa.concat_tables(results.pieces("slots", ["slot"])),
    ],
    ids=["whole", "part", "pieces"],
)
@pytest.mark.parametrize("opened", [False, True])
def test_a_table_is_whole_although_the_run_ends_while_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[Results], pa.Table], opened: bool
) -> None:
    """Its stream becomes a Parquet file just before it is opened, or just after."""
    sums, find, stream_in = SlotSums(*(np.ones(5) for _ in fields(SlotSums))), last_round, crash_proof_tables._stream_in
    writer = ResultsWriter(tmp_path, load("eavesdroppers"))
    writer.slot_rows(0, "legitimate", sums, np.ones(5))
    writer.write_rows("slot 5")

    def end() -> None:
        monkeypatch.undo()
        writer.__exit__(None, None, None)

    def find_and_end(folder: Path) -> TableRound:
        found = find(folder)
        end()
        return found

    @contextmanager
    def open_and_end(folder: Path, file: str) -> Iterator[pa.RecordBatchStreamReader]:
        with stream_in(folder, file) as stream:
            end()
            yield stream

    if opened:
        monkeypatch.setattr(crash_proof_tables, "_stream_in", open_and_end)
    else:
        monkeypatch.setattr(crash_proof_tables, "last_round", find_and_end)
    assert len(read(Results(tmp_path, {}))) == 5
    assert (tmp_path / "slots.parquet").exists()


@pytest.mark.parametrize("killed", [False, True])
def test_a_run_that_ends_while_it_is_looked_at_is_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, killed: bool
) -> None:
    """Its folder `unfinished` is there at first, and then its summary; a killed run has none."""
    scenario = tmp_path / "loop.toml"
    scenario.write_text(disturbed(5), encoding="utf-8")
    montecarlo(scenario, out=tmp_path / "out")
    summary, unfinished = tmp_path / "out" / "summary.json", tmp_path / "out" / UNFINISHED
    text = summary.read_text()
    summary.unlink()
    unfinished.mkdir()

    def find_and_end(folder: Path) -> TableRound:
        unfinished.rmdir()
        if not killed:
            summary.write_text(text)
        return last_round(folder)

    monkeypatch.setattr(reading, "last_round", find_and_end)
    with pytest.raises(UsageError, match="nothing yet") if killed else nullcontext():
        assert Results.read(tmp_path / "out").summary["ended"] == "complete"
