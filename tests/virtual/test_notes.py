"""What notes say of keys and messages."""

from __future__ import annotations

import pytest

from evedrop.live.protocol.codec import enclosed, pack
from evedrop.live.protocol.commands import EndRun, Hold
from evedrop.live.protocol.packets import barrier, resend
from evedrop.virtual.notes import key_within, said_in

KEY = "evedrop/r0123/control/sensor"


@pytest.mark.parametrize(
    ("payload", "said"),
    [
        (EndRun().pack(), "end"),
        (Hold().pack(), "hold"),
        (barrier(28), "hold 28"),
        (resend(1, 0, 7), "again 7"),
        (pack({"k": 4, "c": 1, "z": b"\0"}), "4"),
        (pack({"k": 0, "c": 28, "links": {0: 1}}), "0-27"),
        (pack({"over": True}), "over"),
        (pack({"x": 1}), ""),
        (pack({"k": "word"}), ""),
        (b"", ""),
        (b"\xc1", ""),
        (b"\x07", ""),
        (b"\x81\x90\x01", ""),
    ],
)
def test_a_message_is_known_by_its_command_or_slots(payload: bytes, said: str) -> None:
    """Whatever it is, even broken."""
    assert said_in(enclosed(KEY, payload)) == said


def test_a_message_without_an_envelope_says_nothing() -> None:
    """It is none of a run."""
    assert said_in(b"") == said_in(b"\xc1\xc1") == ""


def test_keys_are_without_their_run() -> None:
    """Which has another name in each run."""
    assert key_within(KEY) == "control/sensor"
    assert key_within("robot/pose") == "robot/pose"
