"""Makes an MP4 or a GIF of a finished recording without a screen: pictures of the viewer, one after another.

At any time, only a few pictures are in memory.
"""

from __future__ import annotations

import errno
import os
import subprocess
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import IO, final

from PIL import GifImagePlugin, Image

from evedrop.errors import UsageError
from evedrop.show.view.bounded_pipe import ended, give
from evedrop.show.view.picture import frames_apart
from evedrop.show.view.viewer_process import end, guarded
from evedrop.system.files import whole_file

VIDEO_SIZE = (1200, 720)
"""Width and height of a video in pixels."""
FRAME_RATE = 15.0
"""Frames per second."""
_MOST_GIF_RATE = 50.0  # browsers show faster ones slowly
_COLOURS = 256
_HUNDREDTH = 10  # milliseconds, the unit of a GIF


class VideoFile(ABC):
    """A video that grows frame by frame."""

    @abstractmethod
    def add(self, png: bytes) -> None:
        """Append a frame. Raises OSError if the file cannot be written, and RunError if what writes it hangs."""

    @abstractmethod
    def finish(self) -> None:
        """Complete the file. Raises OSError if it cannot be written, and RunError if what writes it hangs."""

    @abstractmethod
    def stop(self) -> None:
        """Give the file up, or do nothing if it is finished."""


@final
class Mp4File(VideoFile):
    """H.264 in an MP4 file, by the ffmpeg of the package imageio-ffmpeg."""

    def __init__(self, path: Path, rate: float) -> None:
        self._told = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `stop`
        words = [
            "-y",
            "-loglevel",
            "error",
            "-f",
            "image2pipe",
            "-codec:v",
            "png",
            "-framerate",
            f"{rate:g}",
            "-i",
            "-",
        ]
        coded = ["-codec:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4"]
        self._process = subprocess.Popen(
            guarded([ffmpeg(), *words, *coded, str(path)]),
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._told,
            start_new_session=True,  # Ctrl-C in the terminal is not for it
        )

    def add(self, png: bytes) -> None:
        """See `VideoFile`."""
        try:
            give(self._input, png)
        except BrokenPipeError as error:
            ended(self._process)
            raise self._failure from error

    def finish(self) -> None:
        """See `VideoFile`."""
        with suppress(BrokenPipeError):
            self._input.close()
        if ended(self._process):
            raise self._failure

    def stop(self) -> None:
        """See `VideoFile`."""
        end(self._process)
        with suppress(OSError):
            self._input.close()
        self._told.close()

    @property
    def _input(self) -> IO[bytes]:
        assert self._process.stdin is not None  # noqa: S101 - it is a pipe
        return self._process.stdin

    @property
    def _failure(self) -> OSError:
        self._told.seek(0)
        text = self._told.read().decode(errors="replace")
        if (full := os.strerror(errno.ENOSPC)) in text:  # it causes the other complaints
            return OSError(errno.ENOSPC, full)
        lines = text.strip().splitlines()
        return OSError(lines[-1] if lines else f"ffmpeg ended with status {self._process.returncode}")


@final
class GifFile(VideoFile):
    """A GIF that repeats; each frame has colours of its own. Pillow's own writer of several frames would keep all in memory."""

    def __init__(self, path: Path, rate: float) -> None:
        self._file = path.open("wb")
        self._rate = rate
        self._frames = 0

    def add(self, png: bytes) -> None:
        """See `VideoFile`."""
        frame = Image.open(BytesIO(png)).convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE)
        if not self._frames:
            header, _ = GifImagePlugin.getheader(frame, info={"loop": 0})
            self._file.writelines(header)
        self._frames += 1
        duration = self._hundredths(self._frames) - self._hundredths(self._frames - 1)
        self._file.writelines(GifImagePlugin.getdata(frame, duration=duration * _HUNDREDTH, include_color_table=True))

    def finish(self) -> None:
        """See `VideoFile`."""
        self._file.write(b";")
        self._file.close()

    def stop(self) -> None:
        """See `VideoFile`."""
        with suppress(OSError):  # a full disk
            self._file.close()

    def _hundredths(self, frames: int) -> int:
        """When a frame ends, in hundredths of a second."""
        return round(100.0 * frames / self._rate)


VIDEO_FILES: Mapping[str, Callable[[Path, float], VideoFile]] = {".mp4": Mp4File, ".gif": GifFile}
"""The end of a name → what writes such a video: called with its path and the frames per second."""


def ffmpeg() -> str:
    """The path of ffmpeg. Raises UsageError if there is none."""
    try:
        import imageio_ffmpeg  # noqa: PLC0415 - an optional extra

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:
        raise UsageError(
            "an MP4 needs ffmpeg, which the package imageio-ffmpeg brings: pip install '.[video]' in the checkout, or give "
            "--video a name that ends in .gif"
        ) from error


def check_video(path: Path, size: tuple[int, int], rate: float) -> None:
    """Raise UsageError if such a video cannot be made here."""
    kind = path.suffix.lower()
    if kind not in VIDEO_FILES:
        raise UsageError(f"--video {path} is not the name of an MP4 or a GIF; give one that ends in .mp4 or .gif")
    if kind == ".gif" and rate > _MOST_GIF_RATE:
        raise UsageError(
            f"--fps {rate:g} is too fast for a GIF; give {_MOST_GIF_RATE:g} at most, or a name that ends in .mp4"
        )
    if kind == ".mp4":
        if size[0] % 2 or size[1] % 2:
            raise UsageError(f"--size {size[0]}x{size[1]} is not a size of an MP4; give even numbers")
        ffmpeg()


def video_apart(
    rrd: Path,
    path: Path,
    moments: Sequence[float],
    size: tuple[int, int],
    rate: float,
    on_progress: Callable[[int], None],
    files: Mapping[str, Callable[[Path, float], VideoFile]] = VIDEO_FILES,
) -> list[str]:
    """Draw some moments of a recording as a video; returns the panels' complaints. The file appears when it is complete.

    rate: frames per second. on_progress: is called with the number of frames so far. files: the end of a name → what writes the
    video.

    Raises UsageError as `picture_apart` does, and if such a video cannot be made here.
    """
    check_video(path, size, rate)
    complaints: list[str] = []
    # The last moment first: if it is not in the recording, nothing is drawn in vain.
    pictures = frames_apart(rrd, chain([moments[-1]], moments), size, complaints)
    with whole_file(path) as temporary, closing(pictures), _opened(files[path.suffix.lower()](temporary, rate)) as file:
        next(pictures)
        for done, picture in enumerate(pictures, 1):
            file.add(picture)
            on_progress(done)
    return complaints


@contextmanager
def _opened(file: VideoFile) -> Iterator[VideoFile]:
    try:
        yield file
        file.finish()
    finally:
        file.stop()
