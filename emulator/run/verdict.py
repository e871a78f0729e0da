"""Did secrecy hold in this run, and does theory say it must? Too few trials to tell is a verdict of its own.

Source: docs/mathematics.md, secrecy and design; docs/results.md, verdict.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from emulator.model.process import Floats, Process
from emulator.model.theory import Outcomes, expected_traces, limit_trace
from emulator.run.score import WINDOWS, Tally, window_means

CONFIDENCE = 0.99


class Verdict(StrEnum):
    """What a run says of a claim."""

    HELD = "held"
    FAILED = "failed"
    UNDECIDED = "too few trials to tell"


@dataclass(frozen=True)
class Secrecy:
    """Secrecy against one eavesdropper: what the run shows and what theory says."""

    eavesdropper: str
    relative: Verdict
    perfect: Verdict
    relative_by_theory: bool
    """tr E P_k < tr E Pᵉ_k at every slot k ≥ 1 that was run, and J bounded."""
    perfect_by_theory: bool
    """J bounded and J_e not."""
    ratio: float
    """Mean squared error, eavesdropper's over legitimate."""

    def as_dict(self) -> dict[str, str | bool]:
        """As in the summary."""
        return {
            "relative": self.relative.value,
            "perfect": self.perfect.value,
            "relative_by_theory": self.relative_by_theory,
            "perfect_by_theory": self.perfect_by_theory,
            "sentence": self.sentence,
        }

    @property
    def sentence(self) -> str:
        """One sentence for the closing report."""
        theory = "perfect" if self.perfect_by_theory else "relative" if self.relative_by_theory else "no"
        times = "∞" if math.isinf(self.ratio) else f"{self.ratio:.3g}"
        run = {
            Verdict.HELD: "relative secrecy held in every window of this run",
            Verdict.FAILED: "relative secrecy failed in this run",
            Verdict.UNDECIDED: "too few trials to decide from this run (try --trials 200)",
        }[self.relative]
        if self.perfect is Verdict.HELD:
            run = "perfect secrecy held in this run: its error grew while the legitimate one stayed bounded"
        return f"{self.eavesdropper}: {times} × the legitimate squared error; {run}; theory promises {theory} secrecy"


def _bounds(samples: Floats) -> tuple[float, float]:
    """One-sided 99 % bounds below and above the mean of samples (R,), by Student's t."""
    from scipy.special import stdtrit  # noqa: PLC0415 - 0.2 s that only a verdict needs

    count = len(samples)
    if count < 2:
        return -math.inf, math.inf
    mean = float(np.mean(samples))
    reach = float(stdtrit(count - 1, CONFIDENCE)) * float(np.std(samples, ddof=1)) / math.sqrt(count)
    return mean - reach, mean + reach


def _relative(difference: Floats) -> Verdict:
    """From the mean error differences of each window and trial, (WINDOWS, R)."""
    bounds = [_bounds(row) for row in difference if not np.isnan(row).any()]
    if any(high < 0.0 for _, high in bounds):
        return Verdict.FAILED
    return Verdict.HELD if bounds and all(low > 0.0 for low, _ in bounds) else Verdict.UNDECIDED


def _perfect(eavesdropper: Floats, legitimate: Floats, bound: float) -> Verdict:
    """Grows from the first to the last quarter, while the legitimate error stays within its bound."""
    quarter = WINDOWS // 4
    if np.isnan(eavesdropper).any():
        return Verdict.UNDECIDED
    growth = _bounds(eavesdropper[-quarter:].mean(axis=0) - eavesdropper[:quarter].mean(axis=0))
    error = _bounds(legitimate[-quarter:].mean(axis=0))
    if growth[1] < 0.0 or error[0] > bound:
        return Verdict.FAILED
    return Verdict.HELD if growth[0] > 0.0 else Verdict.UNDECIDED


def secrecy(process: Process, legitimate: tuple[Tally, Outcomes], eavesdropper: tuple[str, Tally, Outcomes]) -> Secrecy:
    """The verdict on one eavesdropper, from both tallies and both receivers' outcome probabilities."""
    (user, user_outcomes), (name, other, other_outcomes) = legitimate, eavesdropper
    user_bound, other_bound = limit_trace(process, user_outcomes), limit_trace(process, other_outcomes)
    perfect_by_theory = math.isfinite(user_bound) and math.isinf(other_bound)
    complete = user.done == user.slots
    slots = user.slots if complete else max(user.done, 2)
    gap = expected_traces(process, other_outcomes, slots) - expected_traces(process, user_outcomes, slots)
    user_means, other_means = window_means(user), window_means(other)
    relative = _relative(other_means - user_means) if complete else Verdict.UNDECIDED
    if not perfect_by_theory:
        perfect = Verdict.FAILED
    else:
        perfect = _perfect(other_means, user_means, user_bound) if complete else Verdict.UNDECIDED
    ratio = other.error / user.error if user.error else math.inf
    return Secrecy(
        name,
        relative,
        perfect,
        bool(math.isfinite(user_bound) and np.all(gap[1:] > 0.0)),
        perfect_by_theory,
        ratio,
    )
