"""Totals of a closed loop: failed decisions, clipped inputs, and the errors of the two possible estimators.

Source: docs/metrics.md, controller.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from evedrop.model.metrics.standard_error import standard_error
from evedrop.model.plant import Offset, Plant
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Codes
from evedrop.model.slot.records import SensorSlots
from evedrop.names import LEGITIMATE
from evedrop.scenario.closed_loop import controlled_plant
from evedrop.scenario.tables import Scenario
from evedrop.score.guarded_application import GuardedApplication
from evedrop.score.summary import ControllerSummary, PeerSummary, StandardErrors

ESTIMATORS = ("ignoring_input", "knowing_input")


@final
@dataclass
class SolveTimes:
    """The time that decisions take; one decision covers all trials that are simulated together."""

    decisions: int = 0
    seconds: float = 0.0
    longest: float = 0.0

    def add_seconds(self, seconds: Iterable[float]) -> None:
        """Add some decisions."""
        for duration in seconds:
            self.decisions += 1
            self.seconds += duration
            self.longest = max(self.longest, duration)

    def merge(self, other: SolveTimes) -> None:
        """Add another process's decisions."""
        self.decisions += other.decisions
        self.seconds += other.seconds
        self.longest = max(self.longest, other.longest)

    @property
    def mean(self) -> float | None:
        """Mean seconds per decision; None if there were none."""
        return self.seconds / self.decisions if self.decisions else None


@final
class LoopTally:
    """A closed loop's totals over a set of trials, whose slots come in order."""

    def __init__(self, process: Process, plant: Plant, trials: int, knows_input: bool, comparable: bool) -> None:
        """comparable: whether the error of the other estimator, which is not in the loop, can be computed."""
        self._plant = plant
        self._sign = -1.0 if knows_input else 1.0
        self._offset = Offset(process, plant, trials) if comparable else None
        self.trial_slots = 0
        """Slots times trials so far."""
        self.failed = 0
        """Trial-slots whose inputs were held because a decision failed."""
        self.clipped = 0
        """Trial-slots in which the plant clipped an input."""
        self.other_error = 0.0
        """Sum of squared errors of the estimator that is not in the loop."""
        self.of_trials: Floats = np.zeros((4, trials))
        """The slots of each trial, and its fractions of the three totals above, in their order."""
        self.applications: dict[str, GuardedApplication] = {}
        """Application → its totals, for those that the scenario uses."""

    @classmethod
    def from_scenario(cls, scenario: Scenario, trials: int) -> LoopTally | None:
        """The totals of some trials of a scenario; None without a controller."""
        loop = controlled_plant(scenario)
        if loop is None:
            return None
        stays = scenario.window(LEGITIMATE) == 0 and not scenario.timeline.outages[LEGITIMATE]
        # An estimator that never had the reference of a packet also corrects its estimate by it: `Offset` does not know how.
        comparable = stays and not scenario.forges_acknowledgements
        tally = cls(loop.process, loop.plant, trials, scenario.legitimate.knows_input, comparable)
        tally.applications = {
            name: GuardedApplication.begun(name, loop, table, trials) for name, table in scenario.applications.items()
        }
        return tally

    def add_slots(self, sensor: SensorSlots, estimates: Mapping[str, Floats], action: Codes) -> None:
        """Add the next slots.

        sensor: with the inputs; estimates: receiver → x̂, (c, n, R); action: the legitimate estimator's, (c, R).
        """
        u, applied, failed = sensor.u, sensor.applied, sensor.failed
        assert u is not None and applied is not None and failed is not None  # noqa: S101, PT018 - there is a controller
        for application in self.applications.values():
            application.add(sensor, u, applied, estimates)
        self.trial_slots += failed.size
        self.failed += int(np.count_nonzero(failed))
        clipped = self._plant.clips(applied)
        self.clipped += int(np.count_nonzero(clipped))
        self.of_trials[0] += len(clipped)
        self.of_trials[1:3] += np.count_nonzero(failed, axis=0), np.count_nonzero(clipped, axis=0)
        if self._offset is None:
            return
        error = sensor.x - estimates[LEGITIMATE] - self._sign * self._offset.next(action, u)
        error *= error
        self.other_error += float(error.sum(axis=(1, 2)).sum())
        self.of_trials[3] += error.sum(axis=(0, 1))

    @classmethod
    def merged(cls, parts: Sequence[LoopTally | None]) -> LoopTally | None:
        """The totals of several sets of trials, in order."""
        tallies = [part for part in parts if part is not None]
        if not tallies:
            return None
        whole = copy(tallies[0])
        for part in tallies[1:]:
            whole.trial_slots += part.trial_slots
            whole.failed += part.failed
            whole.clipped += part.clipped
            whole.other_error += part.other_error
        whole.of_trials = np.concatenate([part.of_trials for part in tallies], axis=1)
        whole.applications = {
            name: GuardedApplication.merged([part.applications[name] for part in tallies])
            for name in tallies[0].applications
        }
        return whole

    def entries(self, trials: int) -> dict[str, dict[str, Any]]:
        """Application → its entry of the summary of a run of so many trials, which may be more than these; none if it failed.

        Its means are of these, but a digest would be one of all: there is none where a shard has no metrics.
        """
        answers = {name: application.entry() for name, application in self.applications.items()}
        entries = {name: dict(answer) for name, answer in answers.items() if answer is not None}
        for entry in entries.values():
            if "digest" in entry and self.of_trials.shape[1] < trials:
                entry["digest"] = None
        return entries

    def summary(
        self, scenario: Scenario, legitimate: PeerSummary, times: SolveTimes, digest: str | None
    ) -> ControllerSummary:
        """The summary's entry on the controller; legitimate: its entry on the legitimate estimator."""
        assert scenario.controller is not None  # noqa: S101 - else there is no tally
        knows = scenario.legitimate.knows_input
        errors = [
            legitimate.metric("mean_squared_error"),
            self.other_error / self.trial_slots if self._offset and self.trial_slots else None,
        ]
        return ControllerSummary(
            strategy=scenario.controller.strategy,
            period=scenario.controller.period,
            acts_on=scenario.controller.acts_on,
            knows_input=knows,
            decisions=times.decisions,
            mean_solve_seconds=times.mean,
            longest_solve_seconds=times.longest,
            failed_fraction=self.failed / self.trial_slots if self.trial_slots else None,
            clipped_fraction=self.clipped / self.trial_slots if self.trial_slots else None,
            mean_squared_errors=dict(zip(ESTIMATORS, errors[::-1] if knows else errors, strict=True)),
            mean_trace_covariance=legitimate.metric("mean_trace_covariance"),
            digest=digest,
            standard_errors=self._standard_errors(legitimate, knows),
        )

    def _standard_errors(self, legitimate: PeerSummary, knows: bool) -> StandardErrors:
        """The standard errors of the metrics; legitimate: the summary's entry on the legitimate estimator."""
        slots, *totals = self.of_trials
        alike = bool(slots.all()) and bool((slots == slots[0]).all())
        failed, clipped, other = (standard_error(total / slots) if alike else None for total in totals)
        meaningful = self._offset is not None and not legitimate.infinite_variance
        errors = [legitimate.standard_errors.get("mean_squared_error"), other if meaningful else None]
        return {
            "failed_fraction": failed,
            "clipped_fraction": clipped,
            "mean_squared_errors": dict(zip(ESTIMATORS, errors[::-1] if knows else errors, strict=True)),
            "mean_trace_covariance": legitimate.standard_errors.get("mean_trace_covariance"),
        }
