"""The integrity of a closed loop, as an application of its plant: watermark, attack on the measurements, and detector.

`[integrity]` has the policy with its thresholds. Metrics are false alarms, detections and their delay, and the cost of the
watermark, each with its theory.

Source: docs/integrity.md; docs/scenario.md, integrity; docs/metrics.md, integrity; docs/mathematics/attacks.md, integrity.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Annotated, Any, final

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, ConfigDict, Field

from evedrop.model.checks import is_number
from evedrop.model.controllers import Lqr
from evedrop.model.digest import Digests, InputLog, RunDigest
from evedrop.model.integrity import POLICIES, SENSOR_ATTACKS
from evedrop.model.integrity.attacks import Replay
from evedrop.model.integrity.loop import WatermarkedLoop
from evedrop.model.integrity.monitor import MonitorPlan
from evedrop.model.integrity.policies import WatermarkPolicy
from evedrop.model.integrity.theory import WatermarkTheory, loop_of
from evedrop.model.kernels.elementary import semidefinite_factor
from evedrop.model.metrics.standard_error import z_of
from evedrop.model.metrics.text import percent_estimate
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, product
from evedrop.model.slot.records import SensorSlots
from evedrop.scenario.application import (
    Application,
    ApplicationTally,
    ControlledPlant,
    Panel,
    PanelCurve,
    PanelFeed,
    Summary,
)
from evedrop.scenario.table import Matrix, Mistake, Table, one_of, parameter_mistakes, refuse
from evedrop.scenario.words import as_toml, listed
from evedrop.show.view.palette import PLANT, TRUTH_CURVE
from evedrop.system.hints import near

MODEL = "model"


def _covariance(rows: list[list[float]]) -> list[list[float]]:
    refuse(("", sentence) for sentence in _covariance_mistakes(rows))
    return rows


def _covariance_mistakes(rows: list[list[float]]) -> Iterator[str]:
    m = len(rows)
    if m == 0 or any(len(row) != m for row in rows):
        yield "is not a square matrix; expected the covariance of the watermark, such as [[0.3]]"
        return
    covariance = np.array(rows, np.float64)
    if not np.isfinite(covariance).all() or not np.array_equal(covariance, covariance.T):
        yield "is not symmetric and finite; expected the covariance of the watermark, such as [[0.3]]"
        return
    try:
        semidefinite_factor(covariance)
    except ValueError:
        least = float(np.linalg.eigvalsh(covariance)[0])
        yield f"has the eigenvalue {least:.3g}, below 0; expected a covariance, such as [[0.3]]"


def _attack(entries: dict[str, Any]) -> dict[str, Any]:
    refuse(_attack_mistakes(entries))
    return entries


def _attack_mistakes(entries: Mapping[str, Any]) -> Iterator[Mistake]:
    name = entries.get(MODEL)
    attack = SENSOR_ATTACKS.get(str(name))
    if attack is None:
        problem = "is missing" if name is None else f"is {as_toml(name)}"
        yield MODEL, f"{problem}; expected {listed(sorted(SENSOR_ATTACKS))}{near(str(name), SENSOR_ATTACKS)}"
        return
    given = {entry: value for entry, value in entries.items() if entry != MODEL}
    yield from parameter_mistakes("attack", str(name), attack, given)
    for entry, value in given.items():
        example = attack.parameters.get(entry)
        if isinstance(example, list) and not _is_matrix(value):
            yield entry, f"is {as_toml(value)}; expected a matrix, such as {as_toml(example)}"
        elif isinstance(example, int) and not (type(value) is int and 1 <= value <= 1_000_000):
            yield entry, f"is {as_toml(value)}; expected a whole number from 1 to 1000000"


def _is_matrix(value: Any) -> bool:
    rows = isinstance(value, list) and value and all(isinstance(row, list) for row in value)
    return bool(rows) and all(is_number(number) for row in value for number in row)


class IntegrityTable(Table):
    """`[integrity]`: a watermark, an attack on the sensor's measurements, and the detector that finds it."""

    model_config = ConfigDict(extra="allow")

    policy: Annotated[str, Field(strict=True, examples=["always"]), AfterValidator(one_of(POLICIES))]
    """When there is a watermark, and which statistic raises the alarm. Its parameters are further entries."""
    watermark: Annotated[Annotated[Matrix, AfterValidator(_covariance)] | None, Field(examples=[[[0.3]]])] = None
    """The covariance of the noise that is added to the inputs, m × m; no watermark by default."""
    attack: Annotated[
        Annotated[dict[str, Any], AfterValidator(_attack)] | None, Field(examples=[{MODEL: "replay", "recorded": 100}])
    ] = None
    """The attack on the measurements, with a `model` and its entries. It lasts for the whole run, or only during events
    `spoof`."""

    def mistakes(self) -> list[Mistake]:
        """Mistakes in the policy's parameters."""
        policy, given = POLICIES[self.policy], self.model_extra or {}
        mistakes = [*parameter_mistakes("policy", self.policy, policy, given)]
        mistakes += [
            (name, f"is {as_toml(value)}; expected a number, such as {name} = {as_toml(policy.parameters[name])}")
            for name, value in given.items()
            if name in policy.parameters and not is_number(value)
        ]
        return mistakes or policy.mistakes(self.parameters)

    @property
    def parameters(self) -> dict[str, float]:
        """The policy's parameters."""
        return {name: float(value) for name, value in (self.model_extra or {}).items()}

    @property
    def described_attack(self) -> tuple[str, Mapping[str, Any]] | None:
        """The attack's name and entries; None if nobody attacks."""
        if self.attack is None:
            return None
        return self.attack[MODEL], {name: value for name, value in self.attack.items() if name != MODEL}

    def covariance(self, inputs: int) -> Floats:
        """Σ_e, (m, m), for m inputs; 0 without a watermark."""
        return np.zeros((inputs, inputs)) if self.watermark is None else np.array(self.watermark, np.float64)


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

    def add_monitored(self, x: Floats, u: Floats, sensor: SensorSlots) -> None:
        """Add the next slots, one by one, so that the sums have the same bits however the slots are divided."""
        case, statistic, watermark = self._case, sensor.statistic, sensor.watermark
        assert statistic is not None and watermark is not None  # noqa: S101, PT018 - there is a detector
        alarms = case.policy.alarms(statistic)
        for row, (state, decided, e, alarm) in enumerate(zip(x, u, watermark, alarms, strict=True)):
            k = int(self._slots[0])
            self._slots = self._slots + 1
            self._first = np.where(alarm & (self._first < 0), k, self._first)
            marked = (e != 0.0).any(axis=0)
            self._marked = self._marked + marked
            if k < case.before:
                self._marked_before = self._marked_before + marked
                self._cost = self._cost + self._advantage(state, decided, e)
            if self._log is not None:
                stated = np.concatenate([statistic[row][None], e])
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


_EVIDENCE, _WATERMARK = "evidence", "watermark"


@final
class IntegrityFeed(PanelFeed):
    """The detector's statistic with its threshold and alarm, and the watermark, in one trial."""

    def __init__(self, policy: WatermarkPolicy) -> None:
        self._policy = policy
        self._alarmed = False

    def take(self, first: int, u: Floats, estimates: Mapping[str, Floats]) -> Mapping[str, Floats]:
        """Do nothing: all metrics come from the monitor."""
        del first, u, estimates
        return {}

    def take_monitored(self, first: int, sensor: SensorSlots) -> Mapping[str, Floats]:
        """Add the next slots; the alarm is a point in the slot that raises it."""
        assert sensor.statistic is not None and sensor.watermark is not None  # noqa: S101, PT018 - there is a detector
        statistic, e = sensor.statistic[:, 0], sensor.watermark[:, :, 0]
        slots = np.arange(first, first + len(statistic), dtype=np.float64)
        raised = np.flatnonzero(self._policy.alarms(statistic))[: 0 if self._alarmed else 1]
        self._alarmed = self._alarmed or bool(len(raised))
        curves = {
            f"{_EVIDENCE}/statistic": np.stack([slots, statistic]),
            f"{_EVIDENCE}/threshold": np.stack([slots, np.full(len(slots), self._policy.threshold)]),
            f"{_EVIDENCE}/alarm": np.stack([slots[raised], statistic[raised]]),
        }
        return curves | {f"{_WATERMARK}/e{i}": np.stack([slots, values]) for i, values in enumerate(e.T)}


@final
class Integrity(Application):
    """A watermark, an attack on the measurements, and the detector that tests the sensor's filter."""

    table = IntegrityTable
    names = {}  # noqa: RUF012 - declared so by the base class
    metrics = (
        "false_alarm_fraction",
        "false_alarm_bound",
        "detected_fraction",
        "mean_delay",
        "divergence",
        "expected_delay",
        "watermark_fraction",
        "watermark_cost",
        "expected_watermark_cost",
        "watermark_cost_z",
    )
    served_metrics = ("false_alarm_fraction", "detected_fraction")
    has_monitor = True

    @classmethod
    def objections(cls, loop: ControlledPlant, table: Table) -> list[str]:
        """A loop whose distribution is not known, a watermark that does not fit it, and an attack that is impossible in it."""
        return list(_objections(loop, _own(table)))

    @classmethod
    def monitor(cls, loop: ControlledPlant, table: Table) -> MonitorPlan:
        """The plan for the process of the sensor."""
        own = _own(table)
        covariance = own.covariance(loop.plant.inputs)
        policy = own.policy, own.parameters
        return MonitorPlan.of(loop_of(loop.assignment), covariance, policy, own.described_attack, _spans(loop, own))

    @classmethod
    def tally(cls, loop: ControlledPlant, table: Table, trials: int) -> ApplicationTally:
        """A tally over no slots yet."""
        own, watermarked = _own(table), loop_of(loop.assignment)
        policy, covariance = POLICIES[own.policy].of(own.parameters), own.covariance(loop.plant.inputs)
        spans = _spans(loop, own)
        theory = _theory(watermarked, own, covariance)
        return IntegrityTally(
            IntegrityCase(loop.plant, watermarked, policy, theory, spans[0][0] if spans else None, loop.slots), trials
        )

    @classmethod
    def lines(cls, summary: Summary) -> list[str]:
        """False alarms with their bound, detections with their delay, and the cost of the watermark with its theory."""
        if summary["false_alarm_fraction"] is None:
            return []
        bound = summary["false_alarm_bound"]
        alarms = f"false alarms in {cls.percent(summary, 'false_alarm_fraction')} of the trials"
        lines = [alarms if bound is None else f"{alarms}, by theory at most {percent_estimate(bound, None, '.3g')}"]
        if summary["detected_fraction"] is not None:
            sentence = f"the attack is detected in {cls.percent(summary, 'detected_fraction')} of the other trials"
            if summary["mean_delay"] is not None:
                sentence += f", after {cls.text(summary, ('mean_delay',), '.3g')} slots"
            if summary["expected_delay"] is not None:
                sentence += f"; h/D is {summary['expected_delay']:.3g}"
            lines.append(sentence)
        if summary["watermark_cost"] is not None and summary["watermark_fraction"]:
            alarms = f"the watermark costs {cls.text(summary, ('watermark_cost',), '.3g')} a slot before the attack"
            expected, z = summary["expected_watermark_cost"], summary["watermark_cost_z"]
            if expected is not None:
                alarms += f", by theory {expected:.3g}" + ("" if z is None else f" (z {z:.1f})")
            lines.append(f"{alarms}; it is on in {cls.percent(summary, 'watermark_fraction')} of all slots")
        return lines

    @classmethod
    def panels(cls, loop: ControlledPlant, table: Table) -> tuple[Panel, ...]:
        """The statistic with its threshold and alarm; and the watermark, if there is one."""
        evidence = Panel(
            _EVIDENCE,
            "Evidence of an attack: statistic, threshold, alarm",
            (
                PanelCurve("statistic", PLANT[0]),
                PanelCurve("threshold", TRUTH_CURVE, width=1.0),
                PanelCurve("alarm", PLANT[2], "points", 7.0),
            ),
        )
        if _own(table).watermark is None:
            return (evidence,)
        curves = [PanelCurve(f"e{i}", PLANT[i % len(PLANT)], "steps", 1.0) for i in range(loop.plant.inputs)]
        return evidence, Panel(_WATERMARK, "Watermark: what is added to the inputs", tuple(curves))

    @classmethod
    def feed(cls, loop: ControlledPlant, table: Table) -> PanelFeed:
        """What fills its panels."""
        del loop
        own = _own(table)
        return IntegrityFeed(POLICIES[own.policy].of(own.parameters))


def _theory(watermarked: WatermarkedLoop, table: IntegrityTable, covariance: Floats) -> WatermarkTheory:
    """The closed forms against the attack; against a replay if the table has no attack."""
    described = table.described_attack
    if described is None:
        return WatermarkTheory.of(watermarked, Replay(1), covariance)
    rests = POLICIES[table.policy].rests
    attack = SENSOR_ATTACKS[described[0]].of(
        described[1], watermarked, np.zeros_like(covariance) if rests else covariance
    )
    return WatermarkTheory.of(watermarked, attack, covariance)


def _spans(loop: ControlledPlant, table: IntegrityTable) -> Sequence[tuple[int, int]]:
    """The slots [from, to) of the attack: those of events, or all."""
    if table.attack is None:
        return ()
    return loop.spoofed or ((0, loop.slots),)


def _objections(loop: ControlledPlant, table: IntegrityTable) -> Iterator[str]:
    m, assignment = loop.plant.inputs, loop.assignment
    if loop.plant.output_matrix is None:
        yield (
            "integrity: needs measurements, which its detector tests; expected output_matrix and measurement_noise in [plant]"
        )
        return
    if loop.strategy is not Lqr:
        yield 'controller.strategy: has no fixed gain, which the theory of integrity needs; expected strategy = "lqr"'
        return
    if loop.on_truth:
        yield 'controller.acts_on: is "truth", so false measurements would mislead no controller; expected acts_on = "estimate"'
    if loop.period != 1:
        yield f"controller.period: is {loop.period}, but the theory of integrity assumes a decision in every slot; expected 1"
    if assignment.rate_weights.any():
        yield "controller.rate_weights: are given, but the theory of integrity assumes none; remove the line"
    if table.watermark is not None and len(table.watermark) != m:
        yield f"integrity.watermark: is {len(table.watermark)} × {len(table.watermark)}; expected {m} × {m}, as there are inputs"
        return
    described = table.described_attack
    if described is None and loop.spoofed:
        yield 'integrity.attack: is missing, but an event begins it; expected attack = { model = "replay", recorded = 100 }'
        return
    watermarked = loop_of(assignment)
    if described is not None:
        name, given = described
        objections = SENSOR_ATTACKS[name].objections(given, watermarked, _spans(loop, table)[0][0])
        yield from (f"integrity.attack.{entry}: {objection}" for entry, objection in objections)
        if objections:
            return
    yield from _theory_mistakes(watermarked, table, m)


def _theory_mistakes(watermarked: WatermarkedLoop, table: IntegrityTable, inputs: int) -> Iterator[str]:
    covariance = table.covariance(inputs)
    try:
        for assumed in (covariance, np.zeros_like(covariance)):
            _theory(watermarked, table, assumed)
    except ValueError as error:
        yield (
            f"integrity: the detector's distribution under attack cannot be computed, because {error}; expected another "
            "attack, or controller weights with which (1 − K C)(A − B L) is stable"
        )


def _own(table: Table) -> IntegrityTable:
    assert isinstance(table, IntegrityTable)  # noqa: S101 - the hook gives each application its own table
    return table
