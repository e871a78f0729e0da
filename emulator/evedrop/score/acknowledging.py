"""Acknowledgements of a scenario: their channel, the attack on it, and the chart with which the sensor detects the attack.

Source: docs/mathematics.md, attacks on acknowledgements and detecting an attack.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.acknowledgements import AckChannelSpec, rates_of
from evedrop.model.detection import Chart, chart_for
from evedrop.model.metrics.standard_error import standard_error
from evedrop.model.receiver import Flags
from evedrop.names import LEGITIMATE
from evedrop.scenario.tables import Scenario
from evedrop.score.summary import DetectionSummary

_ALIKE = 1e-9  # relative difference of two rates that differ by rounding only
_ATTACK_LOOKED_FOR = "all"  # by the sensor of a scenario without an attack


def ack_channel_of(scenario: Scenario) -> AckChannelSpec | None:
    """The acknowledgement channel of a scenario; None if its scheme needs no acknowledgements."""
    table = scenario.acknowledgements
    if table is None:
        return None
    overheard = 1.0 if table.jammer is None else scenario.quality[table.jammer]
    spans, flip = scenario.timeline.jams, table.flip or 0.0
    return AckChannelSpec(table.link.quality, table.attack, table.jammer, spans, flip, overheard)


def chart_of(scenario: Scenario) -> Chart | None:
    """The sensor's chart for the scenario's attack, or for an attack that blocks everything if there is none.

    None without acknowledgements, or if no chart separates the two rates with as few false alarms as the scenario asks for.
    """
    table = scenario.acknowledgements
    if table is None:
        return None
    attack = _ATTACK_LOOKED_FOR if table.attack == "none" else table.attack
    quality = scenario.quality
    mu, mu_e = quality[LEGITIMATE], 1.0 if table.jammer is None else quality[table.jammer]
    flip = table.flip or 0.0
    normal, attacked = (rates_of(name, mu, mu_e, table.link.quality, flip).arrives for name in ("none", attack))
    if math.isclose(normal, attacked, rel_tol=_ALIKE):
        return None
    if normal == 1.0 and attacked < 1.0:
        return Chart(acknowledged=0, missing=1, threshold=1)
    try:
        return chart_for(normal, attacked, table.false_alarms)
    except ValueError:
        return None


@final
class Detection:
    """The slot in which the sensor first raised an alarm, for each trial."""

    def __init__(self, trials: int) -> None:
        self.first: NDArray[np.int64] = np.full(trials, -1, np.int64)
        """The slot, (R,); −1 in trials without an alarm."""

    @classmethod
    def merged(cls, parts: Sequence[Detection]) -> Detection:
        """The detections of several sets of trials, in order."""
        whole = cls(0)
        whole.first = np.concatenate([part.first for part in parts])
        return whole

    def add_alarms(self, first: int, alarms: Flags) -> None:
        """Add slots from `first` on, alarms (c, R)."""
        raised = alarms.any(axis=0)
        self.first = np.where(raised & (self.first < 0), first + np.argmax(alarms, axis=0), self.first)

    def summary(self, scenario: Scenario) -> DetectionSummary | None:
        """The sensor's detection for the summary; None if the sensor does not watch for attacks."""
        chart, spec = chart_of(scenario), ack_channel_of(scenario)
        if chart is None or spec is None:
            return None
        start = None if spec.attack == "none" else 0 if spec.spans is None else min(s for s, _ in spec.spans)
        raised = self.first >= 0
        true = raised & (self.first >= start) if start is not None else np.zeros_like(raised)
        delays = None if start is None else (self.first[true] - start + 1).astype(np.float64)
        return DetectionSummary(
            attack_from=start,
            alarms=int(np.count_nonzero(raised)),
            false_alarms=int(np.count_nonzero(raised & ~true)),
            mean_delay=float((self.first[true] - start + 1).mean()) if true.any() and start is not None else None,
            first_alarm=int(self.first[raised].min()) if raised.any() else None,
            standard_errors={"mean_delay": standard_error(delays)},
        )
