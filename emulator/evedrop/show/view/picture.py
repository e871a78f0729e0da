"""Takes pictures of a finished recording without a screen."""

from __future__ import annotations

import itertools
import subprocess
import sys
import tempfile
from collections.abc import Generator, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

from evedrop.errors import UsageError
from evedrop.show.view.bounded_pipe import ended, give, received
from evedrop.show.view.headless import check, opened
from evedrop.show.view.viewer_process import end, guarded
from evedrop.system.environment import viewer_environment
from evedrop.system.files import whole_file
from evedrop.system.signals import raise_on_signals

__all__ = ["SIZE", "check_picture_name", "frames_apart", "opened", "picture_apart"]

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


def picture_apart(rrd: Path, png: Path, moment: float | None = None, size: tuple[int, int] = SIZE) -> list[str]:
    """Draw a moment of a recording, by default its last, to a PNG file; returns the panels' complaints.

    moment: a slot of a run, or seconds since the start of a wire. The file appears when it is complete.

    Raises UsageError if there is no Vulkan driver, the recording cannot be loaded, or the file cannot be written, and RunError if
    the process that draws hangs.
    """
    complaints: list[str] = []
    with whole_file(png) as temporary:
        for frame in frames_apart(rrd, None if moment is None else [moment], size, complaints):
            temporary.write_bytes(frame)
    return complaints


def frames_apart(
    rrd: Path, moments: Iterable[float] | None, size: tuple[int, int], complaints: list[str]
) -> Generator[bytes, None, None]:
    """Pictures of some moments, or of the last one, as PNG; the panels' complaints about the last are added to `complaints`.

    A separate process draws them, one at a time; in a separate network, too, if the system allows that. Otherwise anybody who
    finds the port of the headless viewer could control it.

    Raises UsageError as `picture_apart` does, and RunError if the process hangs.
    """
    check(rrd)
    command = [sys.executable, "-P", "-m", "evedrop.show.view.picture", str(rrd), *map(str, size)]
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
    rrd, width, height = words
    out = sys.stdout.buffer
    try:
        with raise_on_signals():
            first = sys.stdin.readline().strip()
            with opened(Path(rrd), (int(width), int(height)), _moment(first)) as viewer:
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
