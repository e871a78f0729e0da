"""The commands for single processes of a run: write briefs, run one process, and ask whether it is present.

Slow imports are made only by the command that needs them, so that a peer starts quickly.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.cli.command import Command, Option, command, flag, one_of, option, together
from evedrop.cli.commands import ROLES
from evedrop.cli.options import changes_of, entries, loaded, paused, scenario, served
from evedrop.errors import BriefError, EvedropError, RunError, UsageError
from evedrop.system.lacks import lack_of
from evedrop.system.output import say
from evedrop.system.world import world

if TYPE_CHECKING:
    from evedrop.live.protocol.brief import AnyBrief, Brief, RecorderPart


_BY_HAND = ("results", "listen", "connect", "relay", "relay_connect", "wait", "insecure", "paused")
"""Options that determine the briefs of processes that are started by hand."""
_MOST_TOLD = 5  # mistakes of a scenario in a brief, which is not written by hand


_BRIEFS = together(
    one_of(
        option("--out", "DIR", "folder for the briefs", type=Path),
        option("--compose", "DIR", "write the files for Docker Compose instead", type=Path),
        required=True,
    ),
    flag("--overwrite", "with --compose: DIR may contain files; replace those with the same names"),
    option(
        "--results",
        "DIR",
        "the recorder's results folder, on its host; relative to its working directory",
        type=Path,
        default=Path("results"),
    ),
    option(
        "--listen",
        "ENDPOINT",
        "the endpoint where the router listens, such as tls/router.lan:7447",
        default="tls/127.0.0.1:17447",
    ),
    option("--connect", "ENDPOINT", "the endpoint that the others connect to; default that of --listen"),
    option("--relay", "ENDPOINT", "where the second router listens, if the scenario has two"),
    option("--relay-connect", "ENDPOINT", "the endpoint that its processes connect to; default that of --relay"),
    option("--wait", "SECONDS", "how long processes wait for each other; default 600", type=int, default=600),
    flag("--insecure", "listen without encryption although other machines can reach it"),
    paused,
)


@command((scenario, entries, _BRIEFS), section="processes", example="brief vehicle --out briefs", page="hosts")
def brief(options: argparse.Namespace) -> int:
    """Write the files with which each process of a run is started by hand, or by Docker Compose."""
    from evedrop.live.launch.briefs import write_briefs
    from evedrop.live.launch.ports import endpoints_at, warn_if_exposed

    if options.compose is not None:
        return _compose(options)
    if options.overwrite:
        raise UsageError("--overwrite belongs to --compose; leave it out, or give another --out")
    if not 1 <= options.wait <= 30 * 86_400:
        raise UsageError(f"--wait {options.wait}: expected 1 or more seconds, and 2592000 at most")
    scenario = loaded(options)
    endpoints = endpoints_at(options.listen, options.connect, options.relay, options.relay_connect, options.insecure)
    for path in write_briefs(scenario, endpoints, options.results, options.out, options.wait, paused=options.paused):
        print(path)
    warn_if_exposed(endpoints)
    return 0


def _compose(options: argparse.Namespace) -> int:
    """Write the files with which Docker Compose starts a run."""
    from evedrop.live.launch.compose import MOST_NETWORKS, network_count, write_compose

    for name in _BY_HAND:
        if getattr(options, name) != options.parser.get_default(name):
            option = f"--{name.replace('_', '-')}"
            raise UsageError(
                f"{option} belongs to briefs for processes that are started by hand; leave it out, or give --out instead of "
                "--compose"
            )
    scenario = loaded(options)
    for path in write_compose(
        scenario, options.scenario, bool(changes_of(options)), options.compose, options.overwrite
    ):
        print(path)
    if (networks := network_count(scenario)) > MOST_NETWORKS:
        print(
            f"evedrop: warning: the containers have {networks} networks, and Docker's default address pools have room for "
            f"about {MOST_NETWORKS}; enlarge them (evedrop docs containers)",
            file=sys.stderr,
        )
    return 0


def process(options: argparse.Namespace) -> int:
    """Run one process of a run."""
    from evedrop.live.protocol.brief import ImportingPart, RecorderPart, RoutingPart, read_brief
    from evedrop.scenario.plugins import look_in

    world().process.keep_files_private()
    world().process.show_stacks()
    if options.role != "recorder":  # the recorder ends the run in order
        world().process.leave_on_signals()
    world().process.on_thread_failure(_end_of_thread)  # also of one that starts before the brief is read
    brief = read_brief(options.brief, options.role)
    world().process.on_thread_failure(partial(_end_of_thread, last_word=brief.last_word))
    if brief.ends_with_stdin:  # started by a launcher, which writes another brief if it restarts the process
        options.brief.unlink(missing_ok=True)  # its keys should not stay on disk
        world().process.continue_when_parent_dies()
        if isinstance(brief.part, RoutingPart):
            world().process.keep_events_apart(launched=True)  # before the modules of link classes print anything
    if isinstance(brief.part, RecorderPart) and getattr(options, "out", None) is not None:
        brief = replace(brief, part=replace(brief.part, results=str(options.out)))
    if isinstance(brief.part, ImportingPart) and brief.part.modules is not None:
        look_in(brief.part.modules)
    try:
        return _play(brief, getattr(options, "serve", None))
    except EvedropError as error:
        from evedrop.live.protocol.last_word import LastWord

        LastWord.about(error).leave(brief.last_word)
        if isinstance(error, BriefError):
            raise BriefError(f"{options.brief}: {error}") from error
        raise


def _end_of_thread(error: BaseException, last_word: str | None = None) -> None:
    """End the process, because an error has ended one of its threads: it would wait for ever for what that thread does."""
    import traceback

    from evedrop.live.protocol.last_word import LastWord

    if isinstance(error, EvedropError):  # such as a message that breaks the protocol
        LastWord.about(error).leave(last_word)
        say(error.illustrated)
    elif (lack := lack_of(error)) is not None:
        say(lack)
    else:
        traceback.print_exception(error)
    sys.stderr.flush()
    world().process.exit(RunError.exit_status)


def _play(brief: AnyBrief, serve: str | None) -> int:
    """Run the process of a brief; returns its exit status. serve: where a recorder shows the run to browsers."""
    from evedrop.live.protocol.brief import RecorderPart, classes_known, has_part

    if brief.identity is not None:
        from evedrop.live.network.certificates import check_identity

        check_identity(brief.identity, brief.process)
    if has_part(brief, RecorderPart):
        from evedrop.live.network.launcher_pipe import heartbeat

        with heartbeat() if brief.ends_with_stdin else contextlib.nullcontext():
            return _record(brief, serve)
    brief.expect_usable()

    with classes_known(), world().process.native_log_apart() if _listens(brief) else contextlib.nullcontext():
        _take_part(brief)
    return 0


def _listens(brief: AnyBrief) -> bool:
    """Whether strangers may connect to the process: to a router, or a sensor that takes states from programs."""
    from evedrop.live.protocol.brief import RoutingPart, SensorPart

    part = brief.part
    program = part.program if isinstance(part, SensorPart) else None
    return isinstance(part, RoutingPart) or (program is not None and program.listen is not None)


def _take_part(brief: AnyBrief) -> None:
    """Run the process of a brief that is not the recorder's."""
    from evedrop.live.protocol import brief as parts
    from evedrop.live.protocol.brief import has_part

    if has_part(brief, parts.RouterPart):
        from evedrop.live.network.router import route

        route(brief)
    elif has_part(brief, parts.RelayPart):
        from evedrop.live.network.router import relay

        relay(brief)
    elif has_part(brief, parts.SensorPart):
        from evedrop.peers.sensor import sense

        sense(brief)
    elif has_part(brief, parts.LegitimatePart):
        from evedrop.peers.legitimate import estimate

        estimate(brief)
    elif has_part(brief, parts.EavesdropperPart):
        from evedrop.peers.eavesdropper import eavesdrop

        eavesdrop(brief)
    elif has_part(brief, parts.ControllerPart):
        from evedrop.peers.controller import steer

        steer(brief)


def _record(brief: Brief[RecorderPart], serve: str | None) -> int:
    from pydantic import ValidationError

    from evedrop.live.protocol.brief import WRITE_AGAIN
    from evedrop.live.recorder.recorder import record
    from evedrop.scenario.table import sentences
    from evedrop.scenario.tables import Scenario

    try:
        return record(brief, _report, serve)
    except ValidationError as error:
        lines = "; ".join(sentences(error, Scenario)[:_MOST_TOLD])
        raise BriefError(f"part.scenario has mistakes: {lines}; {WRITE_AGAIN}") from None


def _report(folder: Path, status: int, how: str) -> None:
    """Print the end of a run that was started by hand."""
    from evedrop.cli.report import print_ending

    print_ending(folder, status, how)


_BRIEF = option("brief", "BRIEF", type=Path)


@command((_BRIEF,), section="processes", example="health briefs/smart.json", page="containers")
def health(options: argparse.Namespace) -> int:
    """Check that the process of a brief is on the network."""
    from evedrop.live.network.operator import is_there
    from evedrop.live.protocol.brief import read_brief

    brief = read_brief(options.brief)
    there = is_there(brief)
    print(f"{brief.process} is {'' if there else 'not '}on the network of {brief.run}")
    return 0 if there else 1


_RESULTS_FOLDER = option("--out", "DIR", "results folder, new or empty; default the brief's", type=Path)


def _role(role: str) -> Option:
    return lambda parser: parser.set_defaults(role=role)


@command(section="processes", example="host", page="hosts")
def host(options: argparse.Namespace) -> int:
    """Start processes of a run for `evedrop run --hosts`, which calls this over ssh."""
    from evedrop.live.launch.other_hosts import serve_launcher

    del options
    if sys.stdin is None or sys.stdin.isatty():
        raise UsageError("`evedrop host` is started by `evedrop run SCENARIO --hosts FILE`, over ssh; use that command")
    serve_launcher()
    return 0


COMMANDS = (
    brief,
    health,
    *(
        Command(
            role,
            process,
            f"run only the {role}",
            (_BRIEF, _role(role), *((_RESULTS_FOLDER, served) if role == "recorder" else ())),
            section="processes",
            example=f"{role} briefs/{role}.json",
            page="hosts",
        )
        for role in ROLES
    ),
    host,
)
