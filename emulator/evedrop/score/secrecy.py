"""Whether secrecy held in a run, and whether theory promises it. "Too few trials to tell" is a verdict of its own.

Source: docs/mathematics/secrecy.md, secrecy and design; docs/metrics.md, verdict.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache

import numpy as np

from evedrop.model.metrics.standard_error import ratio_error, skewed_test, student_test
from evedrop.model.metrics.text import count_text
from evedrop.model.process import Floats, parts_of
from evedrop.model.theory.covariances import NOBODY, TheoreticalCovariance
from evedrop.model.theory.rare_events import RARE
from evedrop.names import LEGITIMATE
from evedrop.scenario.theory import Alike, Expectation, TheoreticalTraceStream, variances_along
from evedrop.score.after_start import AS_MUCH, ERROR_RATE, TOO_SHORT, AfterStart, ratio_interval
from evedrop.score.rare_events import rare_events_of
from evedrop.score.summary import RARE_FRACTION, SecrecySummary
from evedrop.score.sums import WINDOWS, Tally, window_bounds, window_means, window_of
from evedrop.score.verdict import Compared, verdict_on

_QUARTER = WINDOWS // 4  # of the slots, in windows
_ROUNDING = 1e-12  # relative to the eavesdropper's error: over a perfect link the legitimate error is 0


class Claim(StrEnum):
    """What a run shows about a claim."""

    HELD = "held"
    FAILED = "failed"
    UNDECIDED = "too few trials to tell"


@dataclass(frozen=True)
class SignTest:
    """The p-values of two one-sided tests on the mean, or the median, of a quantity."""

    above: float
    """The p-value of the hypothesis that it is 0 or less: small where it is above 0."""
    below: float
    """The p-value of the hypothesis that it is 0 or more: small where it is below 0."""


SignTestOf = Callable[[Floats], SignTest]
"""Tests a quantity, from its samples (R,)."""
_NOTHING = SignTest(1.0, 1.0)
_CUT_SHORT = "the run was cut short"
_PROMISED_SLOTS = 10_000  # for which theory is computed at least


def sign_of_mean(samples: Floats) -> SignTest:
    """Tests on the mean of samples (R,), by Student's t and by the same corrected for skewness: the larger p-value counts.

    Source: docs/mathematics/verdicts.md, verdicts.
    """
    scale = float(np.max(np.abs(samples), initial=0.0))
    if 0.0 < scale < math.inf:
        samples = samples / scale  # the tests do not depend on it, and squares of large numbers overflow
    tests = student_test(samples, 0.0), skewed_test(samples, 0.0)
    possible = [test for test in tests if test is not None]
    if possible:
        return SignTest(max(test.above for test in possible), max(test.below for test in possible))
    mean = float(np.mean(samples))
    if len(samples) < 2 or mean == 0.0 or not math.isfinite(mean) or (samples != samples[0]).any():
        return _NOTHING
    return SignTest(0.0, 1.0) if mean > 0.0 else SignTest(1.0, 0.0)


def sign_of_median(samples: Floats) -> SignTest:
    """Tests on the median of samples (R,), by the number of them on either side of 0, for any tails."""
    from scipy.special import bdtr  # noqa: PLC0415 - as above

    count = len(samples)
    low, high = int(np.count_nonzero(samples <= 0.0)), int(np.count_nonzero(samples >= 0.0))
    return SignTest(float(bdtr(low, count, 0.5)), float(bdtr(high, count, 0.5)))


def rejected(p_values: Mapping[int, float]) -> list[int]:
    """The hypotheses, by number, that Holm's method rejects: at most one time in a hundred is any of them true.

    Source: docs/mathematics/verdicts.md, verdicts.
    """
    hypotheses = []
    for place, hypothesis in enumerate(sorted(p_values, key=lambda at: p_values[at])):
        if p_values[hypothesis] > ERROR_RATE / (len(p_values) - place):
            break
        hypotheses.append(hypothesis)
    return sorted(hypotheses)


def relative_verdict(
    difference: Floats, test: SignTestOf, slots: int, least: Floats | None = None, most: Floats | None = None
) -> tuple[Claim, str]:
    """The verdict on relative secrecy, and the slots in which it failed or is undecided, empty if in all.

    difference: the eavesdropper's mean error less the legitimate one, by window and trial, (WINDOWS, R). One window fails the
    claim, so the windows share the error rate. All windows must support it, so that each may have the whole rate.

    least, most: the same difference from the largest mean that the legitimate error may have, and that the eavesdropper's may
    have: `held` must hold of the first of them as well, and `failed` of the second. None: these are the means of the trials.
    """
    measured = [w for w, row in enumerate(difference) if not np.isnan(row).any()]
    tests = {w: test(difference[w]) for w in measured}
    of_least, of_most = (tests if bound is None else {w: test(bound[w]) for w in measured} for bound in (least, most))
    failed = rejected({w: max(tests[w].below, of_most[w].below) for w in measured})
    doubtful = [w for w in measured if max(tests[w].above, of_least[w].above) > ERROR_RATE]
    if failed:
        return Claim.FAILED, _slots_of(failed, slots)
    if doubtful or not tests:
        return Claim.UNDECIDED, _slots_of(doubtful, slots) if len(doubtful) < len(tests) else ""
    return Claim.HELD, ""


def _slots_of(windows: list[int], slots: int) -> str:
    """The slots of some windows in words: "1 to 124, 625 to 749"."""
    bounds = window_bounds(slots)
    return ", ".join(f"{bounds[window]} to {bounds[window + 1] - 1}" for window in windows)


def perfect_verdict(eavesdropper: Floats, legitimate: Floats, bound: float, test: SignTestOf) -> Claim:
    """Held if the eavesdropper's error grows from the first to the last quarter and the legitimate error stays within `bound`.

    bound: not finite if none is known. Then the legitimate error must not grow; if it does, it may still be bounded.
    """
    if np.isnan(eavesdropper).any():
        return Claim.UNDECIDED
    growth, legitimate_growth = (
        test(error[-_QUARTER:].mean(axis=0) - error[:_QUARTER].mean(axis=0)) for error in (eavesdropper, legitimate)
    )
    highest = bound + _ROUNDING * float(np.mean(eavesdropper))
    has_bound = math.isfinite(bound)
    excess = test(legitimate[-_QUARTER:].mean(axis=0) - highest) if has_bound else _NOTHING
    if rejected({0: growth.below, 1: excess.above}):
        return Claim.FAILED
    stays = has_bound or legitimate_growth.above > ERROR_RATE
    return Claim.HELD if growth.above <= ERROR_RATE and stays else Claim.UNDECIDED


def secrecy(
    of_legitimate: tuple[Tally, Expectation],
    of_eavesdropper: tuple[str, Tally, Expectation],
    unit: str = "",
    floor_grows: Callable[[], bool] = lambda: False,
    true: AfterStart | None = None,
    replayed: bool = False,
) -> tuple[SecrecySummary, Compared]:
    """Secrecy against one eavesdropper, and the comparison after the start on which its verdict rests.

    From both tallies and what theory expects of both receivers.

    unit: of the distances; floor_grows: returns whether another lower bound on the eavesdropper's error grows without bound;
    true, replayed: as in `Compared`.
    """
    (legitimate, legitimate_theory), (name, other, other_theory) = of_legitimate, of_eavesdropper
    complete = legitimate.done == legitimate.slots
    # What theory promises does not depend on how soon a run was interrupted, but must not take long then.
    slots = legitimate.slots if complete else min(legitimate.slots, max(legitimate.done, _PROMISED_SLOTS))
    promise = promise_of(legitimate_theory, other_theory, slots)
    bound = _latest_bound(legitimate_theory, legitimate.slots) if complete else math.inf
    heavy = legitimate_theory.infinite_variance or other_theory.infinite_variance
    test = sign_of_median if heavy else sign_of_mean
    means = MeanErrors(window_means(legitimate), window_means(other))
    relative, windows, missing = Claim.UNDECIDED, "", ""
    if complete:
        if not heavy and legitimate.trials > 1:
            most_ours = largest_means(legitimate_theory, means.ours, slots)
            means = replace(means, most_ours=most_ours, most_theirs=largest_means(other_theory, means.theirs, slots))
        relative, windows, in_doubt = _relative(means, test, slots)
        if in_doubt is not None:
            missing = _missing(*((LEGITIMATE, *of_legitimate) if in_doubt is Claim.HELD else of_eavesdropper))
    perfect = Claim.UNDECIDED
    if legitimate_theory.has_limit and promise.perfect is False:
        perfect = Claim.FAILED
    elif legitimate_theory.has_limit and complete:
        perfect = perfect_verdict(means.theirs, means.ours, bound, test)
    ratio, scatter, ratio_from = ratio_of((legitimate, legitimate_theory), other)
    scatter = None if heavy else scatter
    is_rounding = legitimate.done > 0 and other_theory.is_rounding(other.error / max(other.offered, 1), other.done)
    after_start = _after_start(
        (legitimate, other), means, test, (ratio, scatter, ratio_from), legitimate_theory, is_rounding
    )
    if missing:
        after_start = replace(after_start, why_open=missing.removeprefix(": "))
    compared = Compared(
        name,
        after_start,
        grows=perfect is Claim.HELD and (promise.perfect is True or (promise.perfect is None and floor_grows())),
        denied=promise.denied and legitimate.slots > WINDOWS,
        true=true,
        replayed=replayed,
        by_median=heavy and legitimate.trials > 1,
    )
    entry = SecrecySummary(
        relative=relative.value,
        perfect=perfect.value,
        relative_by_theory=promise.relative,
        relative_from=promise.relative_from,
        perfect_by_theory=promise.perfect,
        judged_by="median" if heavy else "mean",
        sentence="",
        ratio=ratio if math.isfinite(ratio) else None,
        ratio_standard_error=scatter,
        ratio_from=ratio_from,
        leak=None if other.leak is None else other.leak.summary,
        verdict=verdict_on(compared, unit),
    )
    where = f" in slots {windows}" if windows else ""
    undecided = f"{legitimate.trials:,} trials are too few to decide{where}{missing}"
    if slots == 1 or not complete:
        undecided = TOO_SHORT if complete else _CUT_SHORT
    shown = ""  # one trial decides no window
    if math.isnan(ratio):
        shown = "nothing was measured"
    elif legitimate.trials > 1 or relative is not Claim.UNDECIDED:
        shown = _shown(
            relative, perfect, where, undecided, is_bounded=math.isfinite(bound), by_median=compared.by_median
        )
    parts = [part for part in (shown, _promised(entry, other_theory)) if part]
    return replace(entry, sentence=f"{name}: {'; '.join(parts)}"), compared


@dataclass(frozen=True)
class Promise:
    """What theory promises about secrecy against an eavesdropper; None where it makes no claim."""

    perfect: bool | None = None
    relative: bool | None = None
    relative_from: int | None = None
    """The first slot from which it promises relative secrecy."""
    denied: bool = False
    """Whether it expects at the end of the run that the eavesdropper's error is not larger."""


def promise_of(legitimate: Expectation, other: Expectation, slots: int) -> Promise:
    """What theory promises about an eavesdropper in so many slots, from what it expects of both receivers."""
    theirs = other.bound or other
    if not (legitimate.known and theirs.known):
        return Promise()
    unless_promised = False if other.bound is None else None  # a lower bound can support a promise, but cannot deny one
    is_bounded = math.isfinite(legitimate.limit)
    perfect = (is_bounded and math.isinf(theirs.limit)) or unless_promised
    if math.isnan(legitimate.limit + theirs.limit):  # too large to be computed
        perfect = None
    holds_from = _holds_from(legitimate.alike, theirs.alike, slots)
    stays = is_bounded or not legitimate.has_limit
    return Promise(
        perfect,
        (stays and slots > 1 and holds_from == 1) or unless_promised,
        holds_from if stays else None,
        denied=other.bound is None and not perfect and holds_from is None,
    )


def _shown(relative: Claim, perfect: Claim, where: str, undecided: str, *, is_bounded: bool, by_median: bool) -> str:
    """What a run has shown about secrecy against an eavesdropper, as part of a sentence.

    where: the slots in which relative secrecy failed; undecided: why it is; is_bounded: whether the legitimate error is.
    """
    shown = {
        Claim.HELD: "its error was larger in every window of the run",
        Claim.FAILED: f"its error was not larger{where}",
        Claim.UNDECIDED: undecided,
    }[relative]
    if perfect is Claim.HELD:
        shown = f"its error grew while the legitimate one {'stayed bounded' if is_bounded else 'did not'}"
    return f"{shown} (judged by medians, because the variance is infinite)" if by_median else shown


@dataclass(frozen=True)
class MeanErrors:
    """Mean errors by window and trial, (WINDOWS, R): the legitimate estimator's and an eavesdropper's."""

    ours: Floats
    theirs: Floats
    most_ours: Floats | None = None
    """What they may be at most, by `largest_means`; None: not known."""
    most_theirs: Floats | None = None


def _relative(means: MeanErrors, test: SignTestOf, slots: int) -> tuple[Claim, str, Claim | None]:
    """The verdict on relative secrecy and its slots, as from `relative_verdict`.

    Third: what the means of the trials alone would show, if only the larger means that theory allows leave it open; else None.
    """
    difference = means.theirs - means.ours
    plain, windows = relative_verdict(difference, test, slots)
    if means.most_ours is None or means.most_theirs is None or plain is Claim.UNDECIDED:
        return plain, windows, None
    least, most = means.theirs - means.most_ours, means.most_theirs - means.ours
    relative, windows = relative_verdict(difference, test, slots, least, most)
    return relative, windows, plain if relative is Claim.UNDECIDED else None


def _after_start(
    tallies: tuple[Tally, Tally],
    means: MeanErrors,
    test: SignTestOf,
    ratio: tuple[float, float | None, int | None],
    theory: Expectation,
    is_rounding: bool,
) -> AfterStart:
    """The comparison in the second half of the run; ratio: as from `ratio_of`; is_rounding: of the eavesdropper's error."""
    legitimate, other = tallies
    ours, theirs = legitimate.distance, other.distance
    if ours is not None and theirs is not None and ours.batches is not None and theirs.batches is not None:
        return AfterStart.of_batches(ours.batches, theirs.batches, float(np.trace(theory.process.Q)))
    value, scatter, first = ratio
    distances = None
    if ours is not None and theirs is not None:  # of the same slots as the ratio
        far, farther = (tally.distance(later=first != 0) for tally in (ours, theirs))
        distances = None if far is None or farther is None else (far, farther)
    if legitimate.slots <= WINDOWS:
        return AfterStart(value, None, None, distances, TOO_SHORT)
    if is_rounding:
        return AfterStart(1.0, None, False, distances)
    if legitimate.done != legitimate.slots:
        return AfterStart(value, None, None, distances, _CUT_SHORT)
    interval = ratio_interval(value, scatter, legitimate.trials)
    larger = _larger(means, test)
    return AfterStart(value, interval, larger, distances, f"{legitimate.trials:,} trials are too few")


def _larger(means: MeanErrors, test: SignTestOf) -> bool | None:
    """Whether the eavesdropper's error is larger in the second half; False: at most `AS_MUCH` times as large; None: undecided.

    Where the tails of its error are too heavy for a test of means, half its median may decide: an error that is not negative
    has a mean of at least that. Source: docs/mathematics/verdicts.md, verdicts.
    """

    def tests(less: Floats | None, more: Floats | None, factor: float = 1.0) -> SignTest:
        if less is None or more is None:
            return SignTest(0.0, 0.0)  # nothing to add to the test of the means
        return test(_later(more) - factor * _later(less))

    above = test(_later(means.theirs) - _later(means.ours)).above, tests(means.most_ours, means.theirs).above
    if max(above) <= ERROR_RATE / 2:
        return True
    if means.most_ours is not None:
        half = _later(means.theirs) / 2.0 - _later(means.most_ours)
        if sign_of_median(half).above <= ERROR_RATE / 2:
            return True
    below = tests(means.ours, means.theirs, AS_MUCH).below, tests(means.ours, means.most_theirs, AS_MUCH).below
    return False if max(below) <= ERROR_RATE else None


def _later(by_window: Floats) -> Floats:
    """The mean over the windows of the second half that have slots, (R,)."""
    later = by_window[WINDOWS // 2 :]
    measured = later[~np.isnan(later).any(axis=1)]
    return np.asarray((measured if len(measured) else later).mean(axis=0))


def ratio_of(of_legitimate: tuple[Tally, Expectation], other: Tally) -> tuple[float, float | None, int | None]:
    """The ratio of two mean errors, the eavesdropper's over the legitimate one, its standard error, and its first slot.

    Over the second half of the run, so that the start, in which few packets decide, does not count; over all slots of a run
    that was cut short or is not longer than its first half. inf if only the legitimate error is mere rounding, 1 if both are;
    NaN without slots.
    """
    legitimate, theory = of_legitimate
    if not legitimate.done:
        return math.nan, None, None
    first = int(window_bounds(legitimate.slots)[WINDOWS // 2])
    if legitimate.done == other.done == legitimate.slots and first < legitimate.slots:
        theirs, ours = (tally.window_errors[WINDOWS // 2 : WINDOWS].sum(axis=0) for tally in (other, legitimate))
    else:
        first, (theirs, ours) = 0, (tally.window_errors.sum(axis=0) for tally in (other, legitimate))
    over, under = float(np.mean(theirs)), float(np.mean(ours))
    alike = legitimate.alike and other.alike
    count = legitimate.done - first
    if not under or theory.is_rounding(under / count, legitimate.done):
        equal = not over or theory.is_rounding(over / count, legitimate.done)
        return 1.0 if equal else math.inf, None, first
    return over / under, ratio_error(theirs, ours) if alike else None, first


def largest_means(theory: Expectation, means: Floats, slots: int, v: Floats | None = None) -> Floats:
    """What a receiver's mean errors by window may be, given those of the trials, (WINDOWS, R): (WINDOWS, 1).

    Theory's expectation where it is known. Where theory only knows a model of what moves the states, the mean of the trials and
    what rare events carry of the model's expectation. Otherwise what an event that none of R trials met may add to their mean:
    it has a probability of at most 4.6/R, or one of them would have met it in 99 of 100 studies. The error is then taken to be
    that of the heaviest trial, or, where too few trials lose the first packet, that of a receiver without packets.

    v: the direction of the errors, (n,), whose expectation may be unknown although that of the whole error is known; None: all.

    Source: docs/mathematics/verdicts.md, verdicts.
    """
    trials = means.shape[1]
    expected = _expected(theory, slots, v)
    if expected is not None:
        if not theory.of_model:
            return expected
        streaks = theory.streaks(slots)
        rare = 1.0 if streaks is None else streaks.fraction(trials)
        return np.asarray(means.mean(axis=1, keepdims=True) + rare * expected)
    heaviest = means.max(axis=1, keepdims=True)
    lost = theory.first_loss
    if math.isnan(lost) or 0.0 < lost * trials < RARE:
        nobody = TheoreticalCovariance(theory.process, NOBODY)
        parts = _traces(nobody, slots) if v is None else [variances_along(nobody, v, slots)]
        heaviest = np.maximum(heaviest, _window_averages(parts, slots))
    return np.asarray(means.mean(axis=1, keepdims=True) - math.log(ERROR_RATE) / trials * heaviest)


def _expected(theory: Expectation, slots: int, v: Floats | None) -> Floats | None:
    """What theory expects in each window, (WINDOWS, 1), of all errors, or of those along v; None if that is not known."""
    if v is None:
        return _expected_averages(theory.alike, slots) if theory.known else None
    series = theory.along(v, slots)
    return None if series is None else _window_averages([series], slots)


def _latest_bound(theory: Expectation, slots: int) -> float:
    """What theory expects of the mean error in the last quarter of the slots at most, and forever after it; inf if unknown.

    The limit may be approached from above. Of a mere model of what moves the states, it bounds no error of a run.
    """
    if not theory.known or theory.of_model or not math.isfinite(theory.limit):
        return math.inf
    return max(theory.limit, *map(float, _expected_averages(theory.alike, slots)[-_QUARTER:, 0]))


@lru_cache(maxsize=64)
def _expected_averages(alike: Alike, slots: int) -> Floats:
    """What theory expects in each window, of all receivers that are alike."""
    return _window_averages(_traces(alike.expectation.stream(), slots), slots)


def _traces(stream: TheoreticalTraceStream, slots: int) -> Iterator[Floats]:
    """The theoretical traces of so many slots, some at a time."""
    return (stream.next_traces(len(part)) for part in parts_of(range(slots)))


def _window_averages(parts: Iterable[Floats], slots: int) -> Floats:
    """The mean over the slots of each window, (WINDOWS, 1), of a value for each slot, given in parts; NaN without slots."""
    sums, first = np.zeros(WINDOWS + 1), 0
    for values in parts:
        np.add.at(sums, window_of(np.arange(first, first + len(values)), slots), values)
        first += len(values)
    with np.errstate(invalid="ignore", divide="ignore"):
        averages: Floats = (sums[:WINDOWS] / np.diff(window_bounds(slots)))[:, None]
    return averages


def _missing(name: str, tally: Tally, theory: Expectation) -> str:
    """What the trials lack for a verdict that they would otherwise support, as the end of a sentence."""
    if not theory.known:
        if 0.0 < theory.first_loss * tally.trials < RARE:
            enough = count_text(math.ceil(RARE / theory.first_loss))
            return f": too few trials lose the first packet of {name}, of {enough} enough would"
        ever = math.isnan(theory.first_loss) and theory.process.spectral_radius >= 1.0
        more = ", however many trials there are" if ever else ""
        return f": losses that no trial met could change this, and no theory bounds the error of {name} in them{more}"
    rare = rare_events_of(theory, tally)
    ways = "montecarlo --rare estimates its mean"
    if rare is not None and rare.fraction > RARE_FRACTION and math.isfinite(rare.trials):
        ways = f"{count_text(rare.trials)} trials would contain them, and {ways}"
    return f": theory expects a larger error of {name}, which rare events carry; {ways}"


def _promised(entry: SecrecySummary, theory: Expectation) -> str:
    """What theory promises, or why it makes no claim about an eavesdropper, as the end of a sentence."""
    promised = "perfect" if entry.perfect_by_theory else "relative" if entry.relative_by_theory else "no"
    if promised == "no" and entry.relative_from is not None:
        return f"theory promises relative secrecy from slot {entry.relative_from} on"
    if entry.relative_by_theory is not None:
        return f"theory promises {promised} secrecy"
    if theory.assumed:
        return "what theory expects of these states is not known"
    return "no closed form of its error is known" if theory.outcomes_at is None else "no theory covers these links"


@lru_cache(maxsize=64)
def _holds_from(legitimate: Alike, other: Alike, slots: int) -> int | None:
    """The first slot k ≥ 1 from which theory expects the other's error to be larger up to slot slots−1; None without one."""
    streams, first = (legitimate.expectation.stream(), other.expectation.stream()), 1
    for part in parts_of(range(slots)):
        smaller, larger = (stream.next_traces(len(part)) for stream in streams)
        wrong = np.flatnonzero(~(larger - smaller > 0.0))
        if wrong.size:
            first = max(1, part.start + int(wrong[-1]) + 1)
    return first if first < slots else None
