"""A closed loop's parts of the briefs: what each process knows of plant, inputs and disturbances.

Source: docs/protocol.md, the brief.
"""

from __future__ import annotations

from base64 import b64encode
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, final

from evedrop.live.network.access import Wiring
from evedrop.scenario import Scenario
from evedrop.scenario.disturbances import disturbances_of

if TYPE_CHECKING:
    from evedrop.scenario.stream_keys import StreamKeys


@final
class LoopBriefs:
    """A closed loop's parts of a scenario's briefs; None if there is no plant, or no controller."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._plant = None if scenario.driven is None else scenario.driven.spec
        self._disturbances = b64encode(disturbances_of(scenario).astype("<f8").tobytes()).decode()
        table = scenario.controller
        self._wiring = None if table is None else Wiring(table.acts_on, scenario.legitimate.knows_input)
        self._period = 1 if table is None else table.period

    @property
    def wiring(self) -> dict[str, Any] | None:
        """The controller's connections, for the router."""
        return None if self._wiring is None else asdict(self._wiring)

    @property
    def plant(self) -> dict[str, Any] | None:
        """The plant with its disturbances, for the sensor."""
        return None if self._plant is None else {**self._plant, "disturbances": self._disturbances}

    def sensor_keys(self, keys: StreamKeys) -> dict[str, bytes]:
        """The keys of the sensor's own streams, without the secret's."""
        driven = self._scenario.driven
        measures = driven is not None and driven.output_matrix is not None
        return {"process": keys.process, **({"measurement": keys.measurement} if measures else {})}

    @property
    def of_sensor(self) -> dict[str, Any] | None:
        """For the sensor: the slots in which it waits for inputs, and whether it sends the state to the controller."""
        return None if self._wiring is None else {"period": self._period, "acts_on": self._wiring.acts_on}

    @property
    def of_legitimate(self) -> dict[str, Any] | None:
        """For the legitimate estimator: when it sends its estimate, and the plant if it knows the inputs; None if neither."""
        wiring = self._wiring
        if wiring is None or (wiring.on_truth and not wiring.knows_input):
            return None
        return {
            "period": self._period,
            "acts_on": wiring.acts_on,
            "plant": self._plant if wiring.knows_input else None,
        }

    @property
    def of_controller(self) -> dict[str, Any] | None:
        """The controller's part: its strategy, assignment, plant and disturbances."""
        assignment, table = self._scenario.assignment, self._scenario.controller
        if assignment is None or table is None:
            return None
        return {
            "strategy": table.strategy,
            "assignment": assignment.spec,
            "acts_on": table.acts_on,
            "plant": self._plant,
            "disturbances": self._disturbances,
        }
