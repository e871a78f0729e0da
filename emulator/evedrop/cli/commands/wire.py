"""`evedrop wire`: links with faults between programs that know nothing of Evedrop, over Zenoh."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from evedrop.cli.command import command, flag, option, together
from evedrop.cli.options import changes_of
from evedrop.counting import counted
from evedrop.errors import UsageError
from evedrop.system.output import say as complain
from evedrop.system.output import tell, warn

_FILE = together(
    option("file", "FILE", "a wire file", nargs="?", type=Path),
    option("keys", "KEY", "with --check: a key, or key expression, of messages", nargs="*"),
    flag("--check", "say what the file means, and which link each KEY takes; start nothing"),
    flag("--example", "print an example of a wire file"),
    option(
        "--set",
        "KEY=VALUE",
        "change an entry of the file by its dotted key, such as link.1.quality=0.5; repeatable",
        dest="changes",
        action="append",
        default=[],
    ),
)


_COURSE = together(
    option("--out", "DIR", "results folder; that of an earlier wire, to go on with its fates", type=Path),
    option(
        "--view",
        "VIEW",
        "auto, native or web: show the wire; FILE.rrd: write the view to a file; default off",
        default="off",
    ),
    flag("--quiet", "print only warnings and errors"),
    option("--for", "TIME", 'end after this time, such as "60 s"; default: at Ctrl-C', dest="seconds"),
)


@command((_FILE, _COURSE), section="run", example="wire robot.toml --out runs/wire", page="wire/tutorial")
def wire(options: argparse.Namespace) -> int:
    """Run links with faults between programs that use Zenoh or ROS 2."""
    from evedrop.wire.file import example_wire, load_wire

    if options.example:
        if options.file is not None:
            raise UsageError("wire --example: expected no FILE; it prints an example of one")
        print(example_wire(), end="")
        return 0
    if options.file is None:
        raise UsageError("wire: expected a FILE; `evedrop wire --example` prints one")
    if options.keys and not options.check:
        raise UsageError(
            f"wire {options.file} {options.keys[0]}: keys are for --check, which says which link a key takes"
        )
    from evedrop.wire.file import key_lines, warnings_of_wire, wire_lines
    from evedrop.wire.tables import seconds_of

    seconds = None if options.seconds is None else seconds_of(options.seconds, "wire --for")
    plan = load_wire(options.file, changes_of(options))
    if options.check:
        lines = [*wire_lines(plan), *key_lines(plan, options.keys)]
        counts = (("side", plan.sides), ("link", plan.links), ("event", plan.events))
        parts = ", ".join(counted(len(some), noun) for noun, some in counts)
        tell(f"{options.file}: {parts}: no mistakes")
        tell("\n".join(f"  {line}" for line in lines))
    for warning in warnings_of_wire(plan):
        warn(warning)
    if options.check:
        return 0
    from evedrop.cli.report import report_page
    from evedrop.results.folder import results_folder
    from evedrop.system.world import world
    from evedrop.wire.on_disk import write_wire_report
    from evedrop.wire.run import run_wire

    world().process.keep_modules()  # new keys cause collections
    with results_folder(options.out, f"wire-{options.file.stem}") as folder:
        options.out = folder
        speaking = {"say": _hush, "complain": complain} if options.quiet else {"say": _say}
        with world().process.native_log_apart():
            status = run_wire(plan, folder, seconds=seconds, view=options.view, **speaking)
        report_page(folder, options.quiet, write_wire_report)
        return status


def _say(line: str) -> None:
    """Print a line at once, for programs that wait for the endpoints."""
    tell(line)
    sys.stdout.flush()


def _hush(line: str) -> None:
    """Print nothing."""


COMMANDS = (wire,)
