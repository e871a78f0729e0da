"""The status of a run in progress: read, merged over shards, and shown."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec import to_builtins
from msgspec.structs import replace

from evedrop.errors import MalformedMessage
from evedrop.live.network.operator import Answer, read_answer
from evedrop.live.protocol.codec import pack
from evedrop.live.protocol.requests import LinkStatus, RunStatus, WireLinkStatus, WireStatus, status_of_shards
from evedrop.scenario.progress_events import RunEvent

KEY = "evedrop/r1/control/recorder"
STATUS = RunStatus(
    40,
    80,
    1234.5,
    "held",
    {"sensor": True, "smart": False},
    {"smart": LinkStatus.of(40, 30), "naive": LinkStatus.of(0, 0)},
    [RunEvent(9, "cut smart", "operator")],
)


def test_a_status_is_read_as_it_was_sent() -> None:
    """With links and events as objects."""
    assert read_answer(KEY, Answer(status=STATUS).pack()).status == STATUS


def test_a_status_after_ten_thousands_of_events_is_read() -> None:
    """A scenario may have 10 000, each with a beginning and an end, and operators add more."""
    status = replace(STATUS, events=[*STATUS.events] * 30_000)
    assert read_answer(KEY, Answer(status=status).pack()).status == status


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("slot", -1, "Expected `int` >= 0 - at `$.status.slot`"),
        ("slots", "80", "Expected `int`, got `str` - at `$.status.slots`"),
        ("slots_per_second", float("nan"), "Expected `float` >= 0.0 - at `$.status.slots_per_second`"),
        ("state", 3, "Expected `str`, got `int` - at `$.status.state`"),
        ("processes", {"sensor": 1}, "Expected `bool`, got `int` - at `$.status.processes[...]`"),
        ("processes", {7: True}, "Expected `str`, got `int` - at `key` in `$.status.processes`"),
        ("links", {"smart": {"offered": 1}}, "Object missing required field `delivered` - at `$.status.links[...]`"),
        ("links", [], "Expected `object`, got `array` - at `$.status.links`"),
        ("events", [{"slot": 1, "event": "x", "by": None}], "Expected `str`, got `null` - at `$.status.events[0].by`"),
        ("colour", "red", "Object contains unknown field `colour` - at `$.status`"),
    ],
)
def test_a_malformed_status_is_refused(entry: str, value: Any, message: str) -> None:
    """With the place and what was expected there."""
    with pytest.raises(MalformedMessage) as raised:
        read_answer(KEY, pack({"status": {**to_builtins(STATUS), entry: value}}))
    assert message in str(raised.value)


def test_the_lines_say_where_the_run_is_and_what_is_missing() -> None:
    """A link without packets has no fraction."""
    assert list(STATUS.lines) == [
        "slot 40 of 80, 1,234 slots/s, held before slot 40",
        "processes: sensor; not on the network: smart",
        "link smart: 30 of 40 packets delivered, 0.7500",
        "link naive: 0 of 0 packets delivered, –",
        "event at slot 9: cut smart (by the operator)",
    ]
    running = replace(STATUS, state="running", processes={"sensor": True})
    assert list(running.lines)[:2] == ["slot 40 of 80, 1,234 slots/s, running", "processes: sensor"]


def test_the_status_of_shards_is_that_of_the_slowest_with_the_packets_of_all() -> None:
    """A process is there if it is there in every shard."""
    ahead = replace(STATUS, slot=60, state="running", processes={"sensor": True, "smart": True}, events=[])
    status = status_of_shards([ahead, STATUS])
    assert (status.slot, status.state, status.events) == (40, "held", STATUS.events)
    assert status.processes == {"sensor": True, "smart": False}
    assert status.links == {"smart": LinkStatus(80, 60, 0.75), "naive": LinkStatus(0, 0, None)}


WIRE = WireStatus(
    12.5,
    {"robot": ["tcp/127.0.0.1:7448"]},
    {"scan": WireLinkStatus(4, 3, False)},
    ["2.0 s: cut scan"],
    "complete",
    ["a program is in mode peer"],
)


def test_the_status_of_a_wire_is_read_as_it_was_sent() -> None:
    """And shown a line for each side, link, event, and way past the wire."""
    assert read_answer(KEY, Answer(wire=WIRE).pack()).wire == WIRE
    assert list(WIRE.lines) == [
        "12.5 s, journal complete",
        "side robot: tcp/127.0.0.1:7448",
        "link scan: 3 of 4 messages delivered, 0.7500",
        "event at 2.0 s: cut scan",
        "no verdict: a program is in mode peer",
    ]
    assert str(WireLinkStatus(0, 0, True)) == "0 of 0 messages delivered, –, cut"
    with pytest.raises(
        MalformedMessage, match=r"Expected `float` >= 0.0 - at `\$.wire.seconds`; expected the fields of Answer"
    ):
        read_answer(KEY, pack({"wire": {**to_builtins(WIRE), "seconds": -1}}))
