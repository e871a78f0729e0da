"""A check of the channel: compares the losses and delays of a link in a run with those of its models.

Source: docs/results.md, links; docs/mathematics.md, links.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from itertools import pairwise
from typing import Any

import numpy as np

from evedrop.model.delays import delay_of
from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.links import loss_of
from evedrop.model.links.loss_model import Chain, LossModel
from evedrop.model.metrics.built_in import LinkAccount
from evedrop.model.process import parts_of
from evedrop.model.slot.link import LinkSchedule
from evedrop.model.slot.link_distribution import stretches
from evedrop.scenario.tables import Scenario
from evedrop.score.summary import LinkSummary
from evedrop.score.sums import Tally

RATE_CONFIDENCE = 0.999
QUANTILES = (0.5, 0.9, 0.99)


def link_summary_of(scenario: Scenario, receiver: str, tally: Tally) -> LinkSummary:
    """A link's account, and how its losses and delays compare with those of its models."""
    schedule = scenario.schedule(receiver)
    pieces = _pieces(schedule, tally.done)
    met = sum(len(slots) for slots, _ in pieces) * tally.trials - tally.lost.get("overflow", 0)
    account = LinkAccount.of(tally)
    # In a run cut short, late packets that were still to come are lost, although the router does not report them.
    lost = {**tally.lost, "underway": account.lost - sum(tally.lost.values()) + tally.lost.get("underway", 0)}
    summary = _with_delays(
        LinkSummary(
            **asdict(account),
            lost_by={reason: count for reason, count in sorted(lost.items()) if count},
            bursts=np.trim_zeros(tally.bursts, "b").tolist(),
            mean_burst=_mean_burst(tally),
            expected_mean_burst=None if tally.lost.get("overflow") else _expected_burst(pieces),
        ),
        schedule,
        tally,
    )
    if tally.offered != tally.done * tally.trials:
        return summary  # trials were cut short at different slots, in which different models may have applied
    if tally.unsent:
        # A scheme's packets may depend on the past: for a loss model with a memory they are not a fair sample.
        if len(pieces) != 1 or len(pieces[0][0]) < tally.done or not _independent(pieces[0][1]):
            return summary
        met -= tally.unsent
    if met <= 0:
        return summary
    rate = 1.0 - tally.lost.get("lost", 0) / met
    slots = sum(len(piece) for piece, _ in pieces)
    expected = (
        sum_in_order(float(loss.quality_at(part).sum()) for piece, loss in pieces for part in parts_of(piece)) / slots
    )
    variance = (
        sum_in_order(loss.rate_variance(piece) * len(piece) ** 2 for piece, loss in pieces) / slots**2 / tally.trials
    )
    variance *= slots * tally.trials / met if tally.unsent else 1.0
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


def _pieces(schedule: LinkSchedule, done: int) -> list[tuple[range, LossModel]]:
    """The slots below `done` in which the link was not cut, in pieces, each with its loss model."""
    marks = stretches(schedule)
    ends = [*(start for start, _, _ in marks[1:]), done]
    return [
        (range(start, min(end, done)), loss_of(settings["loss"]))
        for (start, settings, cut), end in zip(marks, ends, strict=True)
        if not cut and start < min(end, done)
    ]


def _mean_burst(tally: Tally) -> float | None:
    """Mean number of consecutive losses; None if there are none, or if some were too long to be counted."""
    count = int(tally.bursts.sum())
    if not count or tally.bursts[-1]:
        return None
    return float(tally.bursts @ np.arange(1, len(tally.bursts) + 1)) / count


def _expected_burst(pieces: list[tuple[range, LossModel]]) -> float | None:
    """Mean number of consecutive losses by the model: P(lost) over P(lost after a packet that was not lost)."""
    models = {id(loss): loss for _, loss in pieces}
    chain: Chain | None = next(iter(models.values())).chain if len(pieces) == 1 else None
    if chain is None:
        return None
    lost = 1.0 - chain.quality
    begins = float((chain.stationary * chain.quality) @ chain.transitions @ lost)
    return float(chain.stationary @ lost) / begins if begins > 0.0 else None


def _with_delays(link: LinkSummary, schedule: LinkSchedule, tally: Tally) -> LinkSummary:
    """The link with fractions of its delivered packets by delay, and their quantiles."""
    total = int(tally.delays.sum())
    if schedule.settings.get("delay") is None or not total:
        return link
    fractions = tally.delays / total
    return replace(
        link,
        delays=fractions.tolist(),
        expected_delays=_expected_delays(schedule),
        delay_quantiles={f"{level:g}": _quantile(np.cumsum(fractions), level) for level in QUANTILES},
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
