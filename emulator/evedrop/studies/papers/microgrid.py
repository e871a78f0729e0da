"""The paper's microgrid: day means of the error covariance's trace against μ_d, simulated and by theory.

Source: the paper, section "Application to Power Systems".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Action
from evedrop.model.schedule import Schedule
from evedrop.model.slot.link import deliveries, link_of
from evedrop.model.streams import Batch, root_of_seed, stream_key
from evedrop.model.theory.covariances import Outcomes, misled_covariances, theoretical_traces
from evedrop.model.update import actual_covariance
from evedrop.show.view.figure_style import GREY, panels
from evedrop.show.view.palette import paper_inks

MU = 0.6
STATE_PROBABILITIES = tuple(round(0.1 * i, 1) for i in range(1, 10))
DAY = 86_400
RECEIVERS = ("legitimate", "smart", "naive")


def process() -> Process:
    """A = I, Q = 1e-5 I, in per cent of charge, slots of a second; Σ0 = Q."""
    Q = 1e-5 * np.eye(2)
    return Process(np.eye(2), Q, Q)


def uncertain_process() -> Process:
    """The same process with a large initial uncertainty of ± 50 per cent: Σ0 = 2500 I."""
    return Process(np.eye(2), 1e-5 * np.eye(2), 2500.0 * np.eye(2))


@dataclass(frozen=True)
class Day:
    """Means over slots of the trace, (receivers, μ_d): simulated, their standard errors, and by theory."""

    simulated: Floats
    error: Floats
    theory: Floats
    trials: int
    slots: int


def outcomes(receiver: str, mu_d: float) -> Outcomes:
    """A receiver's outcomes in a slot of this figure."""
    if receiver == "legitimate":
        return Outcomes.legitimate(MU, mu_d)
    return Outcomes.eavesdropper(MU, mu_d, 1.0, 1.0 if receiver == "naive" else 0.0)


def theory(slots: int, mu_ds: Sequence[float] = STATE_PROBABILITIES) -> Floats:
    """Day means by the finite-k expectations, (receivers, μ_d)."""
    return np.array(
        [
            [theoretical_traces(_process_of(receiver), outcomes(receiver, mu_d), slots).mean() for mu_d in mu_ds]
            for receiver in RECEIVERS
        ]
    )


def simulate(trials: int, slots: int, progress: Callable[[str], None]) -> Day:
    """A day of covariances for all nine μ_d at once, concatenated along the axis of trials.

    Links are the same for every μ_d; schedules are drawn for each.
    """
    batch = Batch(slots, trials)
    root = root_of_seed(2025)
    links = [
        link_of({"model": "bernoulli", "quality": MU}, stream_key(root, f"link/{name}"), batch)
        for name in ("legitimate", "eavesdropper")
    ]
    schedules = [Schedule(stream_key(root, f"schedule/{mu_d}"), mu_d, batch) for mu_d in STATE_PROBABILITIES]
    width = len(schedules)
    processes = (process(), process(), uncertain_process())
    covariances = [
        np.repeat(filter_process.initial_covariance[:, :, None], width * trials, axis=2) for filter_process in processes
    ]
    misled = misled_covariances(processes[-1], slots)
    sums = np.zeros((len(RECEIVERS), width * trials))
    for k, received in enumerate(zip(*(deliveries(link, slots) for link in links), strict=True)):
        nu = np.concatenate([schedule.at(k) for schedule in schedules])
        gamma, gamma_e = (np.tile(flags, width) for flags in received)
        actions = (
            np.where(gamma, np.where(nu, np.uint8(Action.INNOVATION), np.uint8(Action.STATE)), np.uint8(Action.LOST)),
            np.where(gamma_e & ~nu, np.uint8(Action.STATE), np.uint8(Action.LOST)),
            np.where(gamma_e, np.uint8(Action.STATE), np.uint8(Action.LOST)),
        )
        covariances = [
            actual_covariance(filter_process, k, P, action, nu, misled[k])
            for filter_process, P, action in zip(processes, covariances, actions, strict=True)
        ]
        for row, covariance in enumerate(covariances):
            sums[row] += covariance[0, 0] + covariance[1, 1]
        if k % 8192 == 0:
            progress(f"microgrid: slot {k} of {slots}")
    means = (sums / slots).reshape(len(RECEIVERS), width, trials)
    return Day(means.mean(axis=2), means.std(axis=2, ddof=1) / np.sqrt(trials), theory(slots), trials, slots)


def draw(path: Path, day: Day) -> str:
    """Draw the figure; returns its caption."""
    fine = np.linspace(0.1, 0.9, 33)
    curves = theory(day.slots, fine.tolist())
    inks = paper_inks(RECEIVERS, {})
    with panels(path, 2, 9.6, 4.0) as (left, right):
        for row, axes, colour, mark, label in (
            (0, left, inks["legitimate"], "o", "legitimate"),
            (1, left, inks["smart"], "s", "smart eavesdropper"),
            (2, right, inks["naive"], "^", "naive eavesdropper"),
        ):
            axes.plot(fine, curves[row], "--" if row == 1 else "-", color=colour, label=f"{label}, theory")
            axes.errorbar(
                STATE_PROBABILITIES, day.simulated[row], 2.58 * day.error[row], fmt=mark, color=colour, markersize=4.5,
                capsize=2.5, elinewidth=1.0, markerfacecolor="white", label=f"{label}, simulated",
            )  # fmt: skip
            axes.set_yscale("log")
            axes.set_xlabel(r"probability of sending the state, $\mu_d$")
            axes.set_xticks(STATE_PROBABILITIES)
        left.set_ylabel(r"day mean of tr $P_k$ (per cent$^2$)")
        left.set_title(r"(a) $\Sigma_0 = Q = 10^{-5} I$")
        left.set_ylim(1e-5, 6e-4)
        right.set_title(r"(b) naive, $\Sigma_0 = 2500\, I$: $\pm$50 per cent")
        right.axhline(1e3, color=GREY, linewidth=0.9, linestyle=":")
        right.text(0.1, 1.04e3, r'the paper: "greater than $10^3$"', color=GREY, va="bottom", ha="left")
        right.set_ylim(6e2, 2e4)
        left.legend(loc="upper right")
        right.legend(loc="upper right")
    return (
        f"Microgrid, A = I, Q = 1e-5 I, μ = μ_e = {MU}: mean over {day.slots} slots of one second and {day.trials} trials "
        "of the trace of the actual error covariance, covariances alone simulated; bars are 99 % intervals, lines the "
        "finite-k theory. (b) is the naive eavesdropper that starts with ± 50 per cent."
    )


def _process_of(receiver: str) -> Process:
    return uncertain_process() if receiver == "naive" else process()
