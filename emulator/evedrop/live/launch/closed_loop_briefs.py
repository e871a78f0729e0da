"""A closed loop's parts of the briefs: the knowledge of each process about plant, inputs and disturbances.

Source: docs/protocol.md, the brief.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, final

from evedrop.live.protocol.brief_closed_loop import (
    AssignmentEntry,
    EstimatorLoopPart,
    MonitorEntry,
    PlantEntry,
    SensorLoopPart,
    SensorPlantEntry,
    Wiring,
    encoded,
)
from evedrop.live.protocol.brief_parts import ControllerPart
from evedrop.scenario.controlled import monitor_of
from evedrop.scenario.input_files import disturbances_of
from evedrop.scenario.tables import Scenario

if TYPE_CHECKING:
    from evedrop.scenario.stream_keys import StreamKeys


@final
class LoopBriefs:
    """A closed loop's parts of a scenario's briefs; each is None if the scenario lacks the plant or controller for it."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._disturbances = encoded(disturbances_of(scenario))
        table, driven = scenario.controller, scenario.driven
        self.wiring = None if table is None else Wiring(table.acts_on, scenario.legitimate.knows_input)
        """The controller's connections, for the router."""
        self.of_sensor = None if table is None else SensorLoopPart(table.period, table.acts_on)
        """For the sensor: the slots in which it waits for inputs, and whether it sends the state to the controller."""
        self.plant = None if driven is None else SensorPlantEntry.of(driven, disturbances=self._disturbances)
        """The plant with its disturbances, for the sensor."""
        plan = monitor_of(scenario)
        self.monitor = None if plan is None else MonitorEntry.of(plan)
        """Watermark, detector and attack, for the sensor."""

    def sensor_keys(self, keys: StreamKeys) -> dict[str, bytes]:
        """Stream → key, for the sensor's own streams, without those of the secret."""
        driven = self._scenario.driven
        measures = driven is not None and driven.output_matrix is not None
        monitors = {} if self.monitor is None else {"watermark": keys.watermark, "spoofing": keys.spoofing}
        return {"process": keys.process, **({"measurement": keys.measurement} if measures else {}), **monitors}

    @property
    def of_legitimate(self) -> EstimatorLoopPart | None:
        """For the legitimate estimator: when it sends its estimate, and the plant if it knows the inputs; None if neither."""
        wiring, loop, driven = self.wiring, self.of_sensor, self._scenario.driven
        if wiring is None or loop is None or (wiring.on_truth and not wiring.knows_input):
            return None
        plant = PlantEntry.of(driven) if wiring.knows_input and driven is not None else None
        return EstimatorLoopPart(loop.period, loop.acts_on, plant)

    @property
    def of_controller(self) -> ControllerPart | None:
        """The controller's part: its strategy, assignment, plant and disturbances."""
        scenario = self._scenario
        assignment, table, driven = scenario.assignment, scenario.controller, scenario.driven
        if assignment is None or table is None or driven is None:
            return None
        return ControllerPart(
            table.strategy, AssignmentEntry.of(assignment), table.acts_on, PlantEntry.of(driven), self._disturbances
        )
