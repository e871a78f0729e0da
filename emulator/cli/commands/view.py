"""`evedrop view`: a finished run or wire, on the screen, in a picture or as a table."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.cli.holding import hold
from evedrop.cli.options import argument, served
from evedrop.command import Command
from evedrop.errors import UsageError

if TYPE_CHECKING:
    from evedrop.view.viewer import Viewer

_LEAST, _MOST = 320, 3840  # pixels; the viewer takes more than its time limit for larger pictures


def view(options: argparse.Namespace) -> int:
    """Open a finished run or wire, draw it, or print its closing report again."""
    from evedrop.wire.folder import is_wire

    if is_wire(options.run):
        return _view_wire(options)
    if options.time is not None:
        raise UsageError("--time is for wires; a run has slots, so give --slot")
    _check_names(options)
    if options.table:
        from evedrop.cli.closing_report import print_results

        print_results(options.run)
        return 0
    from evedrop.results.writer import load_results
    from evedrop.signals import raise_on_signals
    from evedrop.view.viewer import WebAddress, open_run

    stand = None if options.serve is None else WebAddress.of(options.serve)
    results = load_results(options.run) if not (options.run / "summary.json").is_file() else None
    if results is not None:
        print(f"evedrop: {results.remark}", file=sys.stderr)
    with raise_on_signals(), tempfile.TemporaryDirectory(prefix="evedrop-view-") as temporary:
        recording = options.run / "recording.rrd"
        if results is not None or not recording.is_file():
            from evedrop.view.replay import replay
        if results is not None:  # a run in progress, or a killed one, has no complete recording
            recording = replay(options.run, Path(temporary) / "recording.rrd")
        elif not recording.is_file():
            recording = replay(options.run)
        if options.picture is None:
            _hold("run", open_run(options.run, options.view, stand, recording))
            return 0
        from evedrop.view.picture import SIZE, picture_apart

        slot = _chosen_slot(options.run) if options.slot is None else options.slot
        for complaint in picture_apart(recording, options.picture, slot, options.size or SIZE):
            print(complaint, file=sys.stderr)
    return 0


def _check_names(options: argparse.Namespace) -> None:
    """Raise UsageError for a picture that cannot be written, before anything is drawn."""
    if options.picture is not None:
        from evedrop.view.picture import check_picture_name

        check_picture_name(options.picture)


def _chosen_slot(run: Path) -> int | None:
    """The slot that tells most, which is printed; None for the last one."""
    from evedrop.results.writer import load_results
    from evedrop.view.telling_slot import telling_slot

    slot = telling_slot(load_results(run))
    if slot is not None:
        print(f"slot {slot} is drawn; --slot chooses another")
    return slot


def _view_wire(options: argparse.Namespace) -> int:
    """Show or draw a wire, from its journal, or print its table."""
    from evedrop.signals import raise_on_signals
    from evedrop.view.picture import picture_apart
    from evedrop.view.viewer import WebAddress, open_run
    from evedrop.wire.closing import closing_lines, wire_failures
    from evedrop.wire.replay import PICTURE_SIZE, replay_wire, summary_of_wire

    _check_names(options)
    if options.slot is not None:
        raise UsageError(f"--slot is for runs, and {options.run} is the folder of a wire; give --time")
    if options.table:
        summary = summary_of_wire(options.run)
        print("\n".join([*closing_lines(summary), *wire_failures(summary)]))
        return 0
    stand = None if options.serve is None else WebAddress.of(options.serve)
    with raise_on_signals(), tempfile.TemporaryDirectory(prefix="evedrop-view-") as temporary:
        recording = replay_wire(options.run, Path(temporary) / "recording.rrd")
        if options.picture is None:
            _hold("wire", open_run(options.run, options.view, stand, recording))
            return 0
        for complaint in picture_apart(recording, options.picture, options.time, options.size or PICTURE_SIZE):
            print(complaint, file=sys.stderr)
    return 0


def _hold(what: str, viewer: Viewer) -> None:
    """Say where a viewer is, and wait until it is closed."""
    where = f" at {viewer.address}, to anybody who has this address" if viewer.address else ""
    print(f"the {what} is shown{where}; Ctrl-C ends it", flush=True)
    if viewer.warning is not None:
        print(f"evedrop: warning: {viewer.warning}", file=sys.stderr)
    hold(viewer)


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


def _shown(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--view", choices=("auto", "native", "web"), default="auto", help="default auto")
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument(
        "--picture", type=Path, metavar="FILE.png", help="draw the run into a file instead; needs no screen"
    )
    instead.add_argument("--table", action="store_true", help="print its table and sentences instead")
    moment = parser.add_mutually_exclusive_group()
    moment.add_argument("--slot", type=int, metavar="K", help="the slot to draw; default one that tells much")
    moment.add_argument("--time", type=float, metavar="SECONDS", help="for a wire: the time to draw; default the end")
    parser.add_argument("--size", type=_size, metavar="WxH", help="of the picture, in pixels; default 1600x950")


COMMANDS = (
    Command(
        "view",
        view,
        "open a finished run or wire, draw it, or print its report again",
        (argument("run", "RUN"), _shown, served),
        section="inspect",
        example="view runs/vehicle --picture vehicle.png",
        page="view",
    ),
)
