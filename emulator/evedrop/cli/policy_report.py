"""The terminal output of `evedrop design --policy`: a table of thresholds and one of policies for each eavesdropper."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING

from evedrop.cli.report import left_out_line, terminal
from evedrop.model.metrics.text import finite_text, number_text
from evedrop.show.report.text_table import TextTable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from evedrop.model.theory.policies import Front, PolicyMetrics
    from evedrop.scenario.expected.policies import PolicyDesign

_METRICS = ("user's error", "its error", "sent")


def print_policies(design: PolicyDesign) -> None:
    """Print the fronts as text."""
    console = terminal()
    console.print(
        f"legitimate link quality μ = {design.mu:g}; errors are traces in the limit; sent: the fraction of slots with a packet"
    )
    for name, front in design.fronts.items():
        console.print(f"\nagainst {name}, the scheme with its threshold:")
        console.show(_thresholds(front))
        console.print(f"the best policy if the sensor also knew how long ago {name} heard a packet, which it does not:")
        console.show(_policies(front, design.states))
        if front.never:
            for price in sorted({price for _, price in front.never}):
                weights = ", ".join(f"{weight:g}" for weight, never_price in front.never if never_price == price)
                console.print(
                    f"left out, because the best policy never sends: with λ = {price:g} the weights {weights}"
                )
        if front.dominated:
            policies = "policy" if front.dominated == 1 else "policies"
            console.print(f"left out: {front.dominated} {policies} that another one dominates")
    if design.left_out:
        console.print(left_out_line(design.left_out, "no closed form of its error is known under this scheme"))


def _thresholds(front: Front) -> TextTable:
    shown = TextTable.headed([], ["threshold θ", *_METRICS])
    for i, metrics in enumerate(front.thresholds):
        shown.add(str(i + 1), *_metrics(metrics))
    return shown


def _policies(front: Front, states: int) -> TextTable:
    last = "send from h ≥, by its holding time 1, 2 …"
    shown = TextTable.headed([], ["weight", "λ", *_METRICS, "best θ"], [last], wrapped=[last])
    for point in front.points:
        low, high = point.weights
        shown.add(
            f"{low:g}" if low == high else f"{low:g} … {high:g}",
            number_text(point.price, "g"),
            *_metrics(point.metrics),
            str(point.scheduled),
            _by_holding_time(point.thresholds, states),
        )
    return shown


def _by_holding_time(thresholds: Sequence[int], states: int) -> str:
    """The thresholds, equal ones in a row as a count."""
    stretches = [(threshold, len(list(equal))) for threshold, equal in groupby(thresholds)]
    return " ".join(
        ("never" if threshold > states else str(threshold)) + (f" ×{count}" if count > 1 else "")
        for threshold, count in stretches
    )


def _metrics(metrics: PolicyMetrics) -> tuple[str, ...]:
    return (*map(finite_text, (metrics.user, metrics.eavesdropper)), number_text(metrics.transmissions, ".4f"))
