"""Takes a picture of a finished recording without a screen.

Needs a Vulkan driver; a software driver is enough, such as Debian's mesa-vulkan-drivers.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rerun.chunk import RrdReader
from rerun.experimental import ViewerClient

from evedrop.environment import viewer_environment
from evedrop.errors import UsageError
from evedrop.ports import free_port
from evedrop.view.column import ELAPSED, TIMELINE
from evedrop.view.viewer_process import end, guarded, spawn

SIZE = (1600, 950)
"""Width and height of a picture in pixels."""
_LOAD_SECONDS = 60.0
_SETTLE_SECONDS = 30.0


def picture(rrd: Path, png: Path, size: tuple[int, int] = SIZE, moment: float | None = None) -> list[str]:
    """Draw a moment of a recording, by default its last, to a PNG file; returns the panels' complaints.

    moment: a slot of a run, or seconds since the start of a wire.

    Raises UsageError if there is no Vulkan driver, the recording cannot be loaded, or the file cannot be written.
    """
    with opened(rrd, size, moment) as viewer:
        try:
            png.write_bytes(viewer.take_screenshot())
        except OSError as error:
            raise UsageError(f"{png} cannot be written ({error.strerror}); give another file") from error
        return reports(viewer)


def picture_apart(rrd: Path, png: Path, moment: float | None = None, size: tuple[int, int] = SIZE) -> list[str]:
    """Draw as `picture` does, in a separate process; in a separate network, too, if the system allows that.

    Otherwise anybody who finds the port of the headless viewer could control it.
    """
    command = [
        sys.executable,
        "-P",
        "-m",
        "evedrop.view.picture",
        str(rrd),
        str(png),
        *map(str, size),
        *([] if moment is None else [str(moment)]),
    ]
    done = subprocess.run(
        guarded(command, apart=True), capture_output=True, text=True, check=False, env=dict(viewer_environment())
    )
    if done.returncode:
        raise UsageError(done.stderr.strip() or f"the process that draws ended with status {done.returncode}")
    return done.stdout.splitlines()


def main(words: Sequence[str]) -> int:
    """Draw what `picture_apart` asks for; returns the exit status."""
    rrd, png, width, height, *moment = words
    size = int(width), int(height)
    try:
        for complaint in picture(Path(rrd), Path(png), size, float(moment[0]) if moment else None):
            print(complaint)  # noqa: T201 - read by the process that started this one
    except UsageError as error:
        print(error, file=sys.stderr)  # noqa: T201 - the same
        return error.exit_status
    return 0


def reports(viewer: ViewerClient) -> list[str]:
    """The complaints of the panels, such as "Events: …"."""
    return [f"{view.name}: {report}" for view in viewer.get_state().views for report in view.reports]


def check(rrd: Path) -> None:
    """Read a recording to its end. Raises UsageError if it does not exist, is not a recording, or is broken.

    The viewer itself would report nothing, and show nothing.
    """
    if not rrd.is_file():
        raise UsageError(f"{rrd} does not exist; give the recording.rrd of a results folder")
    try:
        with warnings.catch_warnings():
            # A recording that was cut short between two messages is shown up to that point.
            warnings.simplefilter("ignore")
            for _ in RrdReader(rrd).stream():
                pass
    except (RuntimeError, OSError) as error:
        why = " ".join(str(error).split())
        raise UsageError(f"{rrd} is broken ({why}); remove it, and it is made again from the tables") from error


@contextmanager
def opened(rrd: Path, size: tuple[int, int], moment: float | None = None) -> Iterator[ViewerClient]:
    """A headless viewer that has loaded a recording and shows a moment of it, by default the last, ready to be drawn.

    Raises UsageError as `picture` does.
    """
    check(rrd)
    port = free_port()
    shown = ["--window-size", f"{size[0]}x{size[1]}", "--hide-welcome-screen", str(rrd.resolve())]
    arguments = ["--headless", "--port", str(port), *shown]
    with tempfile.TemporaryDirectory() as folder:
        logs = Path(folder)
        try:
            # Otherwise the viewer would write into the picture that it is drawing without a graphics card.
            process = spawn(port, arguments, logs, environment={"RUST_LOG": "error"})
        except UsageError as error:
            raise UsageError(_without_driver(str(error)) or str(error)) from error
        try:
            viewer = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            _show(viewer, moment)
            yield viewer
        except (RuntimeError, ConnectionError) as error:
            log = (logs / "viewer.log").read_text(errors="replace")
            raise UsageError(_without_driver(log) or f"the headless viewer failed: {error}; its log:\n{log}") from error
        finally:
            end(process)


def _show(viewer: ViewerClient, moment: float | None) -> None:
    deadline = time.monotonic() + _LOAD_SECONDS
    while (end := _end(viewer)) is None:
        if time.monotonic() > deadline:
            raise RuntimeError(f"the recording was not loaded within {_LOAD_SECONDS:.0f} s")
        time.sleep(0.05)
    timeline, last = end
    if timeline == ELAPSED:
        seconds = last / 1e9
        if moment is not None and not 0.0 <= moment <= seconds:
            raise UsageError(f"--time {moment:g} is not a time of the wire; give one from 0 to {seconds:g}, in seconds")
        viewer.set_time(ELAPSED, duration=seconds if moment is None else moment, play_state="paused")
    else:
        if moment is not None and not 0 <= moment <= last:
            raise UsageError(f"--slot {moment:.0f} is not in the run; give one from 0 to {last}")
        viewer.set_time(TIMELINE, sequence=last if moment is None else int(moment), play_state="paused")
    deadline = time.monotonic() + _SETTLE_SECONDS
    before, now = b"", viewer.take_screenshot()
    while now != before and time.monotonic() < deadline:
        time.sleep(0.2)
        before, now = now, viewer.take_screenshot()


def _end(viewer: ViewerClient) -> tuple[str, int] | None:
    """The recording's time line and its last slot, or its last nanosecond, once recording and layout are loaded."""
    state = viewer.get_state()
    if state.loading or not state.views:
        return None
    lines = [line for recording in state.recordings for line in recording.timelines if line.name in {TIMELINE, ELAPSED}]
    return (lines[0].name, int(lines[0].end)) if lines and lines[0].end is not None else None


def _without_driver(log: str) -> str | None:
    if "graphics adapter" not in log and "render context" not in log:
        return None
    return "no Vulkan driver to draw with; install one, on Debian: apt-get install mesa-vulkan-drivers"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
