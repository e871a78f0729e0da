"""A talker and a listener across a lossy radio, as tests: `pytest docs/examples/wire`. The fixture comes with Evedrop."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from evedrop.wire.running import RunningWire

HERE = Path(__file__).parent


def start(program: str, *arguments: str) -> subprocess.Popen[str]:
    """A program of this folder."""
    return subprocess.Popen([sys.executable, str(HERE / program), *arguments], stdout=subprocess.PIPE, text=True)


def numbers(listener: subprocess.Popen[str]) -> list[int]:
    """What a listener heard until the talker ended."""
    printed, _ = listener.communicate(timeout=60)
    assert listener.returncode == 0
    return [int(line) for line in printed.split()]


def test_the_listener_hears_what_the_radio_lets_through(evedrop_wire: Callable[..., RunningWire]) -> None:
    """Neither more nor less, and in order; the journal knows what became of each message."""
    radio = evedrop_wire(HERE / "radio.toml")
    with (
        start("listener.py", radio.endpoint("base")) as listener,
        start("talker.py", radio.endpoint("robot"), "500", "0"),
    ):
        heard = numbers(listener)
    rows = [row for row in radio.rows().to_pylist() if row["key"] == "chatter/numbers"]
    assert len(rows) == 500
    assert heard == [row["n"] for row in rows if row["fate"] == "delivered"]
    radio.expect("chatter.delivery", above=0.7, below=0.95)


def test_numbers_come_again_after_a_partition(evedrop_wire: Callable[..., RunningWire]) -> None:
    """Nothing comes while the radio is out of range."""
    radio = evedrop_wire(HERE / "radio.toml", seed=8)
    with (
        start("listener.py", radio.endpoint("base")) as listener,
        start("talker.py", radio.endpoint("robot"), "300", "0.005"),
    ):
        until(lambda: radio.status().links["chatter"].heard > 20)
        radio.partition("robot", "base")
        began = radio.status().links["chatter"].heard
        until(lambda: radio.status().links["chatter"].heard > began + 50)
        radio.heal("robot", "base")
        heard = numbers(listener)
    assert max(after - before for before, after in pairwise(heard)) > 50
    assert radio.summary()["links"]["chatter"]["lost_by"]["cut"] >= 50
    radio.expect("chatter.gap_seconds", above=0.25)


def until(condition: Callable[[], bool], seconds: float = 60) -> None:
    """Wait for a condition."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)
