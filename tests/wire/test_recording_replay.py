"""The journal of a wire that has ended, shown from its folder: as a recording, a picture, a video; or why it cannot be."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
import rerun as rr
from numpy.typing import NDArray
from PIL import Image

from evedrop.cli.main import main
from evedrop.errors import UsageError
from evedrop.results.wire_summary import WIRE_FILE
from evedrop.show.view import video
from evedrop.wire import recording
from evedrop.wire.file import resolved_wire
from evedrop.wire.journal import WireJournal
from evedrop.wire.recording import PICTURE_SIZE, replay_wire, wire_seconds
from evedrop.wire.records import UNLINKED, Kind, WireFate
from evedrop.wire.time_steps import LaneState
from tests.conftest import LIMIT
from tests.privileged import CannotRun, skip
from tests.wire.wire_recordings import CUT, RATES, SECONDS, shown, texts
from tests.wire.wire_rows import START, robot_plan, traffic


@pytest.fixture(scope="module")
def rows() -> NDArray[Any]:
    """Messages of a robot, its base and a listener; robot and base are apart for a while."""
    return traffic(robot_plan(), SECONDS, RATES, CUT)


@pytest.fixture
def folder(tmp_path: Path, rows: NDArray[Any]) -> Path:
    """The folder of a wire that ended, with the rows in its journal."""
    plan = robot_plan()
    (tmp_path / WIRE_FILE).write_text(resolved_wire(plan))
    for _ in range(2):  # only the second start is shown
        with WireJournal(tmp_path, plan, part_rows=1000) as journal:
            key, later = journal.words.key_code("robot/scan"), time.time() - START
            for now, n, sequence, delay, _, _, size, link, kind, fate in rows.tolist():
                journal.records.record(now + later, n, sequence, delay, key, 0, size, link, kind, fate)
            journal.note("partition robot, base")
            journal.note("heal robot, base")
            journal.records.record(START + later + 1.0, -1, -1, 0.0, key, 0, 5, UNLINKED, Kind.PUT, WireFate.UNLINKED)
    return tmp_path


def test_a_replay_shows_the_whole_journal_of_the_latest_start(folder: Path, rows: NDArray[Any]) -> None:
    """Every message of it is in the table, the events are those that came to pass, and the window is the whole time."""
    rrd = replay_wire(folder, folder / "view.rrd")
    table = shown(rrd, "table", "TextDocument:text")[-1][1][0]
    for link, name in enumerate(RATES):
        assert f"| {name} | " in table
        assert f"| {int(np.sum(rows['link'] == link)):,} |" in table
    assert "| no link | | 1 | | 1 no link |" in table
    lines = [text for _, text in texts(rrd)]
    assert lines[0] == "a wire of 3 sides and 3 links, seed 7; start 2 in this folder"
    assert [line for line in lines if line.endswith("robot, base")] == ["partition robot, base", "heal robot, base"]
    assert 11.5 < shown(rrd, "rates", "Scalars:scalars")[-1][0] < 13.0


@pytest.mark.parametrize("call", ["save", "flush", "disconnect"])
def test_a_view_on_a_full_disk_ends(
    call: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Rerun may never return from such a disk."""
    ended = threading.Event()
    monkeypatch.setattr(recording, "_WRITE_SECONDS", 0.2)
    monkeypatch.setattr(rr.RecordingStream, call, lambda *_, **__: ended.wait(LIMIT))
    assert main(["view", str(folder), "--picture", str(folder / "w.png")]) == UsageError.exit_status
    assert "the recording is incomplete: " in capfd.readouterr().err
    ended.set()


@pytest.mark.long
def test_a_picture_of_a_wire(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """`evedrop view OUT --picture` draws it, no panel complains, and a moment that is not there is refused."""
    assert main(["view", str(folder), "--picture", str(folder / "w.png"), "--slot", "3"]) == 2
    assert "--slot is for runs" in capfd.readouterr().err
    status = main(["view", str(folder), "--picture", str(folder / "w.png")])
    output = capfd.readouterr()
    if "no Vulkan driver" in output.err:
        skip(CannotRun(output.err))
    assert (status, output.err) == (0, "")
    pixels = np.asarray(matplotlib.image.imread(folder / "w.png"))
    assert pixels.shape[1::-1] == PICTURE_SIZE
    colours = {
        tuple(round(255 * part) for part in pixel) for pixel in np.unique(pixels[:, :, :3].reshape(-1, 3), axis=0)
    }
    for state in (LaneState.DELIVERED, LaneState.SOME, LaneState.CUT):  # Rerun draws lanes darker
        assert any(
            all(abs(a - 0.8 * b) < 14 for a, b in zip(colour, state.colour, strict=True)) for colour in colours
        ), state


def test_a_summary_that_is_damaged_is_refused(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """With its path."""
    (folder / "summary.json").write_text("{")
    assert main(["view", str(folder), "--table"]) == UsageError.exit_status
    assert f"evedrop: {folder / 'summary.json'} is not the summary of a wire (" in capfd.readouterr().err


def test_a_wire_that_nothing_crossed_is_refused(tmp_path: Path) -> None:
    """With the reason, not with an empty view."""
    (tmp_path / WIRE_FILE).write_text(resolved_wire(robot_plan()))
    with WireJournal(tmp_path, robot_plan()):
        pass
    with pytest.raises(UsageError, match="no message came to the wire"):
        replay_wire(tmp_path, tmp_path / "view.rrd")


@pytest.mark.long
def test_a_video_of_a_wire(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """It shows the requested times; a time outside the wire is refused before anything is drawn."""
    path = folder / "w.gif"
    words = ["view", str(folder), "--video", str(path), "--size", "400x320", "--times"]
    status = main([*words, "0:99999:50000"])
    errors = capfd.readouterr().err
    if "Vulkan" in errors:
        skip(CannotRun(errors))
    assert status == 2
    assert "50000 s is not a time of the wire" in errors
    assert main([*words, "2:10:4"]) == 0
    with Image.open(path) as gif:
        assert (gif.size, getattr(gif, "n_frames", 1)) == ((400, 320), 3)


def test_a_video_shows_the_whole_wire_in_ten_seconds(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If no times are given: from its start to its last message."""
    asked = list[list[float]]()

    def asked_for(*values: Any) -> list[str]:
        asked.append(values[2])
        return []

    monkeypatch.setattr(video, "video_apart", asked_for)
    assert main(["view", str(folder), "--video", str(folder / "w.gif"), "--fps", "3"]) == 0
    (times,) = asked
    assert len(times) == 30
    assert times[0] == 0.0
    assert times[-1] == wire_seconds(folder) > 11.5
    assert np.allclose(np.diff(times), times[-1] / 29)


@pytest.mark.parametrize(
    ("words", "advice"),
    [
        (("--slots", "0:3"), "give --times"),
        (("--times", "0:1e12"), "more than 1,000,000 frames"),
        (("--times", "0:1000000:1"), "more than 1,000,000 frames"),
    ],
)
def test_a_video_of_a_wire_refuses_such_times(
    words: tuple[str, ...], advice: str, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A wire has no slots, so `--slots` is refused."""
    assert main(["view", str(folder), "--video", str(folder / "w.gif"), *words]) == 2
    assert advice in capfd.readouterr().err
