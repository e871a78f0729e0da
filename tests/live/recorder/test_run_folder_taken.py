"""A results folder in which another run has begun."""

from __future__ import annotations

from pathlib import Path

import pytest

from evedrop.errors import FolderTaken
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.protocol.brief import RecorderPart, has_part
from evedrop.live.recorder.recorded_run import RecordedRun
from evedrop.live.recorder.run_end import RunEnd
from evedrop.names import RECORDER
from evedrop.scenario.loading import load


def recorded_run(folder: Path) -> RecordedRun:
    """A run that is recorded into a folder."""
    scenario = load("eavesdroppers")
    brief = briefs_of(scenario, endpoints_at("tcp/127.0.0.1:7447"), RecorderTask(folder, False))[RECORDER]
    assert has_part(brief, RecorderPart)
    return RecordedRun(brief, scenario)


def files_in(folder: Path) -> dict[Path, bytes]:
    """Path → content of all files in a folder."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_folder_of_another_run_is_left_as_it_is(tmp_path: Path) -> None:
    """A second recorder in the folder of a run in progress writes nothing, and fails; the run goes on."""
    first = recorded_run(tmp_path)
    with first.folder.open():
        before = files_in(tmp_path)
        with pytest.raises(FolderTaken, match="another run"), RunEnd().noted(), recorded_run(tmp_path).folder.open():
            pass
        assert files_in(tmp_path) == before
        first.folder.save_rows()
    assert (tmp_path / "slots.parquet").is_file()
