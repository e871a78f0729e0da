"""The commands for a run or wire in progress: each asks the run's recorder, or the wire, prints the answer, and ends.

Slow imports are made only by the command that needs them.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evedrop.cli.command import command, option, together
from evedrop.cli.options import as_json
from evedrop.counting import counted
from evedrop.errors import BriefError, UsageError
from evedrop.system.output import print_json, warn
from evedrop.system.world import world

if TYPE_CHECKING:
    from evedrop.live.network.control_file import Control
    from evedrop.live.network.operator import Answer
    from evedrop.live.protocol.requests import OperatorRequest

_PATIENCE = 60.0  # seconds; a hold may wait for a process that the scenario has restarted
_AWAY_SECONDS = 5.0  # for which a run may have no recorder at its router
_AGAIN_SECONDS = 0.2
_STEP_PATIENCE = 30 * 86_400.0  # a step takes as long as its slots do


_GOING_ON = option("run", "RUN", "the results folder of a run or wire in progress", type=Path)


_CHANGED_LINK = together(
    option("name", "NAME", "the receiver whose link it is; of a wire, the link"),
    option(
        "changes",
        "KEY=VALUE",
        "an entry of the link, such as quality=0.2, with a dotted key for an entry of a table; or the word cut or heal",
        nargs="+",
    ),
)


@command((_GOING_ON, _CHANGED_LINK), section="steer", example="link runs/vehicle smart quality=0.2", page="control")
def link(options: argparse.Namespace) -> int:
    """Change, cut or heal a link of a running simulation or wire."""
    from evedrop.live.protocol.requests import LinkRequest

    event = _event(options.name, options.changes)
    return _ask(options.run, LinkRequest(event), f"link {options.name}")


_TWO_SIDES = together(option("one", "A", "a side of the wire"), option("other", "B", "another side of the wire"))


@command((_GOING_ON, _TWO_SIDES), section="steer", example="partition runs/wire robot base", page="wire/file")
def partition(options: argparse.Namespace) -> int:
    """Let nothing pass between two sides of a running wire."""
    from evedrop.live.protocol.requests import LinkRequest

    event = {"partition": [options.one, options.other]}
    return _ask(options.run, LinkRequest(event), f"partition {options.one} {options.other}")


@command((_GOING_ON, _TWO_SIDES), section="steer", example="heal runs/wire robot base", page="wire/file")
def heal(options: argparse.Namespace) -> int:
    """End the partition of two sides of a running wire."""
    from evedrop.live.protocol.requests import LinkRequest

    event = {"join": [options.one, options.other]}
    return _ask(options.run, LinkRequest(event), f"heal {options.one} {options.other}")


@command((_GOING_ON,), section="steer", example="pause runs/vehicle", page="control")
def pause(options: argparse.Namespace) -> int:
    """Pause a running simulation."""
    from evedrop.live.protocol.requests import PauseRequest

    return _ask(options.run, PauseRequest(), "pause")


@command((_GOING_ON,), section="steer", example="resume runs/vehicle", page="control")
def resume(options: argparse.Namespace) -> int:
    """Resume a paused run."""
    from evedrop.live.protocol.requests import ResumeRequest

    return _ask(options.run, ResumeRequest(), "resume")


_SLOTS = option("slots", "N", "number of slots", type=int)


@command((_GOING_ON, _SLOTS), section="steer", example="step runs/vehicle 10", page="control")
def step(options: argparse.Namespace) -> int:
    """Advance a paused run by N slots."""
    from evedrop.live.protocol.requests import StepRequest
    from evedrop.model.streams import MOST_SLOTS

    if not 1 <= options.slots <= MOST_SLOTS:
        raise UsageError(f"step {options.slots}: expected 1 or more slots, and {MOST_SLOTS} at most")
    return _ask(options.run, StepRequest(options.slots), f"step {options.slots}", _STEP_PATIENCE)


@command((_GOING_ON, as_json), section="steer", example="status runs/vehicle", page="control")
def status(options: argparse.Namespace) -> int:
    """Show the status of a running simulation or wire."""
    from msgspec import to_builtins

    from evedrop.live.network.control_file import read_controls, shards_in
    from evedrop.live.protocol.requests import StatusRequest, status_of_shards

    answers, ended, shards = [], [], shards_in(options.run)
    for control in read_controls(options.run):
        try:
            answers.append(_answer(options.run, control, StatusRequest(), "status", _PATIENCE))
        except UsageError as error:
            if control in read_controls(options.run):  # it is not a shard that has ended meanwhile
                raise
            ended.append(error)
    if not answers:
        raise ended[0]
    if shards > len(answers):
        warn(f"{shards - len(answers)} of {shards} shards have not begun or are over; the status is that of the others")
    merged = answers[0].wire or status_of_shards([answer.status for answer in answers if answer.status is not None])
    if options.json:
        print_json(to_builtins(merged))
    else:
        print("\n".join(merged.lines))
    return 0


def _ask(run: Path, request: OperatorRequest, subject: str, patience: float = _PATIENCE) -> int:
    from evedrop.live.network.control_file import read_controls

    control = read_controls(run)[0]  # in a run in shards, any of them refuses
    print(_answer(run, control, request, subject, patience).effect)
    return 0


def _answer(run: Path, control: Control, request: OperatorRequest, subject: str, patience: float) -> Answer:
    """The answer of the recorder of a run or a shard. Raises UsageError if it does not answer, or refuses."""
    import zenoh

    from evedrop.live.network.control_file import no_run, read_controls
    from evedrop.live.network.operator import ask

    began = world().monotonic()
    if control.identity is not None:
        from evedrop.live.network.certificates import check_identity

        try:
            check_identity(control.identity, control.user)
        except BriefError as error:
            raise UsageError(f"{run / 'control.json'}: {error}") from error
    try:
        answer = ask(control, request, patience)
        # A recorder that has lost its connection is back in a moment; these requests may be carried out twice.
        while answer is None and request.repeatable and world().monotonic() - began < _AWAY_SECONDS:
            if control not in read_controls(run):  # which raises UsageError when the run is over
                break
            world().sleep(_AGAIN_SECONDS)
            answer = ask(control, request, patience)
    except zenoh.ZError as error:
        raise no_run(
            run, f"no router answers at {control.router}: it was killed, or it lost its router and is restarting it"
        ) from error
    if answer is None and world().monotonic() - began >= patience:
        raise UsageError(
            f"{subject}: no answer from the run in {run} in {patience:g} s; it may still do this: look at its logs, or end it"
        )
    if answer is None and control in read_controls(run):  # which raises UsageError when the run is over
        raise UsageError(
            f"{subject}: no answer from the run in {run}; its recorder or router is away, and may still do this: look at its "
            "status"
        )
    if answer is None:
        raise no_run(run, "it ended before it answered")
    if answer.refused:
        told = f"{subject}: {counted(len(answer.refused), 'mistake')}, nothing was changed"
        raise UsageError("\n".join([told, *(f"  {line}" for line in answer.refused)]))
    return answer


def _event(name: str, words: list[str]) -> dict[str, Any]:
    """The change as an event of a scenario, without its time."""
    from evedrop.scenario.events import EVENTS

    alone = {kind for kind, event in EVENTS.items() if event.by_operator and event.names_in == kind}
    if len(words) == 1 and words[0] in alone:
        return {words[0]: name}
    changes: dict[str, Any] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not all(key.split(".")):
            raise UsageError(f"link {name} {word}: expected KEY=VALUE, such as quality=0.2; or cut, or heal, alone")
        _put(changes, name, key, value)
    return {"link": name, "set": changes}


def _put(changes: dict[str, Any], name: str, dotted: str, text: str) -> None:
    """Put a value at a dotted key in `changes`; makes the tables in between."""
    from evedrop.scenario.loading import value_of

    *tables, last = dotted.split(".")
    inner = changes
    for table in tables:
        inner = inner.setdefault(table, {})
        if not isinstance(inner, dict):
            raise UsageError(f"link {name} {dotted}={text}: {table} already has a value; give it once")
    inner[last] = value_of(text)


COMMANDS = (link, partition, heal, pause, resume, step, status)
