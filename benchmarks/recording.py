"""The recording of a live run in real time: its chunks and bytes, for a viewer that is opened late, and after the run.

    python benchmarks/recording.py [--quick]

Rerun's work grows with the number of chunks. The yardstick is the recording of the same results, written at once.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from live_run import started
from rerun.chunk import RrdReader
from table import Row, judged, run_alone

from evedrop.show.view.live_files import LiveFiles

SCENARIO = "vehicle"
_LATE = 0.8  # of the run: when the late viewer is opened
_MOST_LIVE, _MOST_AFTER = 1000, 300  # chunks


@dataclass(frozen=True)
class Size:
    """How large a recording is."""

    chunks: int
    megabytes: float

    @classmethod
    def of(cls, content: bytes) -> Size:
        """The size of a recording with these bytes."""
        with tempfile.NamedTemporaryFile(suffix=".rrd") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a recording that goes on has no footer
            file.write(content)
            file.flush()
            return cls(sum(1 for _ in RrdReader(file.name).stream()), len(content) / 1e6)


def read_late(recording: Path) -> tuple[bytes, float]:
    """What a viewer that is opened now reads at once, and the seconds until it has that."""
    began = time.monotonic()
    files = LiveFiles(recording)
    spans = files.spans
    if spans is None:
        raise RuntimeError(f"{recording} was complete before the late viewer was opened; run more slots")
    parts = zip(files.descriptors, spans, strict=True)
    content = b"".join(os.pread(descriptor, end - start, start) for descriptor, (start, end) in parts)
    return content, time.monotonic() - began


def recorded(slots: int, pace: float) -> tuple[Size, float, Size]:
    """For a run: what a late viewer reads, in how many seconds, and the recording after the run."""
    options = ("--slots", str(slots), "--pace", str(pace), "--view", "web")
    with started(SCENARIO, *options) as (process, out):
        recording = out / "recording.rrd"
        while not recording.exists() and process.poll() is None:
            time.sleep(0.01)
        time.sleep(_LATE * slots * pace)
        content, seconds = read_late(recording)
        try:
            process.wait(slots * pace + 120.0)
        except subprocess.TimeoutExpired as error:
            raise RuntimeError("the run did not end") from error
        return Size.of(content), seconds, Size.of(recording.read_bytes())


def rows(quick: bool) -> Iterator[Row]:
    """The chunks of the recording."""
    slots, pace = (400, 0.01) if quick else (3000, 0.02)
    late, seconds, after = recorded(slots, pace)
    yield Row(
        f"live recording of `{SCENARIO} --slots {slots} --pace {pace:g}`: chunks for a late viewer, and after the run",
        f"{late.chunks:,} ({late.megabytes:.1f} MB, read in {1e3 * seconds:.0f} ms), {after.chunks:,} ({after.megabytes:.1f} MB)",
        "none",
        f"{_MOST_LIVE:,}, {_MOST_AFTER}",
        "the same",
        judged(*2 * (late.chunks <= _MOST_LIVE and after.chunks <= _MOST_AFTER,)),
    )


if __name__ == "__main__":
    run_alone(rows)
