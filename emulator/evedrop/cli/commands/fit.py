"""`evedrop links fit` and `evedrop process fit`: models of recorded links and processes."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evedrop.cli.command import command, flag, option, together
from evedrop.cli.options import as_json
from evedrop.errors import UsageError
from evedrop.system.output import print_json

if TYPE_CHECKING:
    from evedrop.scenario.recordings.message_recording import MessageRecording


_PROCESS_OPTIONS = together(
    option("--states", "X,Y", "the columns that are states; default all but time"),
    option("--reference", "X,Y", "the levels from which states are deviations; default 0"),
)


@command(
    (option("file", "FILE", type=Path), _PROCESS_OPTIONS, as_json),
    group="process",
    section="study",
    example="process fit pose.csv",
    page="programs",
)
def fit(options: argparse.Namespace) -> int:
    """Find the process that explains recorded states."""
    from evedrop.scenario.recordings.process_fit import fit_process

    names = None if options.states is None else [name.strip() for name in options.states.split(",")]
    fitted = fit_process(options.file, names, _numbers(options.reference))
    if options.json:
        print_json(fitted.as_dict())
    else:
        print("\n".join([*(f"# {line}" for line in fitted.remarks), "", fitted.toml]))
    return 0


def _numbers(text: str | None) -> list[float] | None:
    try:
        return None if text is None else [float(number) for number in text.split(",")]
    except ValueError:
        raise UsageError(f"--reference {text}: expected numbers such as 55,50") from None


_LINK_OPTIONS = together(
    option("--column", "C", "the column of outcomes, in which 1 means delivered; default received, or the only one"),
    option("--lost", "C", "in place of --column: the column in which 1 means lost"),
    option("--delay-column", "C", "the column of delays in slots; default the column named delay, if there is one"),
    option("--topic", "T", "the topic of an MCAP recording; default the only one with numbers"),
    option("--period", "S", "seconds between two messages of a sender that does not number them", type=float),
    option("--link", "NAME", "the link of a wire; default the only one with messages"),
    option("--key", "K", "only messages of a wire with keys that this key expression takes"),
    flag("--gaps", "fit what was lost before the wire: the numbers that are missing in its journal"),
    option("--outage", "S", "do not count silences longer than this many seconds as losses", type=float),
    option("--slot", "S", "seconds of a scenario's slot; default the median time between messages", type=float),
    option("--save", "FILE", "write the outcomes of messages to a CSV file, for the loss model trace", type=Path),
)


@command(
    (option("trace", "RECORDING", type=Path), _LINK_OPTIONS, as_json),
    name="fit",
    group="links",
    section="study",
    example="links fit walk.csv",
    page="links",
)
def fit_link(options: argparse.Namespace) -> int:
    """Find the loss model and delays of a recorded link: a table, an MCAP recording or the folder of a wire."""
    from evedrop.scenario.recordings.mcap_recording import is_mcap

    if is_mcap(options.trace):
        told, lines = _mcap(options)
    elif options.trace.is_dir():
        told, lines = _journal(options)
    else:
        told, lines = _table(options)
    if options.json:
        print_json(told)
    else:
        print("\n".join(lines))
    return 0


def _table(options: argparse.Namespace) -> tuple[dict[str, Any], Sequence[str]]:
    """The fit of a table of outcomes."""
    from evedrop.scenario.recordings.link_fit import fit, lines

    _refuse_others(options, "a table of outcomes", {"a table of outcomes"})
    fitted = fit(options.trace, options.column, options.delay_column, options.lost)
    return fitted.as_dict(), lines(fitted)


def _mcap(options: argparse.Namespace) -> tuple[dict[str, Any], Sequence[str]]:
    """The fit of a topic of an MCAP recording."""
    from evedrop.scenario.recordings.mcap_recording import mcap_recording

    _refuse_others(options, "an MCAP recording", {"an MCAP recording", "a recording of messages"})
    return _messages(mcap_recording(options.trace, options.topic, options.period, options.outage), options)


def _journal(options: argparse.Namespace) -> tuple[dict[str, Any], Sequence[str]]:
    """The fit of a link of a wire."""
    from evedrop.wire.recorded_link import journal_recording

    _refuse_others(options, "a folder", {"the folder of a wire", "a recording of messages"})
    if options.outage is not None and not options.gaps:
        raise UsageError("--outage: expected --gaps with it; losses by the wire itself are never counted")
    recording = journal_recording(options.trace, options.link, options.key, gaps=options.gaps, longest=options.outage)
    return _messages(recording, options)


def _messages(recording: MessageRecording, options: argparse.Namespace) -> tuple[dict[str, Any], Sequence[str]]:
    """The fit of messages that were recorded."""
    from evedrop.scenario.recordings.message_fit import fit_messages, message_lines
    from evedrop.scenario.recordings.message_recording import save_outcomes

    if options.save is not None:
        save_outcomes(recording, options.save)
    fitted = fit_messages(recording, options.slot)
    return fitted.as_dict(), message_lines(fitted)


_ONLY = {
    "a table of outcomes": ("column", "lost", "delay_column"),
    "an MCAP recording": ("topic", "period"),
    "the folder of a wire": ("link", "key", "gaps"),
    "a recording of messages": ("outage", "slot", "save"),
}
"""Recordings → the options that are only for them."""


def _refuse_others(options: argparse.Namespace, subject: str, kinds: Collection[str]) -> None:
    """Raise UsageError for options that are only for recordings of other kinds, and for times that are not positive."""
    others = [(kind, name) for kind, names in _ONLY.items() if kind not in kinds for name in names]
    for kind, name in others:
        if getattr(options, name) not in {None, False}:
            raise UsageError(
                f"--{name.replace('_', '-')} is for {kind}, and {options.trace} is {subject}; leave it out"
            )
    for name in ("period", "outage", "slot"):
        value = getattr(options, name)
        if value is not None and not 0.0 < value < float("inf"):
            raise UsageError(f"--{name} {value:g}: expected seconds, more than 0")


COMMANDS = (fit, fit_link)
