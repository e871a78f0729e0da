"""Messages between a launcher and a host's program: read as they were written, and anything else is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from evedrop.live.launch.other_hosts import (
    Greeting,
    HostMessage,
    LauncherHeartbeat,
    LogText,
    ProcessEnded,
    SendSignal,
    StartProcess,
    answer_in,
    greeting_in,
    line_of,
    order_in,
)
from evedrop.live.protocol.last_word import Cause, LastWord
from tests.live.network.bench import brief_of_eve

START = StartProcess(2**32, brief_of_eve(modules="/srv").entries, {"A": "ä\n"})
Message = HostMessage | Greeting
DEEP = b"[" * 100_000


@pytest.mark.parametrize(
    ("message", "read"),
    [
        (START, order_in),
        (SendSignal(7, 15), order_in),
        (LauncherHeartbeat(600.0), order_in),
        (LogText(7, "two\nlines\n"), answer_in),
        (ProcessEnded(7, -9), answer_in),
        (ProcessEnded(7, 3, LastWord(Cause.BROKEN_PROTOCOL, "ä", ("eve",))), answer_in),
        (Greeting("1.2.3"), greeting_in),
    ],
)
def test_a_message_is_a_line_and_read_as_it_was(message: Message, read: Callable[[bytes], Message]) -> None:
    """Whatever its texts contain."""
    line = line_of(message)
    assert line.count(b"\n") == 1
    assert line.endswith(b"\n")
    assert read(line) == message


def test_a_greeting_of_another_version_is_understood() -> None:
    """It may have more entries, or no kind: the launcher says which version is there."""
    assert greeting_in(b'{"evedrop": "0.0.9"}').evedrop == "0.0.9"
    assert greeting_in(b'{"kind": "hello", "evedrop": "9.0", "python": "4"}').evedrop == "9.0"


@pytest.mark.parametrize("read", [order_in, answer_in, greeting_in])
@pytest.mark.parametrize("line", [b"", b"Welcome", b"7", b"[1]", b"{}", b'"evedrop"', b'{"evedrop": 7}', DEEP, b"\xff"])
def test_other_lines_are_no_messages(line: bytes, read: Callable[[bytes], Message]) -> None:
    """Nor are those of a login shell."""
    with pytest.raises(ValueError, match="is not a message"):
        read(line)


@pytest.mark.parametrize(
    ("change", "mistake"),
    [
        ({"number": -1}, r"`int` >= 0 - at `\$.number`"),
        ({"number": None}, r"got `null` - at `\$.number`"),
        ({"brief": None}, r"got `null` - at `\$.brief`"),
        ({"environment": {"A": 1}}, r"got `int` - at `\$.environment"),
        ({"more": 1}, "unknown field `more`"),
        ({"kind": "stop"}, "is not a message .*'stop'"),
        ({"kind": "log"}, "is not a message"),
        ({"kind": None}, "is not a message"),
    ],
)
def test_a_malformed_order_names_the_entry(change: dict[str, Any], mistake: str) -> None:
    """An answer is not an order either."""
    order = {**json.loads(line_of(START)), **change}
    with pytest.raises(ValueError, match=mistake):
        order_in(json.dumps(order).encode())
