"""Designs on the terminal: μ_d, energy budgets, policies of transmission, and schedules."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import groupby
from typing import TYPE_CHECKING

from evedrop.cli.report import ReportConsole, left_out_line
from evedrop.model.checks import toml_of
from evedrop.model.metrics.text import finite_text, number_text
from evedrop.model.theory.design import Design
from evedrop.model.theory.schedules import ScheduleDesign
from evedrop.scenario.designs import BudgetDesign, PolicyDesign
from evedrop.show.report.text_table import TextTable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from evedrop.model.theory.policies import Front, PolicyMetrics
    from evedrop.model.theory.ratio import Choice, LargestRatio
    from evedrop.model.theory.schedules import MeanSchedule


def print_designed(design: object, console: ReportConsole) -> None:
    """Print a design of any kind as text."""
    match design:
        case Design():
            _print_design(design, console)
        case ScheduleDesign():
            _print_schedules(design, console)
        case PolicyDesign():
            _print_policies(design, console)
        case BudgetDesign():
            _print_budget(design, console)
        case _:
            raise TypeError(f"{type(design).__name__} is not a design")


def _print_design(design: Design, console: ReportConsole) -> None:
    """Print a design as text: bounds, intervals, optima and the price of secrecy."""
    if (answer := _answer(design)) is not None:
        console.say(answer, "bold")
    console.say(f"spectral radius {design.rho:.6g}; legitimate link quality μ = {design.mu:g}")
    if design.remark is not None:
        console.say(design.remark)
    else:
        error = "error is unbounded"
        if math.isfinite(design.trace):
            error = (
                f"trace is {design.trace:.4g}, {design.cost:.3g} times that of sending every state "
                f"({design.plain_trace:.4g})"
            )
        console.say(
            f"admissible: {design.bound:.6g} < μ_d ≤ 1; at this scenario's μ_d = {design.mu_d:g} the legitimate {error}"
        )
    if design.minimum is not None:
        console.say(f"least μ_d for the wanted trace: {design.minimum:.6g}")
    if design.choice is not None:
        for line in _chosen(design.choice, design.left_out):
            console.say(line)
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
    least = ("from slot", "its trace", "argmax J_r", "bounded from", "relative secrecy", "J_e/J", "perfect secrecy")
    table = TextTable.headed(["against"], heads, least=least)
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
        console.say(design.omission)


def _answer(design: Design) -> str | None:
    """The μ_d to choose, what it gives and what it costs, in a sentence; None if no μ_d is admissible or nobody listens."""
    if design.remark is not None or not design.eavesdroppers:
        return None
    choice = design.choice or design.suggestion
    if choice is None:
        which, also = (
            ("", "") if design.minimum is None else (" that keeps the wanted trace", "ask for a larger trace, or ")
        )
        return f"no μ_d{which} keeps the error of every eavesdropper above the legitimate one: {also}improve the legitimate link"
    traces = design.traces_at(choice.mu_d)
    perfect = [name for name in choice.ratios if math.isinf(traces[name])]
    closest = min(choice.ratios, key=lambda name: choice.ratios[name])
    gives = [f"perfect secrecy against {', '.join(perfect)}"] if perfect else []
    if choice.trace == 0.0:
        gives.append("the legitimate error is 0")
    elif closest not in perfect:
        gives.append(f"the error of {closest}, the closest, is {choice.ratios[closest]:.3g} × the legitimate one")
    cost = f"costs {choice.cost:.3g} × the error of sending every state"
    return f"choose μ_d = {_rounded_down(choice.mu_d)}: {', and '.join(gives)}; {cost}"


def _rounded_down(mu_d: float) -> str:
    """A μ_d with five digits that is not larger, for what holds at it may not hold above it."""
    return "1−" if 1.0 - 1e-9 < mu_d < 1.0 else f"{math.floor(mu_d * 1e5) / 1e5:.5g}"


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


def _print_budget(design: BudgetDesign, console: ReportConsole) -> None:
    """Print the thresholds as a table, the one for the budget among them."""
    console.say(
        f"an unencrypted packet costs {design.unencrypted:g}, an encrypted one {design.encrypted:g}; errors are traces in the "
        f"limit; the legitimate one is {finite_text(design.legitimate)}"
    )
    names = list(design.best.eavesdroppers)
    errors = [f"error of {name}" for name in names]
    shown = TextTable.headed([], ["threshold θ", "encrypted", "energy", *errors], [""])
    for choice in sorted({round(each.threshold, 9): each for each in (*design.others, design.best)}.items()):
        metrics = choice[1]
        shown.add(
            number_text(metrics.threshold, ".6g"),
            number_text(metrics.encrypted_fraction, ".4f"),
            number_text(metrics.energy, ".6g"),
            *(finite_text(metrics.eavesdroppers[name]) for name in names),
            "the budget's" if metrics is design.best else "",
        )
    console.show(shown)
    if design.left_out:
        console.say(left_out_line(design.left_out, "no closed form of its error is known under this scheme"))
    console.say(f"threshold = {design.best.threshold!r}")


_METRICS = ("legitimate error", "its error", "sent")


def _print_policies(design: PolicyDesign, console: ReportConsole) -> None:
    """Print the fronts as text."""
    console.say(
        f"legitimate link quality μ = {design.mu:g}; errors are traces in the limit; sent: the fraction of slots with a packet"
    )
    for name, front in design.fronts.items():
        console.say(f"\nagainst {name}, the scheme with its threshold:")
        _show_against(name, _thresholds(front), console)
        console.say(f"the best policy if the sensor also knew how long ago {name} heard a packet, which it does not:")
        _show_against(name, _policies(front, design.states), console)
        if front.never:
            for price in sorted({price for _, price in front.never}):
                weights = ", ".join(f"{weight:g}" for weight, never_price in front.never if never_price == price)
                console.say(f"left out, because the best policy never sends: with λ = {price:g} the weights {weights}")
        if front.dominated:
            policies = "policy" if front.dominated == 1 else "policies"
            console.say(f"left out: {front.dominated} {policies} that another one dominates")
    if design.left_out:
        console.say(left_out_line(design.left_out, "no closed form of its error is known under this scheme"))


def _show_against(eavesdropper: str, table: TextTable, console: ReportConsole) -> None:
    """Show a table below a line that names the eavesdropper; a file of the table names it itself."""
    console.show(table.under("against", eavesdropper), table)


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
    return (*map(finite_text, (metrics.legitimate, metrics.eavesdropper)), number_text(metrics.transmissions, ".4f"))


def _print_schedules(design: ScheduleDesign, console: ReportConsole) -> None:
    """Print the schedules as text."""
    for name, schedule in design.schedules.items():
        console.say(
            f"against {name}: the sum is {schedule.best.value:.6g} with this schedule, "
            f"and {schedule.constant.value:.6g} with the best constant μ_d, {schedule.constant.mu_d[1]:.6g}"
        )
        _show_against(name, _slots(schedule.best), console)
        on_grid = (
            "the best schedule of the grid"
            if schedule.exact
            else "the best schedule found on the part of the grid that was searched"
        )
        console.say(
            f"{on_grid} has {schedule.grid.value:.6g}; "
            "none of the changes tried, of one μ_d or of two neighbouring ones, improves this schedule"
        )
        numbers = list(schedule.best.mu_d)
        console.say(f"to run it, with slots = {len(numbers)}, write in [encoding]:")
        console.print(f"state_probability = {toml_of(numbers)}\n", soft_wrap=True)
    if design.left_out:
        console.say(left_out_line(design.left_out, "no closed form of its error is known"))


def _slots(schedule: MeanSchedule) -> TextTable:
    """One row for each slot."""
    shown = TextTable.headed([], ["slot", "μ_d", "legitimate error", "its error"])
    for k, row in enumerate(zip(schedule.mu_d, schedule.legitimate, schedule.eavesdropper, strict=True)):
        mu_d, ours, theirs = row
        shown.add(str(k), number_text(mu_d, ".6g"), number_text(ours), number_text(theirs))
    return shown
