"""The links of a run: their losses and delays compared with those of the models, and acknowledgements with attacks on them.

Of acknowledgements: their channel, the attack on it, and the chart with which the sensor detects the attack.

Source: docs/metrics.md, links; docs/mathematics/links.md, links;
docs/mathematics/attacks.md, attacks on acknowledgements and detecting an attack.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.acknowledgements import AckChannelSpec, rates_of
from evedrop.model.delays import delay_of
from evedrop.model.detection import Chart, chart_for
from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.links import loss_of
from evedrop.model.links.chain import Chain
from evedrop.model.links.counts import Thinned
from evedrop.model.links.loss_model import LossModel
from evedrop.model.metrics.built_in import LinkAccount
from evedrop.model.metrics.standard_error import standard_error
from evedrop.model.process import parts_of
from evedrop.model.receiver import Flags
from evedrop.model.slot.link import LinkSchedule
from evedrop.model.slot.link_distribution import stretches
from evedrop.names import LEGITIMATE
from evedrop.scenario.tables import Scenario
from evedrop.score.summary import DetectionSummary, LinkSummary
from evedrop.score.sums import Tally

RATE_CONFIDENCE = 0.999
QUANTILES = (0.5, 0.9, 0.99)


def link_summary_of(scenario: Scenario, receiver: str, tally: Tally) -> LinkSummary:
    """A link's account, and how its losses and delays compare with those of its models."""
    schedule = scenario.schedule(receiver)
    pieces = _pieces(schedule, tally.done)
    slots = sum(len(part.slots) for _, parts in pieces for part in parts)
    met = slots * tally.trials
    account = LinkAccount.of(tally)
    # In a run cut short, late packets that were still to come are lost, although the router does not report them.
    lost = {**tally.lost, "underway": account.lost - sum(tally.lost.values()) + tally.lost.get("underway", 0)}
    summary = _with_delays(
        LinkSummary(
            **asdict(account),
            lost_by={reason: count for reason, count in sorted(lost.items()) if count},
            bursts=np.trim_zeros(tally.bursts, "b").tolist(),
            mean_burst=_mean_burst(tally),
            expected_mean_burst=None if tally.unsent or tally.lost.get("overflow") else _expected_burst(pieces, tally),
        ),
        schedule,
        tally,
    )
    if tally.offered != tally.done * tally.trials:
        return summary  # trials were cut short at different slots, in which different models may have applied
    unmet = tally.unsent + tally.lost.get("overflow", 0)
    if unmet:
        # A scheme's packets may depend on the past, and a full queue refuses some of them in a regular order: for a loss model
        # with a memory, or one that changes, the rest is not a fair sample. Nor is it known how many belong to slots of a cut.
        if len(pieces) != 1 or slots < tally.done or not _independent(pieces[0][0]):
            return summary
        met -= unmet
    if met <= 0:
        return summary
    rate = 1.0 - tally.lost.get("lost", 0) / met
    expected = (
        sum_in_order(
            float(loss.quality_at(some).sum())
            for loss, parts in pieces
            for part in parts
            for some in parts_of(part.slots)
        )
        / slots
    )
    variance = sum_in_order(loss.count_variance(parts) for loss, parts in pieces) / slots**2 / tally.trials
    variance *= slots * tally.trials / met
    low, high = interval(rate, expected, variance)
    within = low - _ROUNDING <= expected <= high + _ROUNDING
    return replace(summary, rate=rate, expected_rate=expected, interval=(low, high), within_interval=bool(within))


def _independent(loss: LossModel) -> bool:
    return loss.chain is not None and loss.chain.independent


_ROUNDING = 1e-12


def interval(rate: float, expected: float, variance: float) -> tuple[float, float]:
    """Clopper and Pearson's interval for a probability at 99.9 % confidence.

    Counts as many independent packets as give the same variance: `variance` is that of a rate whose mean is `expected`. A
    rate without variance is its own interval.
    """
    from scipy.special import betaincinv  # noqa: PLC0415 - 0.2 s that only a summary needs

    if variance <= 0.0:
        return rate, rate
    count = expected * (1.0 - expected) / variance
    received, tail = rate * count, (1.0 - RATE_CONFIDENCE) / 2.0
    low = float(betaincinv(received, count - received + 1.0, tail)) if received > 0.0 else 0.0
    high = float(betaincinv(received + 1.0, count - received, 1.0 - tail)) if received < count else 1.0
    return low, high


def _pieces(schedule: LinkSchedule, done: int) -> list[tuple[LossModel, list[Thinned]]]:
    """The loss models of the slots below `done`, each with the parts of its slots in which the link was not cut.

    A model keeps its memory until another one replaces it, whatever else of the link changes.
    """
    marks = stretches(schedule)
    ends = [*(start for start, _, _ in marks[1:]), done]
    pieces: list[tuple[LossModel, list[Thinned]]] = []
    before = None
    for (start, settings, cut), end in zip(marks, ends, strict=True):
        if settings["loss"] != before:
            before = settings["loss"]
            pieces.append((loss_of(before), []))
        parts = pieces[-1][1]
        if not cut and start < min(end, done):
            joined = parts.pop().slots.start if parts and parts[-1].slots.stop == start else start
            parts.append(Thinned(range(joined, min(end, done))))
    return [(loss, parts) for loss, parts in pieces if parts]


def _mean_burst(tally: Tally) -> float | None:
    """Mean number of consecutive losses; None if there are none, or if some were too long to be counted."""
    count = int(tally.bursts.sum())
    if not count or tally.bursts[-1]:
        return None
    return float(tally.bursts @ np.arange(1, len(tally.bursts) + 1)) / count


def _expected_burst(pieces: list[tuple[LossModel, list[Thinned]]], tally: Tally) -> float | None:
    """Mean length, by the model, of the bursts that end in the run; None if trials were cut short at different slots."""
    chain: Chain | None = pieces[0][0].chain if [len(parts) for _, parts in pieces] == [1] else None
    if chain is None or not tally.alike:
        return None
    slots = pieces[0][1][0].slots
    return chain.mean_burst(len(slots), slots.stop == tally.done)


def _with_delays(link: LinkSummary, schedule: LinkSchedule, tally: Tally) -> LinkSummary:
    """The link with fractions of the packets that it let through by delay, and their quantiles."""
    total = int(tally.delays.sum())
    if schedule.settings.get("delay") is None or not total:
        return link
    fractions = tally.delays / total
    return replace(
        link,
        delays=fractions.tolist(),
        expected_delays=_expected_delays(schedule),
        # Of counts, so that nine packets of ten are not a little less than 0.9.
        delay_quantiles={f"{level:g}": _quantile(np.cumsum(tally.delays) / total, level) for level in QUANTILES},
    )


def _expected_delays(schedule: LinkSchedule) -> list[float] | None:
    """The fractions by delay that the model predicts; None if the settings change, or if there is a queue."""
    if any(change.settings is not None for change in schedule.changes) or schedule.settings.get("rate", 1.0) < 1.0:
        return None
    model, reorder = delay_of(schedule.settings["delay"]), schedule.settings.get("reorder", 0.0)
    there = [model.arrived(lag) for lag in range(schedule.window + 1)]
    if any(fraction is None for fraction in there):
        return None
    reached = [0.0, *(reorder + (1.0 - reorder) * fraction for fraction in there if fraction is not None), 1.0]
    return [after - before for before, after in pairwise(reached)]


def _quantile(reached: np.ndarray[Any, np.dtype[np.float64]], level: float) -> int | None:
    """The least delay by which this fraction of the packets arrives; None if it is beyond the window."""
    place = int(np.searchsorted(reached, level))
    return place if place < len(reached) - 1 else None


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
