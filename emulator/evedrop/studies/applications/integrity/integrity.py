"""The integrity of a closed loop, as an application of its plant: what a scenario may ask for, and what the view shows.

Source: docs/integrity.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import final

import numpy as np

from evedrop.model.controllers.lqr import Lqr
from evedrop.model.integrity import POLICIES, SENSOR_ATTACKS
from evedrop.model.integrity.attacks import Replay
from evedrop.model.integrity.loop import WatermarkedLoop
from evedrop.model.integrity.monitor import MonitoredSlots, MonitorPlan
from evedrop.model.integrity.policies import WatermarkPolicy
from evedrop.model.integrity.theory import WatermarkTheory, loop_of
from evedrop.model.process import Floats
from evedrop.scenario.application import (
    Application,
    ApplicationTally,
    ControlledPlant,
    Panel,
    PanelCurve,
    PanelFeed,
    Summary,
)
from evedrop.scenario.table import Table
from evedrop.show.view.palette import PLANT, TRUTH_CURVE
from evedrop.studies.applications.integrity.table import IntegrityTable
from evedrop.studies.applications.integrity.tally import IntegrityCase, IntegrityTally

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

    def take_monitored(self, first: int, monitored: MonitoredSlots) -> Mapping[str, Floats]:
        """Add the next slots; the alarm is a point in the slot that raises it."""
        statistic, e = monitored.statistic[:, 0], monitored.watermark[:, :, 0]
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
        alarms = f"false alarms in {cls.text(summary, ('false_alarm_fraction',), '.3g')} of the trials"
        lines = [alarms if bound is None else f"{alarms}, by theory at most {bound:.3g}"]
        if summary["detected_fraction"] is not None:
            sentence = (
                f"the attack is detected in {cls.text(summary, ('detected_fraction',), '.3g')} of the other trials"
            )
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
            lines.append(f"{alarms}; it is on in {cls.text(summary, ('watermark_fraction',), '.3g')} of all slots")
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
        for one in (covariance, np.zeros_like(covariance)):
            _theory(watermarked, table, one)
    except ValueError as error:
        yield (
            f"integrity: the detector's distribution under attack cannot be computed, because {error}; expected another "
            "attack, or controller weights with which (1 − K C)(A − B L) is stable"
        )


def _own(table: Table) -> IntegrityTable:
    assert isinstance(table, IntegrityTable)  # noqa: S101 - the hook gives each application its own table
    return table
