import io
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import matplotlib.image
import numpy as np
import pytest
from PIL import Image

from evedrop.errors import UsageError
from evedrop.show.view.palette import GROUND
from evedrop.show.view.picture import HeadlessViewer, check_picture_name, picture_apart
from evedrop.show.view.recording import ViewRecording
from evedrop.show.view.viewer import guarded
from tests.conftest import wait_until
from tests.show.view.drawn import panels_are_filled, skipped_without_driver
from tests.show.view.simulated_run import Simulated


def recorded(run: Simulated, rrd: Path) -> Path:
    """The run on file."""
    recording = ViewRecording(rrd, run.scene)
    for slots in run.chunks(100):
        recording.add(slots)
    assert recording.close()
    return rrd


def drawing(rrd: Path) -> int | None:
    """The process id of the viewer that draws a recording, as soon as it is Rerun's own command."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_text().split("\0")
            parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
            if "--headless" in words and Path(words[0]).name == "rerun":
                assert str(rrd) not in words, "any program at its port would get the recording"
                if str(rrd) in Path(f"/proc/{parent}/cmdline").read_text().split("\0"):
                    return int(folder.name)
        except OSError:
            continue
    return None


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.pictures
def test_nobody_can_connect_to_who_draws(simulated: Callable[..., Simulated], tmp_path: Path) -> None:
    """A picture is drawn by a process with a network of its own, where the system allows that: its port is for anybody."""
    rrd = recorded(simulated(60), tmp_path / "r.rrd")
    look = [sys.executable, "-c", "import os; print(os.readlink('/proc/self/ns/net'))"]
    allowed = subprocess.run(guarded(look, apart=True), capture_output=True, text=True, check=True)
    apart = allowed.stdout.strip() != os.readlink("/proc/self/ns/net")
    outcomes: list[UsageError | list[str]] = []

    def draw() -> None:
        try:
            outcomes.append(picture_apart(rrd, tmp_path / "r.png", 7))
        except UsageError as error:
            outcomes.append(error)

    thread = threading.Thread(target=draw)
    thread.start()
    pid = wait_until(lambda: drawing(rrd) or bool(outcomes), "a viewer that draws")
    network = None if outcomes else os.readlink(f"/proc/{pid}/ns/net")
    thread.join()
    with skipped_without_driver():
        if isinstance(outcomes[0], UsageError):
            raise outcomes[0]
    assert (network != os.readlink("/proc/self/ns/net")) == apart
    assert np.asarray(matplotlib.image.imread(tmp_path / "r.png")).shape[:2] == (950, 1600)


@pytest.mark.pictures
@pytest.mark.parametrize(("tab", "panels"), [("scene", 8), ("numbers", 9)])
@pytest.mark.parametrize(
    ("n", "growth"),
    [pytest.param(1, 1.0, marks=pytest.mark.long), (2, 1.12), pytest.param(4, 1.0, marks=pytest.mark.long)],
)
def test_every_panel_is_filled(
    n: int, growth: float, tab: str, panels: int, simulated: Callable[..., Simulated], tmp_path: Path
) -> None:
    """For every process, each panel of both tabs draws something, in more than one colour, without a warning."""
    rrd = recorded(simulated(120, n=n, growth=growth), tmp_path / "r.rrd")
    panels_are_filled(rrd, tab, panels)


@pytest.mark.pictures
def test_picture_is_a_png_of_that_size(simulated: Callable[..., Simulated], tmp_path: Path) -> None:
    """A picture is written in the size asked for, without complaints."""
    rrd = recorded(simulated(60), tmp_path / "r.rrd")
    with skipped_without_driver():
        assert picture_apart(rrd, tmp_path / "r.png", size=(1200, 800)) == []
    assert np.asarray(matplotlib.image.imread(tmp_path / "r.png")).shape[:2] == (800, 1200)


@pytest.mark.pictures
@pytest.mark.parametrize("panel", ["smart", "scene"])
def test_a_picture_of_a_panel_has_no_frame(panel: str, simulated: Callable[..., Simulated], tmp_path: Path) -> None:
    """Neither the window's bars nor its border: at the left, the right and the bottom is the ground of the panel."""
    rrd = recorded(simulated(60), tmp_path / "r.rrd")
    with skipped_without_driver():
        assert picture_apart(rrd, tmp_path / "r.png", 30, (640, 400), panel) == []
    pixels = np.round(255 * np.asarray(matplotlib.image.imread(tmp_path / "r.png")))[..., :3]
    assert pixels.shape == (400, 640, 3)
    if panel == "scene":  # the verdict is at the top, and the strip of packets at the bottom
        assert pixels[0, 0].tolist() == pixels[20, 0].tolist()
        assert len(np.unique(pixels[-1, :300], axis=0)) > 1
    else:
        for edge in (pixels[40:, 0], pixels[40:, -1], pixels[-1]):
            assert np.unique(edge, axis=0).tolist() == [list(GROUND)]


@pytest.mark.pictures
def test_a_panel_that_the_recording_lacks_is_refused(simulated: Callable[..., Simulated], tmp_path: Path) -> None:
    """With the panels that it has, which docs/view.md lists, and a hint; no file appears."""
    rrd = recorded(simulated(60), tmp_path / "r.rrd")
    with pytest.raises(UsageError, match="did you mean smart") as told, skipped_without_driver():
        picture_apart(rrd, tmp_path / "r.png", panel="smurt")
    names = str(told.value).partition("; give ")[2].partition(";")[0].replace(" or ", ", ").split(", ")
    page = (Path(__file__).parents[3] / "docs" / "view.md").read_text(encoding="utf-8")
    named = re.findall(r"`([a-z-]+)`", page.partition("`vehicle` has the panels")[2].partition(".")[0])
    assert names[:2] == ["scene", "numbers"]
    assert {*names[2:]} == {*named, "naive", "suspicious", "smart"}
    assert [path.name for path in tmp_path.iterdir()] == ["r.rrd"]


@pytest.mark.thorough
def test_missing_driver_is_named(
    simulated: Callable[..., Simulated], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a Vulkan driver the error says what to install."""
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nonexistent")
    monkeypatch.setenv("VK_DRIVER_FILES", "/nonexistent")
    rrd = recorded(simulated(20), tmp_path / "r.rrd")
    with pytest.raises(UsageError, match="mesa-vulkan-drivers"):
        picture_apart(rrd, tmp_path / "r.png")
    assert [path.name for path in tmp_path.iterdir()] == ["r.rrd"]


class SlowClient:
    """A viewer's client on a busy machine: it refuses every question as often as `refusals` says, and then answers."""

    def __init__(self, refusals: int) -> None:
        self.refusals = self.left = refusals

    def _refuse(self) -> None:
        if self.left:
            self.left -= 1
            raise TimeoutError("Deadline expired before operation could complete")
        self.left = self.refusals

    def get_state(self) -> SimpleNamespace:
        """A recording that is loaded."""
        self._refuse()
        line = SimpleNamespace(name="slot_number", end=9)
        return SimpleNamespace(loading=[], views=[object()], recordings=[SimpleNamespace(timelines=[line])])

    def open(self, urls: Sequence[str]) -> None:
        """Load a recording."""
        self._refuse()
        self.opened = urls

    def take_screenshot(self, *_: object) -> bytes:
        """A picture of a window."""
        self._refuse()
        file = io.BytesIO()
        Image.new("RGB", (102, 117), (200, 0, 0)).save(file, "PNG")
        return file.getvalue()

    def set_time(self, *_: object, **__: object) -> None:
        """Show another moment."""
        self._refuse()


def viewer_with(client: SlowClient, status: int | None = None) -> HeadlessViewer:
    """A viewer of this client, whose process has ended with this status, if any."""
    process = SimpleNamespace(poll=lambda: status, returncode=status)
    return HeadlessViewer(cast(Any, client), cast(Any, process), Path("r.rrd"))


def test_a_busy_machine_does_not_end_a_picture() -> None:
    """The viewer refuses what takes more than 15 seconds; the question is put again."""
    viewer = viewer_with(SlowClient(3))
    viewer.show(4)
    with pytest.raises(UsageError, match="slot 10 is not in the run; give one from 0 to 9"):
        viewer.show(10)
    with Image.open(io.BytesIO(viewer.settle())) as picture:
        assert picture.size == (100, 50)


def test_a_viewer_that_has_ended_is_not_asked_again() -> None:
    """Its status is reported instead."""
    with pytest.raises(RuntimeError, match="ended with status 7"):
        viewer_with(SlowClient(1), status=7)


@pytest.mark.parametrize(
    ("name", "advice"), [("r.svg", "pixels"), ("r.SVG", "pixels"), ("r.jpg", r"\.png$"), ("r", r"\.png$")]
)
def test_other_kinds_of_pictures_are_refused(name: str, advice: str) -> None:
    """The error says what to do."""
    with pytest.raises(UsageError, match=advice):
        check_picture_name(Path(name))
    check_picture_name(Path(f"{name}.PNG"))


def _end_of_a_message(whole: bytes) -> int:
    """Where the message of a recording ends that is in its middle: after 12 bytes each has a kind and a length of 8 bytes."""
    end = 12
    while end < len(whole) // 2:
        end += 16 + int.from_bytes(whole[end + 8 : end + 16], "little")
    return end


def _zeros(whole: bytes, at: int) -> bytes:
    return whole[:at] + bytes(500) + whole[at + 500 :]


BROKEN: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda _: b"",
    "not a recording": lambda _: b"nonsense" * 100,
    "cut short": lambda whole: whole[: _end_of_a_message(whole) - 1],  # between two messages it would be no mistake
    "zeros between two messages": lambda whole: _zeros(whole, _end_of_a_message(whole)),  # they look like its end
    "nonsense between two messages": lambda whole: whole[: _end_of_a_message(whole)] + b"\xff" * 500,
    "zeros after its end": lambda whole: whole + bytes(40),
    "damaged": lambda whole: _zeros(whole, _end_of_a_message(whole) - 100),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_recording_is_said_before_a_viewer_is_started(
    case: str, simulated: Callable[..., Simulated], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line with the file, what is wrong and a remedy; the viewer would wait forever."""
    monkeypatch.setattr("evedrop.show.view.picture.subprocess", None)  # no process is started
    rrd = recorded(simulated(60), tmp_path / "r.rrd")
    rrd.write_bytes(BROKEN[case](rrd.read_bytes()))
    with pytest.raises(UsageError, match="is broken") as told:
        picture_apart(rrd, tmp_path / "r.png")
    assert str(told.value).startswith(f"{rrd} is broken (")
    assert "\n" not in str(told.value)


def test_missing_recording_is_named(tmp_path: Path) -> None:
    """A recording that is not there is a mistake of the user's, and told so."""
    with pytest.raises(UsageError, match="does not exist"):
        picture_apart(tmp_path / "r.rrd", tmp_path / "r.png")
