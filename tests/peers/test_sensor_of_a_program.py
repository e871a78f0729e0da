"""When a sensor takes the states of a program."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.protocol.brief import Flow
from evedrop.live.protocol.commands import EndRun, Start
from evedrop.model.process import Floats
from evedrop.peers.sensor import sense
from evedrop.scenario.loading import checked
from tests.builders import MARGINAL, process_table
from tests.clock import TestClock, clock_at_start, time_of_a_test
from tests.conftest import LIMIT, wait_until
from tests.live.in_memory import Stage


@pytest.fixture(autouse=True, scope="module")
def _time_of_the_tests() -> Iterator[None]:
    """The programs go by a clock of these tests."""
    with time_of_a_test():
        yield


class LateProgram:
    """A program whose state of slot 3 comes 7 seconds late."""

    def __init__(self, clock: TestClock) -> None:
        self.clock, self.waited = clock, 0.0
        self.taken: list[float] = []

    def __enter__(self) -> LateProgram:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to close."""

    def take(self, slots: range) -> Floats:
        """The state of a slot; notes when the sensor asked for it."""
        self.taken.append(self.clock.now)
        self.waited = 7.0 if slots.start == 3 else 0.0
        self.clock.now += self.waited
        return np.zeros((1, 2))


def test_slots_after_a_late_state_are_due_that_much_later() -> None:
    """They do not hurry to make up for it: each takes its state a pace after the slot before."""
    clock, stage = clock_at_start(), Stage()
    program = LateProgram(clock)
    asked: list[bool] = []

    def opened(_: Any, newest: bool, __: float) -> LateProgram:
        asked.append(newest)
        return program

    link = {"link": {"quality": 0.8}}
    source = {"source": "zenoh", "states": ["x", "v"], "zenoh": {"key": "pose", "connect": "tcp/127.0.0.1:1"}}
    tables = {
        "title": "Late",
        "slots": 8,
        "pace": 0.5,
        "process": {**process_table(MARGINAL), **source},
        "encoding": {"scheme": "plain"},
        "legitimate": link,
    }
    made = briefs_of(checked(tables, "file"), endpoints_at("tcp/127.0.0.1:1"), RecorderTask(Path("nowhere"), False))[
        "sensor"
    ]
    thread = threading.Thread(target=sense, args=(replace(made, flow=Flow(12, 4)), stage.session, opened), daemon=True)
    thread.start()
    stage.commands.put(Start().pack())
    wait_until(lambda: len(program.taken) == 8, "all slots have a state")
    stage.commands.put(EndRun().pack())
    thread.join(LIMIT)
    late = [0.0 if k <= 3 else 7.0 for k in range(8)]
    assert program.taken == pytest.approx([1000.0 + 0.5 * k + more for k, more in enumerate(late)])
    assert asked == [True]
