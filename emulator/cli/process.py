"""The commands about single processes of a run: write briefs, run one process, and ask whether it is present.

Slow imports are made only by the command that needs them, so that a peer starts quickly.
"""

from __future__ import annotations

import argparse
import contextlib
import os
from dataclasses import replace
from typing import TYPE_CHECKING

from evedrop.cli.commands import loaded
from evedrop.errors import BriefError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from evedrop.live.protocol.brief import Brief


_MOST_TOLD = 5  # mistakes of a scenario in a brief, which is not written by hand


def brief(options: argparse.Namespace) -> int:
    """Write the briefs."""
    from evedrop.live.launch.briefs import write_briefs
    from evedrop.live.launch.ports import places_at

    if not 1 <= options.wait <= 30 * 86_400:
        raise UsageError(f"--wait {options.wait}: expected 1 or more seconds, and 2592000 at most")
    scenario = loaded(options)
    places = places_at(options.listen, options.connect, options.relay, options.relay_connect, options.insecure)
    for path in write_briefs(scenario, places, options.results, options.out, options.wait):
        print(path)
    return 0


def process(options: argparse.Namespace) -> int:
    """Run one process of a run."""
    from evedrop.live.protocol.brief import read_brief
    from evedrop.plugins import look_in

    os.umask(0o077)  # only this user may read its files
    from evedrop.signals import leave_on_signals

    if options.role != "observer":  # which ends in order
        leave_on_signals()
    brief = read_brief(options.brief, options.role)
    if getattr(options, "out", None) is not None:
        brief = replace(brief, part={**brief.part, "results": str(options.out)})
    if brief.part.get("modules") is not None:
        look_in(str(brief.part["modules"]))
    try:
        return _play(brief, getattr(options, "serve", None))
    except BriefError as error:
        raise BriefError(f"{options.brief}: {error}") from error


def _play(brief: Brief, serve: str | None) -> int:
    """Run the process of a brief; returns its exit status. serve: where an observer shows the run to browsers."""
    from evedrop.errors import NotRegistered
    from evedrop.live.protocol.brief_use import expect_usable

    if brief.identity is not None:
        from evedrop.live.network.certificates import check_identity

        check_identity(brief.identity, brief.process)
    match brief.role:
        case "router":
            from evedrop.live.network.router import route as play
        case "relay":
            from evedrop.live.network.relay import relay as play
        case "sensor":
            from evedrop.peers.sensor import sense as play
        case "legitimate":
            from evedrop.peers.legitimate import estimate as play
        case "eavesdropper":
            from evedrop.peers.eavesdropper import eavesdrop as play
        case "controller":
            from evedrop.peers.controller import steer as play
        case "observer":
            from evedrop.live.observer.news import Heartbeat

            with Heartbeat() if brief.ends_with_stdin else contextlib.nullcontext():
                return _observe(brief, serve)
        case _:
            raise BriefError(f"unknown role {brief.role}; give one that `evedrop --help` lists")
    try:
        expect_usable(brief)
        play(brief)
    except NotRegistered as error:
        raise BriefError(f"it names {error.name}{error.why or ', which is not a class here'}") from error
    return 0


def _observe(brief: Brief, serve: str | None) -> int:
    from pydantic import ValidationError

    from evedrop.live.observer.observer import observe
    from evedrop.loading.mistakes import sentences

    try:
        return observe(brief, _report, serve)
    except ValidationError as error:
        lines = "; ".join(sentences(error)[:_MOST_TOLD])
        raise BriefError(f"part.scenario has mistakes: {lines}; write it again with `evedrop brief`") from error


def _report(folder: Path, status: int, how: str) -> None:
    """Print the end of a run that was started by hand."""
    from evedrop.cli.closing_report import print_ending

    print_ending(folder, status, how)


def health(options: argparse.Namespace) -> int:
    """Print whether a process is on the network."""
    from evedrop.live.network.health import is_there
    from evedrop.live.protocol.brief import read_brief

    brief = read_brief(options.brief)
    there = is_there(brief)
    print(f"{brief.process} is {'' if there else 'not '}on the network of {brief.run}")
    return 0 if there else 1
