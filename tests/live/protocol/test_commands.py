"""The recorder's commands: each is read as it was packed, and a malformed one is refused with what was expected."""

from __future__ import annotations

import re
from typing import Any

import pytest

from evedrop.errors import MalformedMessage
from evedrop.live.protocol.codec import Reader, pack
from evedrop.live.protocol.commands import (
    Abandon,
    Again,
    Bounds,
    ControlCommand,
    EndRun,
    Go,
    Hold,
    LinkChange,
    ReportStatus,
    Start,
    read_command,
)
from evedrop.model.slot.link import Change

BOUNDS = Bounds(100, ("eve", "legitimate"))
CHANGES = (Change(4, cut=True), Change(100, {"loss": {"model": "bernoulli", "quality": 0.5}}))


def read(process: str, payload: bytes) -> ControlCommand:
    """A command as this process reads it."""
    return read_command(Reader(f"evedrop/r/control/{process}", payload), BOUNDS)


@pytest.mark.parametrize(
    ("process", "command"),
    [
        ("sensor", Start()),
        ("eve", EndRun()),
        ("eve", ReportStatus()),
        ("sensor", Hold()),
        ("relay", Abandon("interrupted")),
        ("sensor", Go(7, (), 9)),
        ("sensor", Go(7, ("eve",))),
        ("router", Go(7)),
        ("router", LinkChange("eve", CHANGES)),
        ("eve", Again(1, 7)),
        ("router", Again(1, 7, {"eve": CHANGES, "legitimate": ()})),
    ],
)
def test_a_command_is_read_as_it_was_packed(process: str, command: ControlCommand) -> None:
    """By the process to which it is sent."""
    assert read(process, command.pack()) == command


@pytest.mark.parametrize(
    ("process", "fields", "message"),
    [
        ("eve", {}, "do = None; expected a string do"),
        ("eve", {"do": 3}, "do = 3; expected a string do"),
        ("eve", {"do": "dance"}, "do = 'dance'; expected one of start, end, where, hold, abandon, go, change, again"),
        ("eve", {"do": "abandon"}, "Object missing required field `why`; expected the fields of Abandon"),
        ("router", {"do": "go"}, "Object missing required field `k`"),
        ("sensor", {"do": "go", "k": 1}, "absent = None; expected a list absent of strings"),
        ("sensor", {"do": "go", "k": 1, "absent": ["x"]}, "absent = ('x',); expected some of eve, legitimate"),
        (
            "sensor",
            {"do": "go", "k": 1, "absent": [], "until": True},
            "Expected `int | null`, got `bool` - at `$.until`",
        ),
        ("sensor", {"do": "go", "k": 1, "absent": [], "until": 1}, "until = 1; expected a slot after 1"),
        ("eve", {"do": "again", "n": 0, "k": 1}, "n = 0, k = 1; expected n from 1 on, and k up to 100"),
        ("eve", {"do": "again", "n": 1, "k": 101}, "n = 1, k = 101; expected n from 1 on, and k up to 100"),
        ("router", {"do": "change", "link": "x", "changes": []}, "the link 'x'; expected one of eve, legitimate"),
        ("router", {"do": "change", "link": "eve"}, "Object missing required field `changes`"),
        ("router", {"do": "change", "link": "eve", "changes": [{"at": 101}]}, "at = 101; expected an integer at from"),
        (
            "router",
            {"do": "change", "link": "eve", "changes": [{"at": 1, "cut": 1}]},
            "Expected `bool | null`, got `int` - at `$.changes[0].cut`",
        ),
        ("eve", {"do": "again", "k": 1}, "Object missing required field `n`"),
        ("router", {"do": "again", "n": 1, "k": 1}, "links = None; expected a map links"),
        (
            "router",
            {"do": "again", "n": 1, "k": 1, "links": {"x": []}},
            "the link 'x'; expected one of eve, legitimate",
        ),
    ],
)
def test_a_malformed_command_is_refused(process: str, fields: dict[str, Any], message: str) -> None:
    """The error names the key, what was found and what was expected."""
    with pytest.raises(
        MalformedMessage, match=re.escape(f"malformed message on evedrop/r/control/{process}: {message}")
    ):
        read(process, pack(fields))
