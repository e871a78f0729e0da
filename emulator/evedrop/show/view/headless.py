"""Rerun's viewer without a screen, which draws recordings.

Needs a Vulkan driver; a software driver is enough, such as Debian's mesa-vulkan-drivers.
"""

from __future__ import annotations

import os
import struct
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar, final

from rerun.chunk import RrdReader
from rerun.experimental import ViewerClient, ViewerState

from evedrop.errors import UsageError
from evedrop.show.view.column import ELAPSED, TIMELINE
from evedrop.show.view.viewer_process import PortTaken, end, spawn, without_driver
from evedrop.system.ports import free_port

_ATTEMPTS = 3
_PATIENCE = 600.0  # seconds for one answer, for loading and for drawing; only a viewer that hangs needs them
_PAUSE = 0.05
_FILE_HEADER_BYTES = 12
_MESSAGE_HEADER = struct.Struct("<QQ")  # the kind of the message, and the number of its bytes
_END = 0
_FOOTER_BYTES, _FOOTER_WORD = 32, b"RRF2FOOT"
_TINY = 16  # pixels: even the smallest picture makes the viewer draw everything once, and it is sent quickly

T = TypeVar("T")


@final
class HeadlessViewer:
    """A viewer that has loaded a recording."""

    def __init__(self, client: ViewerClient, process: subprocess.Popen[bytes], rrd: Path) -> None:
        """process: known to be the one that the client is connected to. rrd: the recording to load."""
        self._client, self._process = client, process
        self._answer(lambda: self._client.open([str(rrd.resolve())]))
        self._timeline, self._last = self._loaded()

    def state(self) -> ViewerState:
        """What the viewer shows."""
        return self._answer(self._client.get_state)

    @property
    def reports(self) -> list[str]:
        """The complaints of the panels, such as "Events: …"."""
        return [f"{view.name}: {report}" for view in self.state().views for report in view.reports]

    def show(self, moment: float | None) -> None:
        """Show a slot of a run, or a second since the start of a wire; None: the last.

        Raises UsageError if the recording has no such moment.
        """
        if self._timeline == ELAPSED:
            end = self._last / 1e9
            if moment is not None and not 0.0 <= moment <= end:
                raise UsageError(f"{moment:g} s is not a time of the wire; give one from 0 to {end:g}, in seconds")
            seconds = end if moment is None else moment
            self._answer(lambda: self._client.set_time(ELAPSED, duration=seconds, play_state="paused"))
        else:
            if moment is not None and not 0 <= moment <= self._last:
                raise UsageError(f"slot {moment:.0f} is not in the run; give one from 0 to {self._last}")
            slot = self._last if moment is None else int(moment)
            self._answer(lambda: self._client.set_time(TIMELINE, sequence=slot, play_state="paused"))

    def take(self, view_id: str | None = None) -> bytes:
        """What is shown, or one of its views, as PNG. The first picture after `show` may still show the previous moment."""
        return self._answer(lambda: self._client.take_screenshot(view_id))

    def frame(self, moment: float) -> bytes:
        """A picture of a moment after another one, as PNG. Raises UsageError as `show` does."""
        self.show(moment)
        self._answer(lambda: self._client.take_screenshot(max_size=_TINY))
        return self.take()

    def settle(self) -> bytes:
        """Wait until two pictures are equal; returns the last."""
        deadline = time.monotonic() + _PATIENCE
        before, now = b"", self.take()
        while now != before and time.monotonic() < deadline:
            time.sleep(4 * _PAUSE)
            before, now = now, self.take()
        return now

    def _loaded(self) -> tuple[str, int]:
        """The recording's time line and its last slot, or its last nanosecond, once recording and layout are loaded."""
        deadline = time.monotonic() + _PATIENCE
        while (end := _end(self.state())) is None:
            if time.monotonic() > deadline:
                raise RuntimeError(f"the recording was not loaded within {_PATIENCE:.0f} s")
            time.sleep(_PAUSE)
        return end

    def _answer(self, ask: Callable[[], T]) -> T:
        """The viewer's answer. It refuses a question after 15 seconds, which is too early on a busy machine, so ask again."""
        deadline = time.monotonic() + _PATIENCE
        while True:
            try:
                return ask()
            except TimeoutError as error:
                if self._process.poll() is not None:
                    raise RuntimeError(f"it ended with status {self._process.returncode}") from error
                if time.monotonic() > deadline:
                    raise RuntimeError(f"no answer within {_PATIENCE:.0f} s") from error


@contextmanager
def opened(rrd: Path, size: tuple[int, int], moment: float | None = None) -> Iterator[HeadlessViewer]:
    """A viewer that has loaded a recording and shows a moment of it, by default the last, ready to be drawn.

    Raises UsageError if there is no Vulkan driver, the recording cannot be loaded, or the viewer fails.
    """
    check(rrd)
    with tempfile.TemporaryDirectory() as folder:
        logs = Path(folder)
        process, port = _started(size, logs)
        try:
            viewer = HeadlessViewer(ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy"), process, rrd)
            viewer.show(moment)
            viewer.settle()
            yield viewer
        except (RuntimeError, ConnectionError) as error:
            log = (logs / "viewer.log").read_text("utf-8", "replace")
            raise UsageError(without_driver(log) or f"the headless viewer failed: {error}; its log:\n{log}") from error
        finally:
            end(process)


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
        _check_end(rrd)
    except (RuntimeError, OSError) as error:
        why = " ".join(str(error).split())
        raise UsageError(f"{rrd} is broken ({why}); remove it, and it is made again from the tables") from error


def _check_end(rrd: Path) -> None:
    """Raise OSError if anything but a footer follows the message that ends a recording.

    Rerun's reader takes zeros between two messages for that end, and leaves out whatever follows.
    """
    with rrd.open("rb") as file:
        file.seek(_FILE_HEADER_BYTES)
        while len(header := file.read(_MESSAGE_HEADER.size)) == _MESSAGE_HEADER.size:
            kind, length = _MESSAGE_HEADER.unpack(header)
            if kind == _END:
                file.seek(length, os.SEEK_CUR)
                end = file.tell()
                footer = file.read(_FOOTER_BYTES + 1)
                if footer and not (len(footer) == _FOOTER_BYTES and _FOOTER_WORD in footer):
                    raise OSError(f"it ends at byte {end}, and more follows")
                return
            file.seek(length, os.SEEK_CUR)


def _started(size: tuple[int, int], logs: Path) -> tuple[subprocess.Popen[bytes], int]:
    """A viewer's process, and the port on which it listens."""
    for attempt in range(1, _ATTEMPTS + 1):
        port = free_port()
        shown = ["--window-size", f"{size[0]}x{size[1]}", "--hide-welcome-screen"]
        try:
            # Otherwise the viewer would write into the picture that it is drawing without a graphics card.
            quiet = {"RUST_LOG": "error"}
            arguments = ["--headless", "--port", str(port), *shown]
            return spawn(port, arguments, logs, environment=quiet), port
        except PortTaken:
            if attempt == _ATTEMPTS:
                raise
    raise AssertionError


def _end(state: ViewerState) -> tuple[str, int] | None:
    if state.loading or not state.views:
        return None
    lines = [line for recording in state.recordings for line in recording.timelines if line.name in {TIMELINE, ELAPSED}]
    return (lines[0].name, int(lines[0].end)) if lines and lines[0].end is not None else None
