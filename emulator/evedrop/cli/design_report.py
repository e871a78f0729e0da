"""The design of μ_d on the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from evedrop.cli.report import terminal
from evedrop.model.metrics.text import finite_text, number_text
from evedrop.show.report.text_table import TextTable

if TYPE_CHECKING:
    from evedrop.model.theory.design import Design
    from evedrop.model.theory.ratio import Choice, LargestRatio


def print_design(design: Design) -> None:
    """Print a design as text: bounds, intervals, optima and the price of secrecy."""
    console = terminal()
    console.print(f"spectral radius {design.rho:.6g}; legitimate link quality μ = {design.mu:g}")
    if design.remark is not None:
        console.print(design.remark)
    else:
        error = "error is unbounded"
        if math.isfinite(design.trace):
            error = (
                f"trace is {design.trace:.4g}, {design.cost:.3g} times that of sending every state "
                f"({design.plain_trace:.4g})"
            )
        console.print(
            f"admissible: {design.bound:.6g} < μ_d ≤ 1; at this scenario's μ_d = {design.mu_d:g} the legitimate {error}"
        )
    if design.minimum is not None:
        console.print(f"least μ_d for the wanted trace: {design.minimum:.6g}")
    if design.choice is not None:
        for line in _chosen(design.choice, design.left_out):
            console.print(line)
    heads = (
        "bounded from",
        "perfect secrecy",
        "relative secrecy",
        "argmax J_r",
        "largest J_e/J",
        "its trace",
        "J_e/J",
        "from slot",
    )
    table = TextTable.headed(["against"], heads)
    for name, against in design.eavesdroppers.items():
        table.add(
            name,
            finite_text(against.bound, ".6g"),
            "none" if against.perfect is None else _half_open(against.perfect, against.bound),
            "none"
            if not against.relative
            else " ∪ ".join(f"({low:.5f}, {high:.5f})" for low, high in against.relative),
            number_text(against.best_difference, ".5f"),
            "–" if against.largest is None else _largest(against.largest),
            finite_text(against.trace, ".6g"),
            "–" if math.isnan(against.ratio) else finite_text(against.ratio),
            "–" if against.relative_from is None else str(against.relative_from),
        )
    console.show(table)
    if design.omission is not None:
        console.print(design.omission)


def _largest(largest: LargestRatio) -> str:
    """The largest ratio, and its μ_d."""
    return finite_text(largest.ratio) + f" {'at' if largest.attained else '→'} {_shown(largest.mu_d)}"


def _shown(mu_d: float) -> str:
    """A μ_d; the largest that is not 1 is not shown as 1."""
    return "1−" if 1.0 - 1e-9 < mu_d < 1.0 else f"{mu_d:.5g}"


def _chosen(choice: Choice, left_out: Mapping[str, str]) -> Iterator[str]:
    """The μ_d chosen, what it costs, and the line that puts it into the scenario."""
    where = " or ".join(f"{_shown(low)} … {_shown(high)}" for low, high in choice.intervals)
    every = "against every eavesdropper" if not left_out else f"against {', '.join(choice.ratios)}"
    yield f"J_e/J ≥ {choice.min_ratio:g} {every} at μ_d = {where}"
    cost = f"{choice.trace:.4g}, {choice.cost:.3g} times that of sending every state"
    each = ", ".join(f"{name} {finite_text(ratio)}" for name, ratio in choice.ratios.items())
    yield f"cheapest: μ_d = {_shown(choice.mu_d)}, where the legitimate trace is {cost}; J_e/J: {each}"
    yield "to run it, write in [encoding]:"
    yield f"state_probability = {choice.mu_d!r}"


def _half_open(interval: tuple[float, float], bound: float) -> str:
    """The interval of perfect secrecy; closed at its upper end, unless that is 1 and the error is bounded there."""
    low, high = interval
    return f"({low:.5f}, {high:.5f}{')' if high == bound == 1.0 else ']'}"
