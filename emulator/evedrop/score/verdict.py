"""The verdict: whether the state is kept secret, as a glyph, a word and a sentence, which everything that reports a run shows.

Source: docs/metrics.md, verdict.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from evedrop.model.metrics.text import two_digits
from evedrop.score.after_start import AfterStart, BatchMeans


class SecrecyOutcome(StrEnum):
    """How well the state is kept secret from an eavesdropper, or from all of them."""

    PERFECT = "perfectly secret"
    """Its error grows without bound, and the legitimate estimator's does not."""
    RELATIVE = "secret"
    """Its error stays larger than the legitimate estimator's."""
    OPEN = "cannot tell yet"
    BROKEN = "not secret"

    @property
    def glyph(self) -> str:
        """A letter that can be told from the others without colours."""
        return _GLYPHS[self]

    @property
    def headline(self) -> str:
        """Glyph and word, such as "✓ secret"."""
        return f"{self.glyph} {self.value}"


_GLYPHS = {
    SecrecyOutcome.PERFECT: "✔",
    SecrecyOutcome.RELATIVE: "✓",
    SecrecyOutcome.OPEN: "?",
    SecrecyOutcome.BROKEN: "✗",
}
_ORDER = (SecrecyOutcome.BROKEN, SecrecyOutcome.OPEN, SecrecyOutcome.RELATIVE, SecrecyOutcome.PERFECT)


def weakest(outcomes: Iterable[SecrecyOutcome]) -> SecrecyOutcome:
    """The outcome that decides among several eavesdroppers, since one can break secrecy. Raises ValueError if there is none."""
    return min(outcomes, key=_ORDER.index)


_NEAR = 0.1  # how near to 1 two digits hide on which side a ratio is
_MOST_PLACES = 7  # more decimals than a ratio's text has
_SMALLER = 0.8  # times the legitimate error: less is "more than the estimator", and the rest "as much"


@dataclass(frozen=True)
class Verdict:
    """Whether the state is kept secret."""

    outcome: SecrecyOutcome
    reason: str
    """The rest of the sentence: the distances of both, and how many times larger the eavesdropper's squared error is."""
    eavesdropper: str
    """The eavesdropper that decides it."""
    times: str = ""
    """How many times the legitimate squared error its own is, with the interval; empty if nothing was measured."""

    @property
    def headline(self) -> str:
        """Glyph and word, such as "✓ secret"."""
        return self.outcome.headline

    @property
    def sentence(self) -> str:
        """Glyph, word and reason."""
        return f"{self.headline}: {self.reason}"


@dataclass(frozen=True)
class Compared:
    """An eavesdropper compared with the legitimate estimator, after the start."""

    eavesdropper: str
    after_start: AfterStart
    grows: bool = False
    """Whether perfect secrecy held: its error grows without bound, by theory as well."""
    denied: bool = False
    """Whether theory says that its error is not larger in the long run."""
    true: AfterStart | None = None
    """The same for errors against the true state, if the sensor sends an estimate; its ratio is NaN if that is unknown."""
    replayed: bool = False
    """Whether all trials replay the same recording of losses, so that intervals hold for this recording only."""
    by_median: bool = False
    """Whether medians decide, because a variance is infinite: distances and the ratio are of means, which then say nothing."""

    @property
    def larger(self) -> bool | None:
        """As in `AfterStart`; a single trial does not show what theory denies, because it may lack rare events."""
        shown = self.after_start.larger
        return None if shown and self.denied and self.after_start.in_one_trial else shown

    @property
    def outcome(self) -> SecrecyOutcome:
        """What it shows."""
        if math.isnan(self.after_start.ratio) or self.larger is None:
            return SecrecyOutcome.BROKEN if self.denied else SecrecyOutcome.OPEN
        if self.larger:
            return SecrecyOutcome.PERFECT if self.grows else SecrecyOutcome.RELATIVE
        return SecrecyOutcome.BROKEN


def verdict_on(compared: Compared, unit: str = "", *, best: bool = False) -> Verdict:
    """The verdict on an eavesdropper; unit: of the distances; best: whether it is the best one of several."""
    name, values, outcome = compared.eavesdropper, compared.after_start, compared.outcome
    if math.isnan(values.ratio):
        return Verdict(outcome, values.why_open or "nothing was measured", name)
    who = f"the best eavesdropper ({name})" if best else name
    times = times_text(values.ratio, values.interval)
    off = "off" if compared.true is None else "off the sensor's estimate"
    if values.distances is None:
        of_what = "" if compared.true is None else " to the sensor's estimate"
        numbers = f"{who} has {times} the estimator's squared error{of_what}"
    else:
        ours, theirs = (distance_text(distance, unit) for distance in values.distances)
        numbers = f"the estimator is {ours} {off}, {who} {theirs}: {times} the squared error"
    if compared.true is not None and not math.isnan(compared.true.ratio):
        numbers += f", {times_text(compared.true.ratio, compared.true.interval)} against the true state"
    if values.in_one_trial:
        numbers += ", in this trial"
    elif compared.replayed:
        numbers += ", given this recording of losses"
    if compared.by_median:
        numbers += " (means of infinite variance; judged by medians)"
    knows = "more than" if values.ratio < _SMALLER else "as much as"
    reason = {
        SecrecyOutcome.BROKEN: f"{name} knows {knows} the estimator; {numbers}",
        SecrecyOutcome.OPEN: f"{values.why_open}; {numbers}",
        SecrecyOutcome.PERFECT: f"{numbers}, and growing",
        SecrecyOutcome.RELATIVE: numbers,
    }[outcome]
    if outcome is SecrecyOutcome.BROKEN and compared.larger is None:  # only theory says so
        reason = f"by theory, {name} knows as much as the estimator in the long run; here {numbers}"
    return Verdict(outcome, reason, name, times)


def verdict_of(compared: Iterable[Compared], unit: str = "") -> Verdict | None:
    """The verdict on all eavesdroppers: the one that knows most decides, since one can break secrecy. None without any."""
    several = list(compared)
    if not several:
        return None
    decisive = min(several, key=lambda each: (_ORDER.index(each.outcome), _sortable(each.after_start.ratio)))
    least = min(_sortable(each.after_start.ratio) for each in several)
    return verdict_on(decisive, unit, best=len(several) > 1 and _sortable(decisive.after_start.ratio) == least)


def verdict_so_far(
    ours: BatchMeans,
    theirs: Sequence[tuple[str, BatchMeans]],
    unit: str = "",
    noise: float = 0.0,
    trials: int = 1,
    *,
    of_estimate: bool = False,
) -> Verdict | None:
    """The verdict on the slots of a run so far, from the mean errors of their batches, over all trials.

    noise: tr Q; of_estimate: whether errors are against the estimate that the sensor sends.
    """
    compared = [
        Compared(
            name,
            replace(AfterStart.of_batches(ours, batches, noise), in_one_trial=trials == 1, why_open="too early"),
            true=AfterStart(math.nan) if of_estimate else None,
        )
        for name, batches in theirs
    ]
    return verdict_of(compared, unit)


def _sortable(ratio: float) -> float:
    return math.inf if math.isnan(ratio) else ratio


def times_text(ratio: float, interval: tuple[float, float] | None = None) -> str:
    """A ratio with two digits and its interval, such as "17 × [13, 22]".

    Limits near 1, the ratio of equal errors, are rounded outwards, to as many decimals as show on which side of 1 they are.
    """
    if interval is None:
        return f"{two_digits(ratio)} ×"
    low, high = interval
    places = max(_places(low, math.floor), _places(high, math.ceil))
    between = f"[{_limit(low, math.floor)}, {_limit(high, math.ceil)}]"
    return f"{f'{ratio:.{places}f}' if places and _near_one(ratio) else two_digits(ratio)} × {between}"


def _limit(limit: float, outwards: Callable[[float], int]) -> str:
    places = _places(limit, outwards)
    return f"{outwards(limit * 10**places) / 10**places:.{places}f}" if places else two_digits(limit)


def _places(limit: float, outwards: Callable[[float], int]) -> int:
    """The decimals that a limit near 1 needs not to be rounded to 1; 0: two digits suffice."""
    if not _near_one(limit):
        return 0
    return next((places for places in range(2, _MOST_PLACES) if outwards(limit * 10**places) != 10**places), 0)


def _near_one(ratio: float) -> bool:
    return ratio != 1.0 and abs(ratio - 1.0) < _NEAR


def distance_text(distance: float, unit: str = "") -> str:
    """A distance with two digits and its unit, such as "0.32 m"."""
    return f"{two_digits(distance)} {unit}".rstrip()
