"""The envelope of a message: what is in it, and which messages are dropped."""

from __future__ import annotations

import msgpack
import pytest

from evedrop.live.protocol.codec import Dropped, enclosed, head_of, named_in, payload_of

KEY, OTHER = "evedrop/r1/downlink/eve", "evedrop/r1/control/eve"


def test_a_message_is_read_on_the_key_that_it_names_and_on_no_other() -> None:
    """Its payload is to the byte what was put in."""
    message = enclosed(KEY, b"\0payload")
    assert payload_of(KEY, message) == b"\0payload"
    assert payload_of(OTHER, message) is None
    assert named_in(message) == KEY


@pytest.mark.parametrize("message", [b"", b"\xc1", msgpack.packb(7), head_of(KEY)[:-1], msgpack.packb("x" * 1000)])
def test_bytes_that_name_no_key(message: bytes) -> None:
    """An empty message, one that is not msgpack, a number, and a key that is cut off."""
    assert named_in(message) is None


def test_dropped_messages_are_counted_and_reported_ever_more_rarely(capsys: pytest.CaptureFixture[str]) -> None:
    """The first, the tenth, the hundredth; only a message that names another key shows that the connection confuses keys."""
    confused: list[int] = []
    dropped = Dropped("eve", lambda: confused.append(dropped.count))
    assert dropped.contents(KEY, head_of(KEY), enclosed(KEY, b"mine")) == b"mine"
    assert dropped.count == 0
    for _ in range(100):
        assert dropped.contents(KEY, head_of(KEY), enclosed(OTHER, b"not mine")) is None
    assert dropped.contents(KEY, head_of(KEY), b"\xc1") is None
    assert dropped.count == 101
    assert confused == list(range(1, 101))
    lines = capsys.readouterr().err.splitlines()
    assert [line.rpartition("(number ")[2].partition(")")[0] for line in lines] == ["1", "10", "100"]
    assert all(f"eve: dropped a message that came on {KEY} and names {OTHER}" in line for line in lines)


def test_a_message_that_names_no_key_is_reported_as_such(capsys: pytest.CaptureFixture[str]) -> None:
    """And does not renew the connection."""
    dropped = Dropped("eve", lambda: pytest.fail("renewed"))
    assert dropped.contents(KEY, head_of(KEY), b"\xc1") is None
    assert f"came on {KEY} and names no key (number 1)" in capsys.readouterr().err
