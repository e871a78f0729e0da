"""The recorder takes each slot of a process once, in order."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from evedrop.errors import Gap
from evedrop.live.protocol.brief import Brief, RecorderPart
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.telemetry import truth
from evedrop.live.recorder.conductor import Conductor
from evedrop.live.recorder.intake import Intake
from evedrop.live.recorder.steering import Steering
from evedrop.model.slot.records import SensorSlots
from evedrop.names import SENSOR
from evedrop.score.run_tally import RunTally
from tests.live.protocol.made_briefs import briefed, made

KEY = "evedrop/r/telemetry/sensor"


def test_a_repeated_message_is_ignored_and_a_missing_one_waited_for() -> None:
    """Without patience, the second message after a gap ends the run."""
    scenario = briefed()
    brief = cast("Brief[RecorderPart]", made(scenario)["recorder"])
    brief = replace(brief, flow=replace(brief.flow, longest_outage=0.0))
    intake = Intake(brief, scenario, RunTally.from_scenario(scenario, scenario.trials))
    steering = Steering(scenario, object.__new__(Conductor), lambda _: None, lambda _: None)

    def take(first: int, count: int) -> int:
        columns = np.ones((count, 2, scenario.trials)), np.zeros((count, scenario.trials), np.bool_)
        intake.take(SENSOR, Reader(KEY, truth(SensorSlots(first, *columns))), steering)
        return intake.joiner.sent

    assert [take(0, 3), take(0, 3), take(1, 1), take(3, 2), take(4, 1)] == [3, 3, 3, 5, 5]
    assert take(7, 1) == 5
    with pytest.raises(Gap):
        take(8, 1)
