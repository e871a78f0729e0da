"""Draws a video of a finished recording, as MP4 or GIF. Only a few of its pictures are in memory at any time."""

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

import numpy as np
from numpy.typing import NDArray
from PIL import GifImagePlugin, Image

from evedrop.errors import UsageError
from evedrop.show.view.picture import ended, frames_apart, give
from evedrop.show.view.viewer import end, guarded
from evedrop.system.files import whole_file

VIDEO_SIZE = (880, 660)
"""Width and height of a video in pixels: its words can be read where a page shows it in full."""
FRAME_RATE = 15.0
"""Frames per second."""
_MOST_GIF_RATE = 50.0  # browsers show faster ones slowly
_TRANSPARENT = 255
"""The last of the colours of a frame of a GIF, in which the pixel of the frame before it is seen."""
_KEEP = 1  # the next frame is drawn over this one
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
        given = [
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
            guarded([ffmpeg(), *given, *coded, str(path)]),
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
    """A GIF that repeats. Each frame has only the pixels that are not as in the frame before it, in colours of its own.

    Pillow's own writer of several frames would keep all in memory.
    """

    def __init__(self, path: Path, rate: float) -> None:
        self._file = path.open("wb")
        self._rate = rate
        self._frames = 0
        self._shown: NDArray[np.uint8] | None = None

    def add(self, png: bytes) -> None:
        """See `VideoFile`."""
        with Image.open(BytesIO(png)) as picture:
            pixels = np.asarray(picture.convert("RGB"))
        changed = np.ones(pixels.shape[:2], np.bool_) if self._shown is None else (pixels != self._shown).any(axis=2)
        changed[0, 0] |= not changed.any()  # a frame has at least one pixel
        rows, columns = (np.flatnonzero(changed.any(axis=axis)) for axis in (1, 0))
        part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        frame = _quantized(pixels[part], changed[part])
        if self._shown is None:
            header, _ = GifImagePlugin.getheader(frame, info={"loop": 0})
            self._file.writelines(header)
        self._shown = pixels
        self._frames += 1
        duration = self._hundredths(self._frames) - self._hundredths(self._frames - 1)
        self._file.writelines(
            GifImagePlugin.getdata(
                frame,
                (int(columns[0]), int(rows[0])),
                duration=duration * _HUNDREDTH,
                include_color_table=True,
                transparency=_TRANSPARENT,
                disposal=_KEEP,
            )
        )

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


def _quantized(pixels: NDArray[np.uint8], changed: NDArray[np.bool_]) -> Image.Image:
    """The changed ones of some pixels (h, w, 3), at least one, in the 255 colours that suit them; the others are transparent."""
    drawn = Image.fromarray(pixels[changed][None]).quantize(_TRANSPARENT, dither=Image.Dither.NONE)
    indices = np.full(changed.shape, _TRANSPARENT, np.uint8)
    indices[changed] = np.asarray(drawn)[0]
    frame = Image.frombytes("P", changed.shape[::-1], indices.tobytes())
    palette = drawn.getpalette() or []
    frame.putpalette(palette + [0] * (3 * (_TRANSPARENT + 1) - len(palette)))
    return frame


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
    panel: str | None = None,
    files: Mapping[str, Callable[[Path, float], VideoFile]] = VIDEO_FILES,
) -> list[str]:
    """Draw some moments of a recording as a video; returns the panels' complaints. The file appears when it is complete.

    rate: frames per second. on_progress: is called with the number of frames so far. panel: as in `picture_apart`. files: the end
    of a name → what writes the video.

    Raises UsageError as `picture_apart` does, and if such a video cannot be made here.
    """
    check_video(path, size, rate)
    complaints: list[str] = []
    # The last moment first: if it is not in the recording, nothing is drawn in vain.
    pictures = frames_apart(rrd, chain([moments[-1]], moments), size, panel, complaints)
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
