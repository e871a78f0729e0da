"""Whether secrecy held in a run, and whether theory promises it. "Too few trials to tell" is a verdict of its own.

Source: docs/mathematics.md, secrecy and design; docs/results.md, verdict.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from evedrop.expected.expectations import Expectation
from evedrop.model.process import Floats
from evedrop.score.summary import SecrecySummary
from evedrop.score.sums import WINDOWS, Tally, window_means, window_of

BOUND_CONFIDENCE = 0.99
_ROUNDING = 1e-12  # relative to the eavesdropper's error: over a perfect link the legitimate error is 0


class Verdict(StrEnum):
    """What a run shows about a claim."""

    HELD = "held"
    FAILED = "failed"
    UNDECIDED = "too few trials to tell"


@dataclass(frozen=True)
class Secrecy:
    """Secrecy against one eavesdropper: the result of the run and the claim of theory."""

    eavesdropper: str
    relative: Verdict
    perfect: Verdict
    relative_by_theory: bool | None
    """tr E P_k < tr E Pᵉ_k at every slot k ≥ 1 that was run, and J bounded; None where theory makes no statement."""
    relative_from: int | None
    """The first slot k ≥ 1 from which tr E P_k < tr E Pᵉ_k until the end of the run; None if there is none."""
    windows: str
    """The slots of the windows in which relative secrecy failed or was undecided, such as "1 to 124"; empty if in all."""
    perfect_by_theory: bool | None
    """J bounded and J_e not; None where theory makes no statement."""
    ratio: float
    """Mean error, eavesdropper's over legitimate; NaN before the first slot."""
    trials: int
    judged_by: str
    """`mean` over trials, or `median` where an error has infinite variance, so that a mean is not meaningful."""
    unknown: str = "no theory covers these links"
    """The end of the sentence where theory makes no claim."""

    @property
    def summary(self) -> SecrecySummary:
        """The entry of the summary."""
        return SecrecySummary(
            relative=self.relative.value,
            perfect=self.perfect.value,
            relative_by_theory=self.relative_by_theory,
            relative_from=self.relative_from,
            perfect_by_theory=self.perfect_by_theory,
            judged_by=self.judged_by,
            sentence=self.sentence,
        )

    @property
    def sentence(self) -> str:
        """One sentence for the closing report."""
        theory = "perfect" if self.perfect_by_theory else "relative" if self.relative_by_theory else "no"
        promise = self.unknown
        if self.relative_by_theory is not None:
            promise = f"theory promises {theory} secrecy"
        if theory == "no" and self.relative_from is not None:
            promise = f"theory promises relative secrecy from slot {self.relative_from} on"
        if math.isnan(self.ratio):
            return f"{self.eavesdropper}: nothing was measured; {promise}"
        times = "∞" if math.isinf(self.ratio) else f"{self.ratio:.3g}"
        where = f" in slots {self.windows}" if self.windows else ""
        run = {
            Verdict.HELD: "relative secrecy held in every window of this run",
            Verdict.FAILED: f"relative secrecy failed in this run{where}",
            Verdict.UNDECIDED: f"{self.trials} trials are too few to decide{where}"
            if self.trials > 1
            else "one trial decides nothing (try --trials 200)",
        }[self.relative]
        if self.perfect is Verdict.HELD:
            run = "perfect secrecy held in this run: its error grew while the legitimate one stayed bounded"
        if self.judged_by == "median" and self.trials > 1:
            run += " (judged by medians, because the variance is infinite)"
        return f"{self.eavesdropper}: {times} × the legitimate error; {run}; {promise}"


Bounds = Callable[[Floats], tuple[float, float]]
"""Lower and upper bound of a quantity, from its samples (R,)."""


def mean_bounds(samples: Floats) -> tuple[float, float]:
    """One-sided 99 % bounds below and above the mean of samples (R,), by Student's t."""
    from scipy.special import stdtrit  # noqa: PLC0415 - 0.2 s that only a verdict needs

    count = len(samples)
    if count < 2:
        return -math.inf, math.inf
    mean = float(np.mean(samples))
    reach = float(stdtrit(count - 1, BOUND_CONFIDENCE)) * float(np.std(samples, ddof=1)) / math.sqrt(count)
    return mean - reach, mean + reach


def median_bounds(samples: Floats) -> tuple[float, float]:
    """One-sided 99 % bounds below and above the median of samples (R,), by order statistics, for any tails."""
    from scipy.special import bdtr, bdtrik  # noqa: PLC0415 - as above

    count = len(samples)
    ordered = np.sort(samples)
    # The largest rank that is too high with a probability of 1 %, by the binomial law of the number of samples below the median.
    rank = int(bdtrik(1.0 - BOUND_CONFIDENCE, count, 0.5)) if bdtr(0, count, 0.5) <= 1.0 - BOUND_CONFIDENCE else -1
    if rank < 0:
        return -math.inf, math.inf
    return float(ordered[rank]), float(ordered[count - 1 - rank])


def _relative(difference: Floats, bounds_of: Bounds, slots: int) -> tuple[Verdict, str]:
    """The verdict on relative secrecy, and the slots in which it failed or is undecided, empty if in all.

    difference: the eavesdropper's mean error less the legitimate one, by window and trial, (WINDOWS, R).
    """
    bounds = {w: bounds_of(row) for w, row in enumerate(difference) if not np.isnan(row).any()}
    failed = [window for window, (_, high) in bounds.items() if high < 0.0]
    doubtful = [window for window, (low, _) in bounds.items() if not low > 0.0]
    if failed:
        return Verdict.FAILED, _slots_of(failed, slots)
    if doubtful or not bounds:
        return Verdict.UNDECIDED, _slots_of(doubtful, slots) if len(doubtful) < len(bounds) else ""
    return Verdict.HELD, ""


def _slots_of(windows: list[int], slots: int) -> str:
    """The slots of some windows in words: "1 to 124, 625 to 749"."""
    window = window_of(np.arange(slots), slots)
    spans = [np.flatnonzero(window == one) for one in windows]
    return ", ".join(f"{span[0]} to {span[-1]}" for span in spans)


def _perfect(eavesdropper: Floats, legitimate: Floats, bound: float, bounds_of: Bounds) -> Verdict:
    """Held if the eavesdropper's error grows from the first to the last quarter and the legitimate error stays within `bound`."""
    quarter = WINDOWS // 4
    if np.isnan(eavesdropper).any():
        return Verdict.UNDECIDED
    growth = bounds_of(eavesdropper[-quarter:].mean(axis=0) - eavesdropper[:quarter].mean(axis=0))
    error = bounds_of(legitimate[-quarter:].mean(axis=0))
    if growth[1] < 0.0 or error[0] > bound + _ROUNDING * float(np.mean(eavesdropper)):
        return Verdict.FAILED
    return Verdict.HELD if growth[0] > 0.0 else Verdict.UNDECIDED


def secrecy(legitimate: tuple[Tally, Expectation], eavesdropper: tuple[str, Tally, Expectation]) -> Secrecy:
    """The verdict on one eavesdropper, from both tallies and what theory expects of both receivers."""
    (user, user_theory), (name, other, other_theory) = legitimate, eavesdropper
    # A lower bound can support a promise, but cannot deny one.
    bounded = other_theory.bound is not None
    theirs = other_theory.bound or other_theory
    known = user_theory.known and theirs.known
    user_bound = user_theory.limit if user_theory.known else math.inf
    perfect_by_theory = (math.isfinite(user_bound) and math.isinf(theirs.limit)) or (None if bounded else False)
    # A limit too large to be computed neither promises nor denies anything.
    perfect_by_theory = perfect_by_theory if known and not math.isnan(user_bound + theirs.limit) else None
    complete = user.done == user.slots
    slots = user.slots if complete else max(user.done, 2)
    gap = theirs.traces(slots) - user_theory.traces(slots)
    always = math.isfinite(user_bound) and slots > 1 and bool(np.all(gap[1:] > 0.0))
    user_means, other_means = window_means(user), window_means(other)
    heavy = user_theory.infinite_variance or other_theory.infinite_variance
    bounds_of = median_bounds if heavy else mean_bounds
    relative, windows = Verdict.UNDECIDED, ""
    if complete:
        relative, windows = _relative(other_means - user_means, bounds_of, slots)
    if perfect_by_theory is False:
        perfect = Verdict.FAILED
    else:
        perfect = _perfect(other_means, user_means, user_bound, bounds_of) if complete else Verdict.UNDECIDED
    ratio = other.error / user.error if user.error else math.inf if user.done else math.nan
    return Secrecy(
        name,
        relative,
        perfect,
        (always or (None if bounded else False)) if known else None,
        _holds_from(gap) if known and math.isfinite(user_bound) else None,
        windows,
        perfect_by_theory,
        ratio,
        user.trials,
        "median" if heavy else "mean",
        *(["no closed form of its error is known"] if other_theory.outcomes_at is None else []),
    )


def _holds_from(gap: Floats) -> int | None:
    """The first slot k ≥ 1 from which the gap (slots,) is positive to its end; None if there is none."""
    wrong = np.flatnonzero(~(gap[1:] > 0.0)) + 1
    first = int(wrong[-1]) + 1 if wrong.size else 1
    return first if first < len(gap) else None


class SecrecyKept(StrEnum):
    """How much a scheme keeps secret from an adversary, in a word."""

    PERFECT = "perfect"
    RELATIVE = "relative"
    UNDECIDED = "too few trials to tell"
    BROKEN = "broken"


MARKS = {SecrecyKept.PERFECT: "●", SecrecyKept.RELATIVE: "◐", SecrecyKept.UNDECIDED: "?", SecrecyKept.BROKEN: "✕"}
"""Verdicts as marks that can be distinguished without colours."""
