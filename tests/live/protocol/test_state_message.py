"""The messages of a program that publishes states."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.errors import BriefError
from evedrop.live.protocol.brief import AnyBrief, ProgramPart, SensorPart, decoded, encoded, read_brief
from evedrop.live.protocol.state_message import MOST_BYTES, read_state
from evedrop.scenario.loading import checked
from tests.builders import part_of
from tests.live.protocol.made_briefs import made

NAMED = ProgramPart("robot/pose", ["x", "y"], [1.0, 0.0], "tcp/127.0.0.1:7447")
PLACED = ProgramPart("robot/pose", ["x", "y"], [0.0, 0.0], "tcp/127.0.0.1:7447", offsets=[4, 20])


@pytest.mark.parametrize("text", ['{"x": 1.5, "y": -2, "z": "?"}', "[1.5, -2]"])
def test_states_by_name_or_in_order(text: str) -> None:
    """As deviations from the reference."""
    assert np.array_equal(read_state(text.encode(), NAMED), [0.5, -2.0])


def test_states_at_known_bytes() -> None:
    """As in a message of ROS 2: 4 bytes, then numbers."""
    payload = struct.pack("<4sddd", b"\0\1\0\0", 0.25, 7.0, -3.0)
    assert np.array_equal(read_state(payload, PLACED), [0.25, -3.0])


@pytest.mark.parametrize(
    ("payload", "entry", "message"),
    [
        (b"", NAMED, "is empty; expected JSON such as"),
        (b"\xff\xfe", NAMED, "is .*; expected JSON"),
        (b"7", NAMED, "is 7; expected JSON such as"),
        (b"[" * 100_000, NAMED, "expected JSON"),
        (b'{"x": 1.0}', NAMED, "without y; expected x, y in it"),
        (b"[1.0]", NAMED, "expected 2 numbers, one for each of x, y"),
        (b"[1.0, 2.0, 3.0]", NAMED, "expected 2 numbers"),
        (b"[1.0, NaN]", NAMED, "has y = nan; expected a finite number"),
        (b"[-Infinity, 1]", NAMED, "has x = -inf"),
        (b"[1e101, 1]", NAMED, "has x = 1e[+]101"),
        (b'[true, "1"]', NAMED, "has x = True"),
        (json.dumps([10**400, 1]).encode(), NAMED, "has x = 1000"),
        (b"x" * (MOST_BYTES + 1), NAMED, "has 1048577 bytes; expected at most 1048576"),
        (b"y" * 200, NAMED, "is y+ …; expected JSON"),
        (bytes(27), PLACED, "has 27 bytes; expected 28 or more, for numbers at 4, 20"),
        (struct.pack("<4sddd", b"", 0.0, 0.0, float("nan")), PLACED, "has y = nan"),
    ],
)
def test_what_is_not_a_state_is_refused(payload: bytes, entry: ProgramPart, message: str) -> None:
    """With what it is, and what was expected."""
    with pytest.raises(ValueError, match=message):
        read_state(payload, entry)


ROWS = [[0.0, 1.0], [0.5, 1.0]]
EYE = [[1.0, 0.0], [0.0, 1.0]]


def sensor_of(source: str) -> AnyBrief:
    """The sensor's brief of a scenario with given states."""
    program = {"key": "robot/pose", "listen": "tcp/127.0.0.1:7447", "offsets": [4, 20]}
    process = {"A": EYE, "Q": EYE, "initial_covariance": EYE, "states": ["x", "y"], "source": source}
    tables = {
        "title": "Given",
        "slots": 2,
        "process": {**process, "state_values": ROWS, "zenoh": program},
        "encoding": {"scheme": "plain"},
        "legitimate": {"link": {"quality": 0.9}},
    }
    return made(checked(tables, "file"))["sensor"]


@pytest.mark.parametrize("source", ["file", "zenoh"])
def test_a_brief_has_what_its_sensor_needs(source: str, tmp_path: Path) -> None:
    """The states, or the program; not both. A brief says the same after it was written and read."""
    brief = sensor_of(source)
    part = part_of(brief, SensorPart)
    assert (part.states is None, part.program is None) == (source == "zenoh", source == "file")
    if part.states is not None:
        assert np.array_equal(decoded(part.states, 2), ROWS)
    result = read_brief(brief.write(tmp_path))
    assert result.text == brief.text
    result.expect_usable()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"states": encoded(np.zeros((2, 3)))}, "part.states cannot be used .*it has 3 states, not 2"),
        ({"states": encoded(np.full((2, 2), np.nan))}, "part.states cannot be used .*not finite"),
        ({"states": "?"}, "part.states cannot be used"),
        ({"program": replace(PLACED, offsets=[0])}, "part.program cannot be used .*it does not have 2 states"),
        ({"program": replace(NAMED, states=["x"])}, "part.program cannot be used .*it does not have 2 states"),
        ({"program": replace(NAMED, listen="tcp/127.0.0.1:7448")}, "part.program cannot be used .*connect or listen"),
        ({"program": replace(NAMED, connect=None)}, "part.program cannot be used .*connect or listen"),
    ],
)
def test_a_brief_with_other_states_is_refused(change: dict[str, Any], message: str) -> None:
    """It is refused before the process joins the run."""
    brief = sensor_of("file")
    with pytest.raises(BriefError, match=message):
        replace(brief, part=replace(part_of(brief, SensorPart), **change)).expect_usable()
