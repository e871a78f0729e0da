"""`evedrop links fit`: the loss model and delays of a recorded link."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from typing import Any

from evedrop.cli.options import argument, as_json
from evedrop.command import Command
from evedrop.errors import UsageError


def fit_link(options: argparse.Namespace) -> int:
    """Fit loss and delay models to a recorded link."""
    from evedrop.recordings.mcap_recording import is_mcap

    if is_mcap(options.trace):
        told, lines = _messages(options, "an MCAP recording", ("topic", "period", "outage", "slot"))
    else:
        told, lines = _table(options)
    print(json.dumps(told, ensure_ascii=False) if options.json else "\n".join(lines))
    return 0


def _table(options: argparse.Namespace) -> tuple[dict[str, Any], Sequence[str]]:
    """The fit of a table of outcomes."""
    from evedrop.fitting.fit import fit, lines

    _refuse_others(options, "a table of outcomes", ("column", "delay_column"))
    found = fit(options.trace, options.column, options.delay_column)
    return found.as_dict(), lines(found)


def _messages(options: argparse.Namespace, what: str, names: Sequence[str]) -> tuple[dict[str, Any], Sequence[str]]:
    """The fit of messages that were recorded."""
    from evedrop.fitting.message_fit import fit_messages, message_lines
    from evedrop.recordings.mcap_recording import mcap_recording

    _refuse_others(options, what, names)
    for name in ("period", "outage", "slot"):
        value = getattr(options, name)
        if value is not None and not 0.0 < value < float("inf"):
            raise UsageError(f"--{name} {value:g}: expected seconds, more than 0")
    recording = mcap_recording(options.trace, options.topic, options.period, options.outage)
    found = fit_messages(recording, options.slot)
    return found.as_dict(), message_lines(found)


_ONLY = {
    "column": "a table of outcomes",
    "delay_column": "a table of outcomes",
    "topic": "an MCAP recording",
    "period": "an MCAP recording",
    "outage": "a recording of messages",
    "slot": "a recording of messages",
}
"""Option → the recordings that it is for."""


def _refuse_others(options: argparse.Namespace, what: str, names: Sequence[str]) -> None:
    """Raise UsageError for options that this kind of recording does not have."""
    for name, whose in _ONLY.items():
        if name not in names and getattr(options, name) not in {None, False}:
            raise UsageError(f"--{name.replace('_', '-')} is for {whose}, and {options.trace} is {what}; leave it out")


def _fits(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--column", metavar="C", help="the column of outcomes, if the file has several columns")
    parser.add_argument(
        "--delay-column",
        metavar="C",
        help="the column of delays in slots; default the column named delay, if there is one",
    )
    parser.add_argument(
        "--topic", metavar="T", help="the topic of an MCAP recording; default the only one with numbers"
    )
    parser.add_argument(
        "--period", type=float, metavar="S", help="seconds between two messages, of a sender that does not number them"
    )
    parser.add_argument(
        "--outage", type=float, metavar="S", help="a silence of more than so many seconds is not counted as losses"
    )
    parser.add_argument(
        "--slot", type=float, metavar="S", help="seconds of a scenario's slot; default the median time between messages"
    )


COMMANDS = (
    Command(
        "fit",
        fit_link,
        "the loss model and delays of a recorded link: a table or an MCAP recording",
        (argument("trace", "RECORDING"), _fits, as_json),
        group="links",
    ),
)
