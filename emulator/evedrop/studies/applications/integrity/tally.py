"""Metrics of integrity: false alarms, detections and their delay, and the cost of the watermark, each with its theory.

Source: docs/results.md, integrity; docs/mathematics.md, integrity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.digest import Digests, InputLog, RunDigest
from evedrop.model.integrity.loop import WatermarkedLoop
from evedrop.model.integrity.monitor import MonitoredSlots
from evedrop.model.integrity.policies import WatermarkPolicy
from evedrop.model.integrity.theory import WatermarkTheory
from evedrop.model.metrics.standard_error import z_of
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, product
from evedrop.scenario.application import ApplicationTally


@dataclass(frozen=True)
class IntegrityCase:
    """What the metrics are compared with."""

    plant: Plant
    loop: WatermarkedLoop
    policy: WatermarkPolicy
    theory: WatermarkTheory
    attack_from: int | None
    """The first slot of the attack; None if nobody attacks."""
    slots: int
    """Slots of the run."""

    @property
    def before(self) -> int:
        """The number of slots before the attack."""
        return self.slots if self.attack_from is None else self.attack_from

    @property
    def clips(self) -> bool:
        """Whether the plant limits its inputs."""
        return bool(np.isfinite(self.plant.input_lower).any() or np.isfinite(self.plant.input_upper).any())


@final
class IntegrityTally(ApplicationTally):
    """A tally over a set of trials, whose slots come in order."""

    def __init__(self, case: IntegrityCase, trials: int) -> None:
        self._case = case
        self._slots: NDArray[np.int64] = np.zeros(trials, np.int64)
        self._first: NDArray[np.int64] = np.full(trials, -1, np.int64)
        """The slot of the first alarm; −1 without one."""
        self._marked: Floats = np.zeros(trials)
        """Slots with a watermark."""
        self._marked_before: Floats = np.zeros(trials)
        """Those of them before the attack."""
        self._cost: Floats = np.zeros(trials)
        """What the watermark has cost before the attack."""
        self._log: InputLog | None = InputLog(1 + case.plant.inputs, trials, case.slots)
        self._digests: dict[int, Digests] = {}

    def add(self, x: Floats, u: Floats, estimates: Mapping[str, Floats]) -> None:
        """Do nothing: all metrics come from the monitor."""

    def add_monitored(self, x: Floats, u: Floats, monitored: MonitoredSlots) -> None:
        """Add the next slots, one by one, so that the sums have the same bits however the slots are divided."""
        case = self._case
        alarms = case.policy.alarms(monitored.statistic)
        for row, (state, decided, e, alarm) in enumerate(zip(x, u, monitored.watermark, alarms, strict=True)):
            k = int(self._slots[0])
            self._slots = self._slots + 1
            self._first = np.where(alarm & (self._first < 0), k, self._first)
            marked = (e != 0.0).any(axis=0)
            self._marked = self._marked + marked
            if k < case.before:
                self._marked_before = self._marked_before + marked
                self._cost = self._cost + self._advantage(state, decided, e)
            if self._log is not None:
                stated = np.concatenate([monitored.statistic[row][None], e])
                ended = self._log.add(k, stated, alarm)
                self._digests.update([] if ended is None else [ended])
        if self._slots[0] == case.slots:
            self._log = None  # tallies are pickled, and the log has room for many slots

    def _advantage(self, x: Floats, u: Floats, e: Floats) -> Floats:
        """2 (u + L x)ᵀ M e + eᵀ M e, (R,): what e adds to the regulator's cost of this slot and all that follow."""
        plant, loop = self._case.plant, self._case.loop
        entered = plant.entering(u, e)
        weighed = product(loop.weight, entered)
        from_best = 2.0 * (plant.limited(u) + product(loop.L, x)) + entered
        total: Floats = np.zeros(e.shape[1])
        for first, second in zip(from_best, weighed, strict=True):
            total = total + first * second
        return total

    @classmethod
    def merged(cls, parts: Sequence[IntegrityTally]) -> IntegrityTally:
        """The tally of several sets of trials, in order."""
        whole = copy(parts[0])
        for name in ("_slots", "_first", "_marked", "_marked_before", "_cost"):
            setattr(whole, name, np.concatenate([getattr(part, name) for part in parts]))
        shared = [block for block in parts[0]._digests if all(block in part._digests for part in parts)]
        whole._digests = {block: np.concatenate([part._digests[block] for part in parts]) for block in shared}
        return whole

    @property
    def _alike(self) -> bool:
        """Whether all trials came equally far, and further than slot 0."""
        return bool(self._slots[0]) and bool((self._slots == self._slots[0]).all())

    @property
    def of_trials(self) -> Mapping[tuple[str, ...], Floats]:
        """The values of every metric that is a mean, by trial; none where trials were cut short at different slots."""
        if not self._alike:
            return {}
        case, slots = self._case, int(self._slots[0])
        before = min(slots, case.before)
        false = (self._first >= 0) & (self._first < case.before)
        values: dict[tuple[str, ...], Floats] = {
            ("false_alarm_fraction",): false.astype(np.float64),
            ("watermark_fraction",): self._marked / slots,
        }
        if before:
            values["watermark_cost",] = self._cost / before
        if case.attack_from is not None and slots > case.attack_from:
            sound = self._first[~false]
            detected = sound >= 0
            values["detected_fraction",] = detected.astype(np.float64)
            values["mean_delay",] = (sound[detected] - case.attack_from + 1).astype(np.float64)
        return values

    def summary(self) -> dict[str, Any]:
        """The summary's entry."""
        case, of_trials = self._case, self.of_trials
        means = {name: float(values.mean()) if values.size else None for (name,), values in of_trials.items()}
        before = min(int(self._slots[0]), case.before)
        cost, z = None, None
        if "watermark_cost" in means and not case.clips:
            expected = case.theory.cost * self._marked_before / before
            cost = float(expected.mean())
            # The number of slots with a watermark is random under some policies, so the two are compared trial by trial.
            z = z_of(self._cost / before - expected, 0.0)
        divergence = case.theory.divergence if case.attack_from is not None else None
        return {
            "attack_from": case.attack_from,
            "threshold": case.policy.threshold,
            "false_alarm_fraction": means.get("false_alarm_fraction"),
            "false_alarm_bound": case.policy.false_alarms(before),
            "detected_fraction": means.get("detected_fraction"),
            "mean_delay": means.get("mean_delay"),
            "divergence": divergence,
            "expected_delay": None if divergence is None else case.policy.expected_delay(divergence),
            "watermark_fraction": means.get("watermark_fraction"),
            "watermark_cost": means.get("watermark_cost"),
            "expected_watermark_cost": cost,
            "watermark_cost_z": z,
            "digest": self._digest(),
        }

    def _digest(self) -> str | None:
        """The digest of statistic, alarms and watermark of all trials; None if the run was cut short."""
        if not self._alike or self._slots[0] < self._case.slots:
            return None
        whole = RunDigest()
        whole.add(self._digests)
        return whole.hexadecimal
