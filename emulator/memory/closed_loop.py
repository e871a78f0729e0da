"""The closed loop in memory: what the sensor's plant, the controller and who is told the inputs do of a live run.

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
    """The legitimate estimator of a scenario, told the inputs if it is to be."""
    if scenario.driven is None or not scenario.legitimate.knows_input:
        return estimator
    return InputAwareEstimator(estimator, scenario.driven, scenario.window(LEGITIMATE))


class Made(NamedTuple):
    """A slot's states, (n, R) each."""

    true: Floats
    x: Floats
    """What is transmitted as the state: the true one, or what the sensor's filter makes of it."""
    predicted: Floats
    """A times that of the slot before."""


class Source(NamedTuple):
    """What the states of a batch are drawn from."""

    keys: StreamKeys
    initial: Floats | None
    """As of `Trajectory`."""
    batch: Batch


@final
class Loop:
    """The states of a batch and what moves them, slot by slot: plant and controller, or their process alone.

    digests: is given the controller's, block by its first slot → (R, 32); times: what decisions take.
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
        """Take so many slots."""
        if self._table is not None:
            u = np.empty((count, *self._u.shape))
            self._rows = InputSlots(u, np.empty((count, self._trials), np.bool_))

    @property
    def inputs(self) -> InputSlots | None:
        """Those of the slots that were begun with; None without a controller."""
        return None if self._table is None else self._rows

    @property
    def filters(self) -> bool:
        """Whether the sensor filters what it measures."""
        return self._local is not None

    def advance(self, k: int) -> Made:
        """The states of slot k; slots come in order."""
        if self._drive is None:
            true = self._trajectory.advance()
            return Made(true, true, self._trajectory.predicted)
        pushed = self._drive.pushed(k)
        true = self._trajectory.advance(pushed)
        if self._local is None:
            return Made(true, true, self._trajectory.predicted)
        return Made(true, self._local.take(k, true, pushed), self._local.predicted)

    def act(self, k: int, row: int, x: Floats, x_hat: Floats) -> None:
        """Decide the inputs of slot k, which is one of those begun with, from the state and its estimate, (n, R)."""
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
