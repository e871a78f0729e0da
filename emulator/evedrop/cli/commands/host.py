"""`evedrop host`: the program that `evedrop run --hosts` starts on other hosts."""

from __future__ import annotations

import argparse

from evedrop.cli.command import Command


def host(options: argparse.Namespace) -> int:
    """Start processes of a run for a launcher on another host."""
    from evedrop.live.launch.other_hosts import serve_launcher

    del options
    serve_launcher()
    return 0


COMMANDS = (
    Command(
        "host",
        host,
        "start processes of a run for `evedrop run --hosts`, which calls this over ssh",
        section="processes",
        example="host",
        page="hosts",
    ),
)
