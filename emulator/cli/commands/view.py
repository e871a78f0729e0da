"""`evedrop view`: a finished run, on the screen, in a picture or as a table."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from evedrop.cli.holding import hold
from evedrop.cli.options import argument, served
from evedrop.command import Command


def view(options: argparse.Namespace) -> int:
    """Open a finished run, draw it, or print its closing report again."""
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
            viewer = open_run(options.run, options.view, stand, recording)
            where = f" at {viewer.address}, to anybody who has this address" if viewer.address else ""
            print(f"the run is shown{where}; Ctrl-C ends it", flush=True)
            if viewer.warning is not None:
                print(f"evedrop: warning: {viewer.warning}", file=sys.stderr)
            hold(viewer)
            return 0
        from evedrop.view.picture import picture_apart

        for complaint in picture_apart(recording, options.picture, options.slot):
            print(complaint, file=sys.stderr)
    return 0


def _shown(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--view", choices=("auto", "native", "web"), default="auto", help="default auto")
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument(
        "--picture", type=Path, metavar="FILE.png", help="draw the run into a file instead; needs no screen"
    )
    instead.add_argument("--table", action="store_true", help="print the run's table and verdict instead")
    parser.add_argument("--slot", type=int, metavar="K", help="the slot to draw; default the last")


COMMANDS = (
    Command(
        "view",
        view,
        "open a finished run, draw it, or print its report again",
        (argument("run", "RUN"), _shown, served),
        section="inspect",
        example="view runs/vehicle --picture vehicle.png",
        page="view",
    ),
)
