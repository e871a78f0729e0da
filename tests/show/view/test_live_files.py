"""A viewer that follows a run in real time, from the first slot on or from any later one."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from rerun.chunk import Chunk, RrdReader

from evedrop.results.folder import UNFINISHED
from evedrop.show.view.column import TIMELINE
from evedrop.show.view.recording import ViewRecording
from evedrop.show.view.serving import Followed
from evedrop.show.view.staged import StagedChunks, chunk_sizes
from tests.conftest import LIMIT, wait_until
from tests.show.view.simulated_run import Simulated

SLOTS = 2300

Rows = dict[tuple[str, int], list[object]]


@pytest.fixture(scope="module")
def run(simulated: Callable[..., Simulated]) -> Simulated:
    """A run in real time, of 50 slots a second."""
    return simulated(SLOTS, pace=0.02)


def rows_of(rrd: Path) -> Rows:
    """Every row of a recording, by entity and slot; a row there twice raises an error, except where a later one counts."""
    rows: Rows = {}
    for chunk in RrdReader(rrd).stream().filter(is_static=False):
        columns = chunk.to_record_batch().to_pydict()
        entity = str(chunk.entity_path)
        repeated = entity.startswith(("/events", "/knows/"))
        parts = [values for name, values in columns.items() if ":" in name]
        for slot, *row in zip(columns[TIMELINE], *parts, strict=True):
            assert repeated or (entity, slot) not in rows, (entity, slot)
            rows[entity, slot] = row
    return rows


def chunks_of(rrd: Path) -> int:
    """The number of chunks."""
    return sum(1 for _ in RrdReader(rrd).stream())


class Watcher:
    """A viewer that keeps what it is given."""

    def __init__(self, followed: Followed, file: Path) -> None:
        self._pieces, self._file = followed.pieces(), file
        self.bytes = 0
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with self._file.open("wb", buffering=0) as file:
            for piece in self._pieces:
                file.write(piece)
                self.bytes += len(piece)

    def all(self) -> Path:
        """Everything that it was given, when the recording is complete."""
        self._thread.join(LIMIT)
        assert not self._thread.is_alive()
        return self._file


def recorded(recording: ViewRecording, slots: int) -> None:
    """Wait until these slots are on file."""
    wait_until(lambda: recording._recorded >= slots and not recording._waiting, f"{slots} slots on file")


def given_at_once(followed: Followed, file: Path) -> list[Chunk]:
    """The chunks that a viewer is given as soon as it comes: those that are on file."""
    pieces, content = followed.pieces(), b""
    wait_until(lambda: followed._opened().spans is not None, "positions")
    spans = followed._opened().spans
    assert spans
    while len(content) < sum(end - start for start, end in spans):
        content += next(pieces)
    file.write_bytes(content)
    return [*RrdReader(file).stream()]


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_late_viewer_gets_large_chunks_and_every_row_once(run: Simulated, tmp_path: Path) -> None:
    """It has fewer chunks than a viewer that followed from slot 0 on, and both have every row of the recording, once.

    Whenever it comes, the recording so far is at most a thousand chunks, with the styles before all others.
    """
    path = tmp_path / "recording.rrd"
    followed = Followed(path)
    first = Watcher(followed, tmp_path / "first.rrd")
    recording = ViewRecording(path, run.scene, live=True)
    recording._period = 0.001  # the batches of ten slots do not come at their pace
    late: list[Watcher] = []
    for slots in run.chunks(10):
        recording.add(slots)
        recorded(recording, slots.first + slots.count)
        if slots.first in {50, 990, 2150}:
            late.append(Watcher(followed, tmp_path / f"{slots.first}.rrd"))
            wait_until(lambda: late[-1].bytes > 0, "what a late viewer reads")
        if slots.first in {980, 1990, 2290}:
            chunks = given_at_once(followed, tmp_path / "late.rrd")
            assert len(chunks) <= 1000
            static = [chunk.is_static for chunk in chunks]
            assert static == sorted(static, reverse=True)
    recording.note(SLOTS - 1, "INFO", "the last line")
    assert recording.close()
    last = Watcher(followed, tmp_path / "last.rrd")
    followed.complete()
    expected = rows_of(path)
    assert {slot for entity, slot in expected if entity == "/error/smart"} == {*range(SLOTS)}
    for viewer in (first, *late, last):
        assert rows_of(viewer.all()) == expected
    assert chunks_of(path) < 300
    assert chunks_of(tmp_path / "first.rrd") > 1000
    assert chunks_of(last.all()) == chunks_of(path)


def test_a_viewer_that_comes_when_the_files_are_removed_reads_the_recording(run: Simulated, tmp_path: Path) -> None:
    """They are removed with the folder of unfinished tables, and the recording has all that they had."""
    path = tmp_path / "recording.rrd"
    recording = ViewRecording(path, run.scene, live=True)
    for slots in run.chunks(500):
        recording.add(slots)
    for file in [*(tmp_path / UNFINISHED).iterdir()]:
        assert file.stat().st_mode & 0o077 == 0
        file.unlink()
    assert recording.close()
    assert b"".join(Followed(path, complete=True).pieces()) == path.read_bytes()


def test_a_run_as_fast_as_possible_has_the_recording_alone(run: Simulated, tmp_path: Path) -> None:
    """Its chunks are large anyway."""
    scene = replace(run.scene, pace=0.0)
    assert ViewRecording(tmp_path / "recording.rrd", scene, live=True).close()
    assert not (tmp_path / UNFINISHED).exists()


def test_chunks_grow_tenfold_from_file_to_file() -> None:
    """Until a chunk has about a thousand slots, or 20 seconds, and begin with what comes in a fifth of a second."""
    assert chunk_sizes(0.02, 0.2) == [1000, 100]
    assert chunk_sizes(1.0, 0.2) == [1000, 100, 10]
    assert chunk_sizes(0.001, 0.2) == [4000]
    assert chunk_sizes(0.0, 0.4) == []


def test_a_disk_that_is_full_at_the_end_is_reported(
    run: Simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run ends as usual, and says that its recording is incomplete."""
    close = StagedChunks.close

    def full(staged: StagedChunks) -> None:
        close(staged)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(StagedChunks, "close", full)
    recording = ViewRecording(tmp_path / "recording.rrd", run.scene, live=True)
    recording.add(next(iter(run.chunks(10))))
    assert not recording.close()
    assert "No space left on device" in str(recording.failure)
