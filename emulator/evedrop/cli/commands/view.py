"""`evedrop view`: a finished run or wire, on the screen, in a picture or as a table."""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.cli.command import command, number_type, one_of, option, together
from evedrop.cli.options import hold, served, tables, verbose
from evedrop.errors import UsageError
from evedrop.system.output import tell

if TYPE_CHECKING:
    from evedrop.show.view.viewer import Viewer

_MOST_RATE = 60
_SECONDS = 10.0  # of a video
_BEFORE = 0.75  # of the slots of a video, before the most telling one
_WIRE_RATE = 8.0  # frames per second of a whole wire: all its curves move, so that 15 would be a GIF of more than 3 MB
_MOST_TIMES = 1_000_000  # frames of a video of a wire: eighteen hours at 15 a second
_LEAST, _MOST = 200, 3840  # pixels; the viewer takes more than its time limit for larger pictures


def _size(text: str) -> tuple[int, int]:
    """A width and a height. Raises ArgumentTypeError."""
    width, _, height = text.partition("x")
    try:
        size = int(width), int(height)
    except ValueError:
        size = 0, 0
    if not (_LEAST <= size[0] <= _MOST and _LEAST <= size[1] <= _MOST):
        raise argparse.ArgumentTypeError(
            f"{text} is not a width and a height from {_LEAST} to {_MOST} pixels, such as 1200x720"
        )
    return size


def _moments(text: str) -> tuple[float, float, float | None]:
    """First, last and step of slots or times; the step is None if it is not given. Raises ArgumentTypeError."""
    try:
        first, last, *step = (float(part) for part in text.split(":"))
    except ValueError:
        first, last, step = 0.0, -1.0, []
    if not (0 <= first <= last < math.inf and len(step) <= 1 and all(0 < seconds < math.inf for seconds in step)):
        raise argparse.ArgumentTypeError(f"{text} is not FIRST:LAST or FIRST:LAST:STEP, such as 100:200 or 100:200:2")
    return first, last, step[0] if step else None


def _instead(parser: argparse.ArgumentParser) -> None:
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--picture", type=Path, metavar="FILE.png", help="draw the run into a file instead; needs no screen"
    )
    group.add_argument(
        "--video", type=Path, metavar="FILE.mp4|gif", help="draw some slots as a video instead; needs no screen"
    )
    verbose(parser)  # the help lists it here
    group.add_argument("--table", action="store_true", help="print its table and sentences instead")


_SHOWN = together(
    option("--view", help_text="default auto", choices=("auto", "native", "web"), default="auto"),
    _instead,
    one_of(
        option("--slot", "K", "the slot to draw; default the most telling one", type=int),
        option("--time", "SECONDS", "for a wire: the time to draw; default the end", type=float),
        option(
            "--slots",
            "A:B[:STEP]",
            "the slots of a video; default ten seconds around the most telling one",
            type=_moments,
        ),
        option("--times", "A:B[:STEP]", "for a wire: the times of a video, in seconds; default all", type=_moments),
    ),
    option("--panel", "NAME", "the tab or panel to draw, such as numbers or packets; default the first tab"),
    option(
        "--fps",
        "F",
        "frames per second of a video; default 15, fewer for a video of less than ten seconds and for a wire",
        type=number_type(1, _MOST_RATE, f"a number of frames per second from 1 to {_MOST_RATE}"),
    ),
    option("--size", "WxH", "in pixels; default 1600x950 for a picture, 880x660 for a video", type=_size),
)


@command(
    (option("run", "RUN", type=Path), _SHOWN, served, tables),
    section="inspect",
    example="view runs/vehicle --picture vehicle.png",
    page="view",
)
def view(options: argparse.Namespace) -> int:
    """Open a finished run or wire, draw it, or print its report again."""
    from evedrop.results.wire_summary import is_wire

    if is_wire(options.run):
        return _view_wire(options)
    if options.time is not None:
        raise UsageError("--time is for wires; a run has slots, so give --slot")
    _check_names(options)
    if options.table:
        from evedrop.cli.report import print_report_line, print_results
        from evedrop.results.reading import results_of_this_version

        with results_of_this_version(options.run):
            print_results(options.run, verbose=options.verbose)
        print_report_line(options.run)
        return 0
    from evedrop.results.reading import Results
    from evedrop.show.view.viewer import WebAddress, open_run
    from evedrop.system.signals import raise_on_signals

    web_address = None if options.serve is None else WebAddress.of(options.serve)
    results = Results.read(options.run) if not (options.run / "summary.json").is_file() else None
    if results is not None:
        print(f"evedrop: {results.remark}", file=sys.stderr)
    with raise_on_signals(), tempfile.TemporaryDirectory(prefix="evedrop-view-") as temporary:
        # Chosen first: a recording that is then made of a run in progress has these slots, and perhaps more.
        slots: Sequence[int] = () if options.video is None else _slots_of(options)
        slot = _chosen_slot(options.run) if options.picture is not None and options.slot is None else options.slot
        recording = _recording(options.run, Path(temporary), finished=results is None)
        if options.video is not None:
            return _film(recording, options, slots)
        if options.picture is None:
            _hold("run", open_run(options.run, options.view, web_address, recording))
            return 0
        from evedrop.show.view.picture import SIZE, picture_apart

        for complaint in picture_apart(recording, options.picture, slot, options.size or SIZE, options.panel):
            print(complaint, file=sys.stderr)
    return 0


def _recording(run: Path, temporary: Path, *, finished: bool) -> Path:
    """The recording of a run. One that is made first is kept beside the results if the run is finished."""
    recording = run / "recording.rrd"
    if finished and recording.is_file():
        return recording
    from evedrop.show.view.scene_slots import replay

    return replay(run, recording if finished and os.access(run, os.W_OK) else temporary / recording.name)


def _check_names(options: argparse.Namespace) -> None:
    """Raise UsageError for a picture or a video that cannot be made, or an option of one, before anything is drawn."""
    picture, video = options.picture is not None, options.video is not None
    for name, fits, what in (
        ("panel", picture or video, "a picture or a video; give --picture or --video, too"),
        ("size", picture or video, "a picture or a video; give --picture or --video, too"),
        ("slot", picture or video, "a picture; give --picture, too"),
        ("time", picture or video, "a picture; give --picture, too"),
        ("fps", video, "a video; give --video, too"),
        ("verbose", options.table, "a table; give --table, too"),
        ("csv", options.table, "a table; give --table, too"),
        ("latex", options.table, "a table; give --table, too"),
        ("serve", not (picture or video or options.table), "a view on the screen; leave it out"),
    ):
        given = getattr(options, name)
        if given is not None and given is not False and not fits:
            raise UsageError(f"--{name} is for {what}")
    if options.picture is not None:
        from evedrop.show.view.picture import check_picture_name

        check_picture_name(options.picture)
    if options.video is not None:
        from evedrop.show.view.video import FRAME_RATE, VIDEO_SIZE, check_video

        check_video(options.video, options.size or VIDEO_SIZE, options.fps or FRAME_RATE)
        if options.slot is not None or options.time is not None:
            raise UsageError("a video shows more than one moment; give --slots for a run, and --times for a wire")
    elif options.slots is not None or options.times is not None:
        raise UsageError("--slots and --times are for a video; give --video, or --slot or --time for a picture")


def _slots_of(options: argparse.Namespace) -> Sequence[int]:
    """The slots of a video: some that are given, or those of ten seconds."""
    if options.times is not None:
        raise UsageError("--times is for wires; a run has slots, so give --slots")
    if options.slots is None:
        from evedrop.results.reading import Results
        from evedrop.show.view.video import FRAME_RATE

        slots = int(Results.read(options.run).summary["slots"])
        frames = round(_SECONDS * (options.fps or FRAME_RATE))
        slot = _chosen_slot(options.run)
        if slot is None:  # every picture shows the whole run
            count = min(slots, frames)
            return [(slots - 1) * i // max(1, count - 1) for i in range(count)]
        first = max(0, min(slots - frames, slot - int(_BEFORE * frames)))
        return range(first, min(slots, first + frames))
    from evedrop.model.checks import LAST_SLOT

    first, last, step = options.slots
    if not all(float(part).is_integer() for part in options.slots if part is not None):
        raise UsageError("--slots has a fraction of a slot; give whole numbers")
    if last > LAST_SLOT:
        raise UsageError(f"--slots up to {last:g} are more than a run can have; give slots of the run")
    return range(int(first), int(last) + 1, int(step or 1))


def _times_of(options: argparse.Namespace) -> Sequence[float]:
    """The times of a video of a wire: some that are given, in real time, or the whole wire in ten seconds."""
    from evedrop.show.view.video import FRAME_RATE
    from evedrop.wire.recording import wire_seconds

    if options.slots is not None:
        raise UsageError(f"--slots is for runs, and {options.run} is the folder of a wire; give --times")
    if options.times is None:
        seconds, frames = wire_seconds(options.run), round(_SECONDS * (options.fps or _WIRE_RATE))
        return [seconds * i / (frames - 1) for i in range(frames)]
    first, last, step = options.times
    step = 1.0 / (options.fps or FRAME_RATE) if step is None else step
    if (last - first) / step >= _MOST_TIMES:
        raise UsageError(
            f"--times gives more than {_MOST_TIMES:,} frames; give a shorter time, or a larger step as in 0:60:0.1"
        )
    return [first + number * step for number in range(int((last - first) / step + 1e-9) + 1)]


def _film(recording: Path, options: argparse.Namespace, moments: Sequence[float]) -> int:
    """Draw some moments as a video."""
    from evedrop.cli.console import ProgressLine
    from evedrop.scenario.progress_events import RunProgress
    from evedrop.show.view.video import FRAME_RATE, VIDEO_SIZE, video_apart

    start = time.monotonic()
    with ProgressLine(len(moments), "frames") as line:

        def on_event(done: int) -> None:
            line.on_event(RunProgress(done, done / (time.monotonic() - start), "frames/s", {}))

        given = options.slots is not None or options.times is not None
        rate = options.fps or (FRAME_RATE if given else min(FRAME_RATE, max(1.0, len(moments) / _SECONDS)))
        size = options.size or VIDEO_SIZE
        complaints = video_apart(recording, options.video, moments, size, rate, on_event, options.panel)
    frames = f"{len(moments)} frames are" if len(moments) > 1 else "1 frame is"
    print("\n".join([*complaints, f"{frames} in {options.video}"]))
    return 0


def _chosen_slot(run: Path) -> int | None:
    """Choose the most telling slot, and print it; None for the last slot."""
    from evedrop.results.reading import Results
    from evedrop.show.view.telling_slot import telling_slot

    slot = telling_slot(Results.read(run))
    if slot is not None:
        print(f"chose slot {slot}, the most telling one")
    return slot


def _view_wire(options: argparse.Namespace) -> int:
    """Show or draw a wire, from its journal, or print its table."""
    from evedrop.cli.report import terminal
    from evedrop.show.report.wire import wire_failures, wire_table
    from evedrop.show.view.picture import picture_apart
    from evedrop.show.view.viewer import WebAddress, open_run
    from evedrop.system.signals import raise_on_signals
    from evedrop.wire.on_disk import closing_lines, summary_of_wire
    from evedrop.wire.recording import PICTURE_SIZE, replay_wire

    _check_names(options)
    if options.slot is not None:
        raise UsageError(f"--slot is for runs, and {options.run} is the folder of a wire; give --time")
    if options.table:
        summary = summary_of_wire(options.run)
        terminal().take(wire_table(summary))
        for line in closing_lines(summary):
            tell(line)
        for line in wire_failures(summary):
            tell(line, line)
        return 0
    web_address = None if options.serve is None else WebAddress.of(options.serve)
    with raise_on_signals(), tempfile.TemporaryDirectory(prefix="evedrop-view-") as temporary:
        recording = replay_wire(options.run, Path(temporary) / "recording.rrd")
        if options.video is not None:
            return _film(recording, options, _times_of(options))
        if options.picture is None:
            _hold("wire", open_run(options.run, options.view, web_address, recording))
            return 0
        size = options.size or PICTURE_SIZE
        for complaint in picture_apart(recording, options.picture, options.time, size, options.panel):
            print(complaint, file=sys.stderr)
    return 0


def _hold(subject: str, viewer: Viewer) -> None:
    """Say where a viewer is, and wait until it is closed."""
    if viewer.address:  # on a line of its own: a browser would take what follows as part of it
        print(f"the {subject} is shown to anybody who has this address; Ctrl-C ends it:\n{viewer.address}", flush=True)
    else:
        print(f"the {subject} is shown; Ctrl-C ends it", flush=True)
    if viewer.warning is not None:
        print(f"evedrop: warning: {viewer.warning}", file=sys.stderr)
    hold(viewer)


COMMANDS = (view,)
