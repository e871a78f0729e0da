"""The recorder takes each slot of a process once, in order."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from evedrop.errors import Gap
from evedrop.live.protocol.brief import Brief, RecorderPart
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.telemetry import Journal, truth
from evedrop.live.recorder.conductor import Conductor
from evedrop.live.recorder.intake import Intake
from evedrop.live.recorder.steering import Steering
from evedrop.model.links.loss_model import REASONS
from evedrop.model.slot.link import COUNTED_BURSTS, Account
from evedrop.model.slot.records import LinkSlots, SensorSlots
from evedrop.names import ROUTER, SENSOR
from evedrop.score.run_tally import RunTally
from tests.live.protocol.made_briefs import briefed, made
from tests.live.protocol.readers import delays_of

KEY = "evedrop/r/telemetry/sensor"


def test_a_repeated_message_is_ignored_and_a_missing_one_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without patience, the second message after a gap ends the run."""
    monkeypatch.setattr("evedrop.live.network.process_session._LEAST_GAP", 0.0)
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


def test_a_link_counts_no_further_than_the_slots_that_are_joined() -> None:
    """The router is ahead of the sensor's telemetry: a run that ended now would have no slot, and no packet's delay."""
    scenario = briefed()
    intake = Intake(
        cast("Brief[RecorderPart]", made(scenario)["recorder"]),
        scenario,
        tally := RunTally.from_scenario(scenario, scenario.trials),
    )
    steering = Steering(scenario, object.__new__(Conductor), lambda _: None, lambda _: None)
    delivered, columns = (
        np.ones((2, scenario.trials), np.bool_),
        [np.zeros((2, n), np.uint32) for n in (len(REASONS), 1)],
    )
    links = {}
    for name in scenario.receivers:
        slots = LinkSlots(0, delivered, columns[0], columns[1][:, 0])
        delays = delays_of(slots, scenario.window(name))
        links[name] = Account(slots, np.zeros(COUNTED_BURSTS, np.uint32), delays)
    assert intake.take(ROUTER, Reader("evedrop/r/journal", Journal(0, 2, links).pack()), steering) is None
    assert intake.joiner.journaled == 2
    assert [int(entry.delays.sum()) for entry in tally.tallies.values()] == [0] * len(links)
