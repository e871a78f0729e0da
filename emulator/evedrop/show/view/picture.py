"""Draws pictures of some moments of a finished recording, without a screen.

A picture shows a tab or a panel, without the frame of the viewer's window. A process of its own draws, with Rerun's viewer. Its
pipes are read and written with a limit: a process that hangs must not hang the command. The viewer needs a Vulkan driver; a
software driver is enough, such as Debian's mesa-vulkan-drivers.
"""

from __future__ import annotations

import itertools
import os
import select
import struct
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import IO, Final, TypeVar, final

import numpy as np
from PIL import Image
from rerun.chunk import RrdReader
from rerun.experimental import ViewerClient, ViewerState

from evedrop.errors import RunError, UsageError
from evedrop.show.view.column import CLOCK, ELAPSED, TIMELINE
from evedrop.show.view.layout import Layout
from evedrop.show.view.viewer import end, guarded, spawn_anywhere, without_driver
from evedrop.system.environment import viewer_environment
from evedrop.system.files import whole_file
from evedrop.system.signals import raise_on_signals

DRAWING_SECONDS: Final = 1800.0
"""How long a process that draws may do nothing that is seen. Its viewer answers within ten minutes, or says that it failed."""
_PIECE = 2**16


def received(pipe: IO[bytes], most: int) -> bytes:
    """The next bytes of an unbuffered pipe, up to a number; fewer if the other end was closed.

    Raises RunError if none come for `DRAWING_SECONDS`.
    """
    pieces, left = [], most
    while left:
        if not select.select([pipe], [], [], DRAWING_SECONDS)[0]:
            raise _hung("drew nothing")
        if not (piece := os.read(pipe.fileno(), min(left, _PIECE))):
            break
        pieces.append(piece)
        left -= len(piece)
    return b"".join(pieces)


def give(pipe: IO[bytes], data: bytes) -> None:
    """Write to an unbuffered pipe. Raises BrokenPipeError, and RunError if nothing is taken for `DRAWING_SECONDS`."""
    os.set_blocking(pipe.fileno(), False)
    view = memoryview(data)
    while view:
        if not select.select([], [pipe], [], DRAWING_SECONDS)[1]:
            raise _hung("took no further picture")
        view = view[os.write(pipe.fileno(), view) :]


def ended(process: subprocess.Popen[bytes]) -> int:
    """The exit status of a process that is about to end. Raises RunError if it does not end in `DRAWING_SECONDS`."""
    try:
        return process.wait(DRAWING_SECONDS)
    except subprocess.TimeoutExpired as error:
        raise _hung("did not end") from error


def _hung(subject: str) -> RunError:
    return RunError(
        f"the process that draws {subject} for {DRAWING_SECONDS:g} s, and was ended; something that it uses hangs, such as the "
        "driver of the graphics card, or a disk; try again, on another disk or with another driver"
    )


_PATIENCE = 600.0  # seconds for one answer, for loading and for drawing; only a viewer that hangs needs them
_PAUSE = 0.05
_FILE_HEADER_BYTES = 12
_MESSAGE_HEADER = struct.Struct("<QQ")  # the kind of the message, and the number of its bytes
_END = 0
_FOOTER_BYTES, _FOOTER_WORD = 32, b"RRF2FOOT"
_FRAME = (1, 37, 1, 30)
"""Pixels of the viewer's window around the layout: left, top with its bar, right, and bottom with the collapsed time panel."""
_TINY = 16  # pixels: even the smallest picture makes the viewer draw everything once, and it is sent quickly

T = TypeVar("T")


@final
class HeadlessViewer:
    """A viewer that has loaded a recording."""

    def __init__(self, client: ViewerClient, process: subprocess.Popen[bytes], rrd: Path) -> None:
        """process: known to be the one that the client is connected to. rrd: the recording to load."""
        self._client, self._process = client, process
        self._answer(lambda: self._client.open([str(rrd.resolve())]))
        self._lines = self._loaded()

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
        line, end = next((line, end) for line, end in self._lines.items() if line != TIMELINE or len(self._lines) == 1)
        last = self._lines.get(TIMELINE)
        if last is None:
            if moment is not None and not 0.0 <= moment <= end / 1e9:
                raise UsageError(
                    f"{moment:g} s is not a time of the wire; give one from 0 to {end / 1e9:g}, in seconds"
                )
            at = end if moment is None else round(moment * 1e9)
        else:
            if moment is not None and not 0 <= moment <= last:
                raise UsageError(f"slot {moment:.0f} is not in the run; give one from 0 to {last}")
            slot = last if moment is None else int(moment)
            # Rounded up, because a nanosecond before a slot begins the one before it is shown.
            at = slot if line == TIMELINE else -(-slot * end // max(1, last))
        self._answer(lambda: self._set(line, at))

    def _set(self, line: str, at: int) -> None:
        """Show a slot, or a nanosecond since the start, of a time line."""
        if line == TIMELINE:
            self._client.set_time(line, sequence=at, play_state="paused")
        elif line == ELAPSED:
            self._client.set_time(line, duration=np.timedelta64(at, "ns"), play_state="paused")
        else:
            self._client.set_time(line, timestamp=np.datetime64(at, "ns"), play_state="paused")

    def choose(self, panel: str | None) -> None:
        """Show only a panel or a tab, by default the first tab. Raises UsageError if the recording has no such panel."""
        layout = Layout(self._answer(self._client.get_blueprint).blueprint).alone(panel)
        self._answer(lambda: self._client.set_blueprint(layout, of="recording"))

    def take(self, view_id: str | None = None) -> bytes:
        """What is shown, or one of its views, as PNG. The first picture after `show` may still show the previous moment."""
        png = self._answer(lambda: self._client.take_screenshot(view_id))
        return png if view_id is not None else _without_frame(png)

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

    def _loaded(self) -> dict[str, int]:
        """The recording's time lines with their last slot, or last nanosecond, once recording and layout are loaded."""
        deadline = time.monotonic() + _PATIENCE
        while not (ends := _ends(self.state())):
            if time.monotonic() > deadline:
                raise RuntimeError(f"the recording was not loaded within {_PATIENCE:.0f} s")
            time.sleep(_PAUSE)
        return ends

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


def _without_frame(png: bytes) -> bytes:
    """The picture of a window without its frame."""
    left, top, right, bottom = _FRAME
    with Image.open(BytesIO(png)) as window, BytesIO() as file:
        window.crop((left, top, window.width - right, window.height - bottom)).save(file, "PNG")
        return file.getvalue()


@contextmanager
def opened(
    rrd: Path, size: tuple[int, int], moment: float | None = None, panel: str | None = None
) -> Iterator[HeadlessViewer]:
    """A viewer that has loaded a recording, ready to draw pictures of this size.

    moment: that it shows, by default the last. panel: the panel or tab that it shows, by default the first tab.

    Raises UsageError if there is no Vulkan driver, the recording cannot be loaded or has no such panel, or the viewer fails.
    """
    check(rrd)
    with tempfile.TemporaryDirectory() as folder:
        logs = Path(folder)
        process, port = _started(size, logs)
        try:
            viewer = HeadlessViewer(ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy"), process, rrd)
            viewer.choose(panel)
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
    """A viewer's process, and the port on which it listens; size: of its pictures."""
    left, top, right, bottom = _FRAME
    window = f"{size[0] + left + right}x{size[1] + top + bottom}"
    # Otherwise the viewer would write into the picture that it is drawing without a graphics card.
    quiet = {"RUST_LOG": "error"}
    return spawn_anywhere(["--headless", "--window-size", window, "--hide-welcome-screen"], logs, environment=quiet)


def _ends(state: ViewerState) -> dict[str, int]:
    if state.loading or not state.views:
        return {}
    lines = [line for recording in state.recordings for line in recording.timelines if line.name in _LINES]
    return {line.name: int(line.end) for line in lines if line.end is not None}


_LINES = {TIMELINE, ELAPSED, CLOCK}
SIZE = (1600, 950)
"""Width and height of a picture in pixels."""
_LENGTH_BYTES = 8
_MOST_COMPLAINTS = 2**20
_LAST = "last"


def check_picture_name(path: Path) -> None:
    """Raise UsageError if a picture cannot be written to a file of this name."""
    if path.suffix.lower() == ".svg":
        raise UsageError(
            f"--picture {path}: the viewer draws pixels, not the lines of an SVG; give a name that ends in .png. "
            "evedrop figures and evedrop compare draw theirs as PDF, too"
        )
    if path.suffix.lower() != ".png":
        raise UsageError(f"--picture {path} is not the name of a PNG file; give one that ends in .png")


def picture_apart(
    rrd: Path, png: Path, moment: float | None = None, size: tuple[int, int] = SIZE, panel: str | None = None
) -> list[str]:
    """Draw a moment of a recording, by default its last, to a PNG file; returns the panels' complaints.

    moment: a slot of a run, or seconds since the start of a wire. panel: the panel or tab, by default the first tab. The file
    appears when it is complete.

    Raises UsageError if there is no Vulkan driver, the recording cannot be loaded or has no such panel, or the file cannot be
    written, and RunError if the process that draws hangs.
    """
    complaints: list[str] = []
    with whole_file(png) as temporary:
        for frame in frames_apart(rrd, None if moment is None else [moment], size, panel, complaints):
            temporary.write_bytes(frame)
    return complaints


def frames_apart(
    rrd: Path, moments: Iterable[float] | None, size: tuple[int, int], panel: str | None, complaints: list[str]
) -> Generator[bytes, None, None]:
    """Pictures of some moments, or of the last one, as PNG; the panels' complaints about the last are added to `complaints`.

    A separate process draws them, one at a time; in a separate network, too, if the system allows that. Otherwise anybody who
    finds the port of the headless viewer could control it.

    Raises UsageError as `picture_apart` does, and RunError if the process hangs.
    """
    check(rrd)
    chosen = [] if panel is None else [panel]
    command = [sys.executable, "-P", "-m", "evedrop.show.view.picture", str(rrd), *map(str, size), *chosen]
    with tempfile.TemporaryFile() as told:
        process = subprocess.Popen(
            guarded(command, apart=True),
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=told,
            env=dict(viewer_environment()),
        )
        assert process.stdin is not None and process.stdout is not None  # noqa: S101, PT018 - they are pipes
        try:
            for moment in [None] if moments is None else moments:
                frame = _asked(process.stdin, process.stdout, moment)
                if frame is None:
                    raise UsageError(_why(process, told))
                yield frame
            process.stdin.close()
            complaints += received(process.stdout, _MOST_COMPLAINTS).decode().splitlines()
        finally:
            end(process)
            process.stdout.close()
            with suppress(BrokenPipeError):
                process.stdin.close()


def _asked(to: IO[bytes], back: IO[bytes], moment: float | None) -> bytes | None:
    """The picture of a moment; None if the process ended."""
    try:
        give(to, f"{_LAST if moment is None else repr(moment)}\n".encode())
    except BrokenPipeError:
        return None
    length = int.from_bytes(received(back, _LENGTH_BYTES))
    frame = received(back, length)
    return frame if length and len(frame) == length else None


def _why(process: subprocess.Popen[bytes], told: IO[bytes]) -> str:
    status = ended(process)
    told.seek(0)
    return told.read().decode(errors="replace").strip() or f"the process that draws ended with status {status}"


def main(words: Sequence[str]) -> int:
    """Draw what `frames_apart` asks for; returns the exit status."""
    rrd, width, height, *chosen = words
    panel = chosen[0] if chosen else None
    out = sys.stdout.buffer
    try:
        with raise_on_signals():
            first = sys.stdin.readline().strip()
            with opened(Path(rrd), (int(width), int(height)), _moment(first), panel) as viewer:
                later = (viewer.frame(float(line)) for line in sys.stdin)
                for frame in itertools.chain([viewer.take()], later):
                    out.write(len(frame).to_bytes(_LENGTH_BYTES) + frame)
                    out.flush()
                out.write("\n".join(viewer.reports).encode())
                out.flush()
    except UsageError as error:
        print(error, file=sys.stderr)  # noqa: T201 - read by the process that started this one
        return error.exit_status
    except (BrokenPipeError, KeyboardInterrupt):  # no picture is wanted any more
        return 1
    return 0


def _moment(line: str) -> float | None:
    return None if line == _LAST else float(line)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
