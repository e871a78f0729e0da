"""The closed loop in memory: the work of a live run's plant, controller and input-aware estimator.

Source: docs/mathematics.md, closed loop.
"""

from __future__ import annotations

import time
from typing import NamedTuple, final

import numpy as np

from evedrop.model.controllers import CONTROLLERS
from evedrop.model.digest import Digests, InputLog
from evedrop.model.input_aware import InputAwareEstimator
from evedrop.model.plant import Drive
from evedrop.model.process import Floats, Trajectory
from evedrop.model.receiver import Receiver
from evedrop.names import LEGITIMATE
from evedrop.scenario import Scenario
from evedrop.scenario.disturbances import disturbances_of
from evedrop.scenario.stream_keys import StreamKeys
from evedrop.score.closed_loop_tally import SolveTimes
from evedrop.score.filtering import local_filter_of
from evedrop.score.slots import InputSlots
from evedrop.streams import Batch


def informed(scenario: Scenario, estimator: Receiver) -> Receiver:
    """The legitimate estimator of a scenario, input-aware if the scenario says so."""
    if scenario.driven is None or not scenario.legitimate.knows_input:
        return estimator
    return InputAwareEstimator(estimator, scenario.driven, scenario.window(LEGITIMATE))


class Made(NamedTuple):
    """The states of a slot, (n, R) each."""

    true: Floats
    x: Floats
    """The transmitted state: the true one, or the estimate of the sensor's filter."""
    predicted: Floats
    """The prediction of x from the slot before."""


class Source(NamedTuple):
    """The keys and the initial state from which the states of a batch are drawn."""

    keys: StreamKeys
    initial: Floats | None
    """As of `Trajectory`."""
    batch: Batch


@final
class Loop:
    """Computes the states of a batch slot by slot, with plant and controller, or of the process alone.

    digests: filled with the controller's digests, block by its first slot → (R, 32); times: filled with decision times.
    """

    def __init__(
        self, scenario: Scenario, source: Source, estimator: Receiver, digests: dict[int, Digests], times: SolveTimes
    ) -> None:
        self._estimator, self._digests, self._times = estimator, digests, times
        keys, initial, batch = source
        process, driven = scenario.process.process, scenario.driven
        noise = None if driven is None else driven.noise
        self._trajectory = Trajectory(process, keys.process, batch, initial, noise)
        self._local = local_filter_of(scenario, keys.measurement, batch)
        self._trials = batch.trials
        plant, self._table, assignment = scenario.driven, scenario.controller, scenario.assignment
        self._disturbances = disturbances_of(scenario)
        self._drive = None if plant is None else Drive(plant, self._disturbances)
        self._rows: InputSlots
        if self._table is not None and plant is not None and assignment is not None:
            self._controller = CONTROLLERS[self._table.strategy](assignment, batch.trials)
            self._log = InputLog(plant.inputs, batch.trials, batch.slots)
            self._u: Floats = np.zeros((plant.inputs, batch.trials))

    def begin(self, count: int) -> None:
        """Begin a chunk of `count` slots."""
        if self._table is not None:
            u = np.empty((count, *self._u.shape))
            self._rows = InputSlots(u, np.empty((count, self._trials), np.bool_))

    @property
    def inputs(self) -> InputSlots | None:
        """The inputs of the current chunk; None without a controller."""
        return None if self._table is None else self._rows

    @property
    def filters(self) -> bool:
        """Whether the sensor filters its measurements."""
        return self._local is not None

    def advance(self, k: int) -> Made:
        """Compute the states of slot k; call it for slots in order."""
        if self._drive is None:
            true = self._trajectory.advance()
            return Made(true, true, self._trajectory.predicted)
        pushed = self._drive.pushed(k)
        true = self._trajectory.advance(pushed)
        if self._local is None:
            return Made(true, true, self._trajectory.predicted)
        return Made(true, self._local.take(k, true, pushed), self._local.predicted)

    def act(self, k: int, row: int, x: Floats, x_hat: Floats) -> None:
        """Decide the inputs of slot k of the current chunk from the state or its estimate, (n, R) each."""
        if self._table is None or self._drive is None:
            return
        if k % self._table.period == 0:
            known = x if self._table.acts_on == "truth" else x_hat
            began = time.perf_counter()
            self._u = self._controller.decide(k, known, self._disturbances[k])
            self._times.add([time.perf_counter() - began])
            self._drive.hold(self._u)
        if isinstance(self._estimator, InputAwareEstimator):
            self._estimator.learn(k, self._u)
        self._rows.u[row], self._rows.failed[row] = self._u, self._controller.failed
        digests = self._log.add(k, self._u, self._controller.failed)
        if digests is not None:
            self._digests.update([digests])
