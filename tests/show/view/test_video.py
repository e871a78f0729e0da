import subprocess
from collections.abc import Iterable, Sequence
from io import BytesIO
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from evedrop import montecarlo
from evedrop.cli.main import main
from evedrop.errors import UsageError
from evedrop.show.view import telling_slot, video
from evedrop.show.view.video import VIDEO_FILES, check_video, video_apart
from tests.conftest import Evedrop
from tests.privileged import CannotRun, skip

SIZE = (64, 48)
COLOURS = ((255, 0, 0), (0, 255, 0), (0, 0, 255))


def pictures(moments: Sequence[float]) -> list[bytes]:
    """A picture of one colour for each moment."""
    pictures = []
    for moment in moments:
        file = BytesIO()
        Image.new("RGB", SIZE, COLOURS[int(moment) % 3]).save(file, "PNG")
        pictures.append(file.getvalue())
    return pictures


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of one colour in place of those of a viewer."""

    def frames(_rrd: Path, moments: Sequence[float], _size: object, _panel: None, complaints: list[str]) -> object:
        yield from pictures(moments)
        complaints.append("a complaint")

    monkeypatch.setattr(video, "frames_apart", frames)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a run of 60 slots."""
    folder = tmp_path_factory.mktemp("run")
    montecarlo("vehicle", trials=1, slots=60, out=folder)
    return folder


def ffmpeg() -> str:
    """The ffmpeg of the extra."""
    importorskip: ModuleType = pytest.importorskip("imageio_ffmpeg")
    return str(importorskip.get_ffmpeg_exe())


@pytest.mark.usefixtures("drawn")
def test_a_gif_has_all_frames_in_order_and_the_length_that_was_asked_for(tmp_path: Path) -> None:
    """Fifteen frames a second are not a whole number of hundredths of a second; the frames share the difference."""
    path, told = tmp_path / "v.gif", list[int]()
    assert video_apart(tmp_path / "r.rrd", path, range(15), SIZE, 15.0, told.append) == ["a complaint"]
    with Image.open(path) as gif:
        assert (gif.size, getattr(gif, "n_frames", 1), gif.info["loop"]) == (SIZE, 15, 0)
        length = 0
        for number in range(15):
            gif.seek(number)
            length += gif.info["duration"]
            assert gif.convert("RGB").getpixel((5, 5)) == COLOURS[number % 3]
    assert length == 1000
    assert told == list(range(1, 16))
    assert list(tmp_path.iterdir()) == [path]


def test_a_gif_has_the_pixels_that_changed_and_shows_them_exactly(tmp_path: Path) -> None:
    """A square of many colours moves over a coloured ground, and rests: the frames after the first are small."""
    generator, path = np.random.default_rng(7), tmp_path / "v.gif"
    ground = generator.choice(np.arange(0, 250, 50, dtype=np.uint8), (240, 320, 3))
    square = generator.choice(np.array([1, 126, 251], np.uint8), (12, 12, 3))
    shown = []
    for number in (0, 1, 2, 2, 3, 150):
        frame = ground.copy()
        frame[number : number + 12, 2 * number : 2 * number + 12] = square
        shown.append(frame)
    file = VIDEO_FILES[".gif"](path, 15.0)
    for frame in shown:
        png = BytesIO()
        Image.fromarray(frame).save(png, "PNG")
        file.add(png.getvalue())
    file.finish()
    with Image.open(path) as gif:
        for number, frame in enumerate(shown):
            gif.seek(number)
            assert np.array_equal(np.asarray(gif.convert("RGB")), frame)
    assert path.stat().st_size < 2 * ground.nbytes / 3


def defaults(
    run: Path, words: Sequence[str], chosen: int | None, monkeypatch: pytest.MonkeyPatch
) -> tuple[Sequence[float], float]:
    """The moments and frames per second of a video whose slots nobody gives; chosen: the most telling slot, if any."""
    asked = list[tuple[Sequence[float], float]]()

    def asked_for(*values: Any) -> list[str]:
        asked.append((values[2], values[4]))
        return []

    monkeypatch.setattr(telling_slot, "telling_slot", lambda _: chosen)
    monkeypatch.setattr(video, "video_apart", asked_for)
    assert main(["view", str(run), "--video", str(run / "v.gif"), *words]) == 0
    return asked[0]


@pytest.mark.parametrize(
    ("chosen", "slots"), [(30, range(15, 35)), (3, range(20)), (59, range(40, 60))], ids=["middle", "start", "end"]
)
def test_a_video_takes_ten_seconds_around_the_most_telling_slot(
    chosen: int, slots: range, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three quarters of the slots are before it, where the run has as many; --fps changes the number, not the time."""
    assert defaults(finished, ["--fps", "2"], chosen, monkeypatch) == (slots, 2.0)


@pytest.mark.parametrize(("words", "count", "rate"), [(["--fps", "4"], 40, 4.0), ([], 60, 6.0)])
def test_a_video_of_a_run_that_each_picture_shows_whole_takes_ten_seconds(
    words: list[str], count: int, rate: float, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the first slot to the last, each at most once: a short run is shown more slowly."""
    moments, shown = defaults(finished, words, None, monkeypatch)
    assert (len(moments), moments[0], moments[-1], shown) == (count, 0, 59, rate)
    assert list(moments) == sorted({*moments})


def test_slots_that_are_given_are_shown_at_the_usual_rate(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However few they are."""
    assert defaults(finished, ["--slots", "20:23"], None, monkeypatch) == (range(20, 24), 15.0)


@pytest.mark.usefixtures("drawn")
def test_an_mp4_has_all_frames_in_order(tmp_path: Path) -> None:
    """Decoded, each frame has its colour."""
    command, path = ffmpeg(), tmp_path / "v.mp4"
    video_apart(tmp_path / "r.rrd", path, range(7), SIZE, 15.0, lambda _: None)
    words = [command, "-loglevel", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(words, capture_output=True, check=True).stdout
    frame = 3 * SIZE[0] * SIZE[1]
    assert len(raw) == 7 * frame
    for number in range(7):
        pixel = raw[number * frame : number * frame + 3]
        assert max(abs(a - b) for a, b in zip(pixel, COLOURS[number % 3], strict=True)) < 40
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["v.gif", "v.mp4"])
def test_an_interrupt_leaves_no_file(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a temporary file nor a process of ffmpeg is left."""
    if name.endswith("mp4"):
        ffmpeg()

    def frames(*_: object) -> object:
        yield from pictures(range(3))
        raise KeyboardInterrupt

    monkeypatch.setattr(video, "frames_apart", frames)
    with pytest.raises(KeyboardInterrupt):
        video_apart(tmp_path / "r.rrd", tmp_path / name, range(9), SIZE, 15.0, lambda _: None)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize("name", ["v.gif", "v.mp4"])
def test_a_full_disk_is_said_and_leaves_no_file(name: str, tmp_path: Path) -> None:
    """Writing to /dev/full fails as on a full disk."""
    if name.endswith("mp4"):
        ffmpeg()
    kind = VIDEO_FILES[Path(name).suffix]
    files = {Path(name).suffix: lambda _, rate: kind(Path("/dev/full"), rate)}
    with pytest.raises(UsageError, match=r"cannot be written \(.*No space left on device"):
        video_apart(tmp_path / "r.rrd", tmp_path / name, range(9), SIZE, 15.0, lambda _: None, files=files)
    assert list(tmp_path.iterdir()) == []


def test_slots_that_the_run_does_not_have_are_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many they are: the last one is drawn first, and the moments are never made into a list."""

    def frames(_rrd: Path, moments: Iterable[float], *_: object) -> object:
        raise UsageError(f"slot {next(iter(moments))} is not in the run")
        yield

    monkeypatch.setattr(video, "frames_apart", frames)
    with pytest.raises(UsageError, match="slot 999999999999 is not in the run"):
        video_apart(tmp_path / "r.rrd", tmp_path / "v.gif", range(10**12), SIZE, 15.0, lambda _: None)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "size", "rate", "advice"),
    [
        ("v.avi", SIZE, 15.0, r"\.mp4 or \.gif"),
        ("v", SIZE, 15.0, r"\.mp4 or \.gif"),
        ("v.gif", SIZE, 60.0, "50 at most"),
        ("v.mp4", (65, 48), 15.0, "even numbers"),
    ],
)
def test_impossible_videos_are_refused(name: str, size: tuple[int, int], rate: float, advice: str) -> None:
    """The error says what to give."""
    with pytest.raises(UsageError, match=advice):
        check_video(Path(name), size, rate)


def test_a_missing_ffmpeg_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message names the extra that installs ffmpeg; a GIF needs none."""
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with pytest.raises(UsageError, match=r"'\.\[video\]'"):
        check_video(Path("v.mp4"), SIZE, 15.0)
    check_video(Path("v.gif"), SIZE, 15.0)


@pytest.mark.parametrize(
    ("words", "advice"),
    [
        (("--video", "v.gif", "--slot", "3"), "--slots"),
        (("--video", "v.gif", "--times", "0:1"), "--slots"),
        (("--video", "v.gif", "--slots", "0:2.5"), "whole numbers"),
        (("--video", "v.gif", "--slots", "0:1e19"), "more than a run can have"),
        (("--picture", "v.png", "--slots", "0:9"), "--video"),
        (("--picture", "v.svg"), "pixels"),
        (("--panel", "scene"), "--picture or --video"),
    ],
)
def test_options_that_do_not_fit_are_refused(
    words: tuple[str, ...], advice: str, finished: Path, evedrop: Evedrop
) -> None:
    """The command ends with status 2 and names the option to give."""
    done = evedrop("view", str(finished), *words)
    assert done.status == 2
    assert advice in done.err


@pytest.mark.pictures
def test_the_video_of_a_run_shows_its_slots(finished: Path, evedrop: Evedrop, tmp_path: Path) -> None:
    """The whole way, from the command to the file: two slots give two frames that differ."""
    path = tmp_path / "run.gif"
    done = evedrop("view", str(finished), "--video", str(path), "--slots", "20:40:20", "--size", "400x320")
    if "Vulkan" in done.err:
        skip(CannotRun(done.err))
    assert (done.status, done.err) == (0, "")
    assert done.out == f"2 frames are in {path}\n"
    with Image.open(path) as gif:
        assert (gif.size, getattr(gif, "n_frames", 1)) == ((400, 320), 2)
        first = gif.convert("RGB").tobytes()
        gif.seek(1)
        assert gif.convert("RGB").tobytes() != first
