"""The terminal output of `evedrop design --schedule`: for each eavesdropper the schedule, and what it gains."""

from __future__ import annotations

from typing import TYPE_CHECKING

from evedrop.cli.report import left_out_line, terminal
from evedrop.model.checks import toml_of
from evedrop.model.metrics.text import number_text
from evedrop.show.report.text_table import TextTable

if TYPE_CHECKING:
    from evedrop.model.theory.schedules import MeanSchedule, ScheduleDesign


def print_schedules(design: ScheduleDesign) -> None:
    """Print the schedules as text."""
    console = terminal()
    for name, schedule in design.schedules.items():
        console.print(
            f"against {name}: the sum is {schedule.best.value:.6g} with this schedule, "
            f"and {schedule.constant.value:.6g} with the best constant μ_d, {schedule.constant.mu_d[1]:.6g}"
        )
        console.show(_slots(schedule.best))
        on_grid = (
            "the best schedule of the grid"
            if schedule.exact
            else "the best schedule found on the part of the grid that was searched"
        )
        console.print(
            f"{on_grid} has {schedule.grid.value:.6g}; "
            "none of the changes tried, of one μ_d or of two neighbouring ones, improves this schedule"
        )
        numbers = list(schedule.best.mu_d)
        console.print(f"to run it, with slots = {len(numbers)}, write in [encoding]:")
        console.print(f"state_probability = {toml_of(numbers)}\n", soft_wrap=True, highlight=False, markup=False)
    if design.left_out:
        console.print(left_out_line(design.left_out, "no closed form of its error is known"))


def _slots(schedule: MeanSchedule) -> TextTable:
    """One row for each slot."""
    shown = TextTable.headed([], ["slot", "μ_d", "user's error", "its error"])
    for k, row in enumerate(zip(schedule.mu_d, schedule.user, schedule.eavesdropper, strict=True)):
        mu_d, ours, theirs = row
        shown.add(str(k), number_text(mu_d, ".6g"), number_text(ours), number_text(theirs))
    return shown
