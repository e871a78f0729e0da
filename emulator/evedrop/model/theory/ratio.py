"""How many times larger an eavesdropper's error is than the legitimate one: where the ratio is large enough, and where largest.

An adversary is an eavesdropper as the design of μ_d needs to know it: where its error is bounded, and how large it is.

Source: docs/mathematics/secrecy.md, design.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from evedrop.errors import UsageError
from evedrop.model.process import Process
from evedrop.model.theory.covariances import Outcomes, legitimate_bound, limit_trace, stability_bound
from evedrop.model.theory.json_values import JsonFields

Intervals = tuple[tuple[float, float], ...]
"""(lo, hi) of each interval of μ_d, in ascending order."""

ATTAINED = 1e-5
"""A maximum nearer than this to the open end of the interval, relative to its length, is not a maximum."""
_NEAREST = 1e-9  # smallest distance to a pole, relative to the interval, at which differences are computed


@dataclass(frozen=True)
class Adversary:
    """An eavesdropper as the design needs to know it."""

    name: str
    mu_e: float
    """Quality of its link."""
    use_state: float
    """P(b = 1 given ν = 0)."""
    use_innovation: float
    """P(b = 1 given ν = 1)."""
    reads_leak: bool = False
    """Whether it uses the leak of innovations: the genie, with the probabilities of smart."""

    @classmethod
    def with_outcomes(cls, name: str, mu_e: float, half: Outcomes) -> Adversary:
        """From its outcomes behind a lossless link at μ_d = 1/2."""
        return cls(name, mu_e, 2.0 * half.state, 2.0 * half.misled, half.leaked > 0.0)

    def outcomes(self, mu_d: float) -> Outcomes:
        """Its outcomes in a slot."""
        if self.reads_leak:
            return Outcomes.genie(self.mu_e, mu_d)
        return Outcomes.eavesdropper(self.mu_e, mu_d, self.use_state, self.use_innovation)


def adversary_bound(process: Process, adversary: Adversary) -> float:
    """Infimum of the μ_d at which an eavesdropper's error is bounded; inf if there is none.

    The error of an eavesdropper that may be misled is bounded at most at μ_d = 1, where nothing misleads.

    Source: docs/mathematics/secrecy.md, design.
    """
    bound = stability_bound(process, adversary.mu_e * adversary.use_state)
    if math.isinf(limit_trace(process, adversary.outcomes(0.5))) and adversary.outcomes(0.5).misled:
        return 1.0 if bound < 1.0 else math.inf
    return bound


def traces_of(process: Process, mu: float, adversary: Adversary, mu_d: float) -> tuple[float, float]:
    """J and J_e at μ_d; inf where they are unbounded."""
    ours = limit_trace(process, Outcomes.legitimate(mu, mu_d))
    return ours, limit_trace(process, adversary.outcomes(mu_d))


def points_between(low: float, high: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Points of (low, high], dense near low, where there may be a pole."""
    steps = np.concatenate([np.geomspace(_NEAREST, 0.02, 60), np.linspace(0.02, 1.0, 99)[1:]])
    return low + steps * (high - low)


_XTOL = 1e-13
_ROUNDING = 1e-12  # relative difference within which a ratio counts as the one asked for


@dataclass(frozen=True)
class LargestRatio(JsonFields):
    """The largest J_e / J, the least of the eavesdroppers' if there are several."""

    ratio: float
    """inf where J_e is unbounded, or J is 0."""
    mu_d: float
    """Where: the largest such μ_d, at which the ratio costs least."""
    attained: bool
    """False: the ratio is only approached, as μ_d falls to the lower end of the admissible ones, which is `mu_d`."""
    cost: float
    """J(μ_d) / J(1); inf where J is unbounded."""


@dataclass(frozen=True)
class Choice(JsonFields):
    """The μ_d of least legitimate error at which J_e / J is large enough against every eavesdropper."""

    min_ratio: float
    """The ratio asked for."""
    intervals: Intervals
    """(lo, hi) of all such μ_d, in ascending order; the ends belong to them, except for those at which an error is unbounded."""
    mu_d: float
    trace: float
    """J(μ_d)."""
    cost: float
    """J(μ_d) / J(1)."""
    ratios: dict[str, float]
    """Eavesdropper → its J_e / J at μ_d."""


def ratio_of(ours: float, theirs: float) -> float:
    """J_e / J; inf if only J_e is unbounded or only J is 0, 1 if both are 0, 0 if only J is unbounded, nan if both are."""
    if math.isinf(ours):
        return math.nan if math.isinf(theirs) else 0.0
    if ours == 0.0:
        return math.inf if theirs > 0.0 else 1.0
    return theirs / ours


def largest_ratio(
    process: Process, mu: float, adversaries: Sequence[Adversary], above: float | None = None
) -> LargestRatio | None:
    """The largest J_e / J that is possible against every one of the eavesdroppers; None if no μ_d is admissible.

    above: only μ_d larger than this are considered.
    """
    low = max(legitimate_bound(process, mu), above or 0.0)
    if low >= 1.0:
        return None
    ratio = _least_ratio(process, mu, adversaries)
    points = _points(process, low, adversaries, ratio)
    most = max(map(ratio, points))
    at = max(mu_d for mu_d in points if ratio(mu_d) >= most * (1.0 - _ROUNDING))
    if math.isinf(most):
        at = edge(at, min((mu_d for mu_d in points if mu_d > at), default=at), lambda mu_d: math.isinf(ratio(mu_d)))
    attained = at - low > ATTAINED * (1.0 - low)
    at = at if attained else low
    return LargestRatio(most, at, attained, cost_of(process, mu, at))


def cheapest(
    process: Process,
    mu: float,
    adversaries: Sequence[Adversary],
    min_ratio: float,
    minimum: float | None = None,
    max_trace: float | None = None,
) -> Choice:
    """The μ_d of least legitimate error at which J_e / J is at least `min_ratio` against every eavesdropper.

    minimum: the infimum of the μ_d that keep the legitimate trace below Ω, `max_trace`.

    J falls with μ_d, so it is the largest of them. Raises UsageError if there are none, with the largest ratio there is.

    Source: docs/mathematics/secrecy.md, design; Lemma VI.1 (J falls).
    """
    low = legitimate_bound(process, mu)
    if low >= 1.0:
        raise UsageError(
            f"no μ_d gives {min_ratio:g}×: none is admissible, because the legitimate error is unbounded even if every packet is "
            "the state; improve the legitimate link"
        )
    intervals = large_enough(process, mu, adversaries, min_ratio)
    kept = _above(minimum, intervals)
    if not kept:
        raise UsageError(_impossible(process, mu, adversaries, min_ratio, intervals, minimum, max_trace))
    return _choice(process, mu, adversaries, min_ratio, kept)


def _above(minimum: float | None, intervals: Intervals) -> Intervals:
    """What lies above the minimum, if there is one."""
    return tuple((max(a, minimum or 0.0), b) for a, b in intervals if minimum is None or b > minimum)


def _choice(
    process: Process, mu: float, adversaries: Sequence[Adversary], min_ratio: float, intervals: Intervals
) -> Choice:
    """The largest μ_d of the intervals, where the legitimate error is least."""
    mu_d = intervals[-1][1]
    return Choice(
        min_ratio=min_ratio,
        intervals=intervals,
        mu_d=mu_d,
        trace=limit_trace(process, Outcomes.legitimate(mu, mu_d)),
        cost=cost_of(process, mu, mu_d),
        ratios=_ratios(process, mu, adversaries, mu_d),
    )


_NEARLY = 0.9  # of the largest ratio: the rest of it may cost many times as much


def suggestion(
    process: Process, mu: float, adversaries: Sequence[Adversary], minimum: float | None = None
) -> Choice | None:
    """The cheapest μ_d with at least 90 % of the largest J_e / J that is possible against every eavesdropper.

    If that is unbounded, so is the ratio at this μ_d. With a lossless link the legitimate error is 0 whatever μ_d: the choice is
    the largest μ_d of perfect secrecy, if there is one. minimum: as for `cheapest`. None if there is no eavesdropper, or the
    error of one is never larger than the legitimate one.

    Source: docs/mathematics/secrecy.md, design.
    """
    most = largest_ratio(process, mu, adversaries, minimum) if adversaries else None
    if most is None or most.ratio <= 1.0 + _ROUNDING:
        return None
    if mu == 1.0 and (perfect := _above(minimum, _perfect(process, adversaries))):
        return _choice(process, mu, adversaries, math.inf, perfect)
    return cheapest(process, mu, adversaries, max(1.0, _NEARLY * most.ratio), minimum)


def _perfect(process: Process, adversaries: Sequence[Adversary]) -> Intervals:
    """The intervals of μ_d at which the error of every eavesdropper is unbounded."""

    def unbounded(mu_d: float) -> float:
        return min(limit_trace(process, adversary.outcomes(mu_d)) for adversary in adversaries)

    return _where(lambda mu_d: math.isinf(unbounded(mu_d)), _points(process, 0.0, adversaries, unbounded), 0.0)


def large_enough(process: Process, mu: float, adversaries: Sequence[Adversary], min_ratio: float) -> Intervals:
    """The intervals of admissible μ_d with J_e / J ≥ min_ratio against every eavesdropper, in ascending order.

    The ratio need not be monotone. It is computed at many points between its poles, and at its local extrema; where two
    neighbouring points differ, the end is found by bisection.
    """
    low = legitimate_bound(process, mu)
    if low >= 1.0:
        return ()
    ratio = _least_ratio(process, mu, adversaries)

    def holds(mu_d: float) -> bool:
        return ratio(mu_d) >= min_ratio * (1.0 - _ROUNDING)

    return _where(holds, _points(process, low, adversaries, ratio), low)


def _where(holds: Callable[[float], bool], points: Sequence[float], low: float) -> Intervals:
    """The intervals of (low, 1] in which something holds; it changes at most once between two neighbouring points."""
    intervals: list[tuple[float, float]] = []
    begin = low if holds(points[0]) else None
    for a, b in pairwise(points):
        if begin is None and holds(b):
            begin = edge(b, a, holds)
        elif begin is not None and not holds(b):
            intervals.append((begin, edge(a, b, holds)))
            begin = None
    return tuple(intervals if begin is None else [*intervals, (begin, 1.0)])


def cost_of(process: Process, mu: float, mu_d: float) -> float:
    """J(μ_d) / J(1): 1 for a lossless link."""
    plain = limit_trace(process, Outcomes.plain(mu))
    return 1.0 if plain == 0.0 else limit_trace(process, Outcomes.legitimate(mu, mu_d)) / plain


def _ratios(process: Process, mu: float, adversaries: Sequence[Adversary], mu_d: float) -> dict[str, float]:
    return {adversary.name: ratio_of(*traces_of(process, mu, adversary, mu_d)) for adversary in adversaries}


def _least_ratio(process: Process, mu: float, adversaries: Sequence[Adversary]) -> Callable[[float], float]:
    """The least J_e / J of the eavesdroppers as a function of μ_d; 0 where J is unbounded."""

    @cache
    def least(mu_d: float) -> float:
        ratios = _ratios(process, mu, adversaries, mu_d).values()
        return 0.0 if any(map(math.isnan, ratios)) else min(ratios)

    return least


def _points(
    process: Process, low: float, adversaries: Sequence[Adversary], ratio: Callable[[float], float]
) -> list[float]:
    """Points of (low, 1] in ascending order: many between the poles, each local extremum of the ratio, and 1."""
    from scipy.optimize import minimize_scalar  # noqa: PLC0415 - slow to import

    poles = {
        low,
        1.0,
        *(bound for adversary in adversaries if low < (bound := adversary_bound(process, adversary)) < 1.0),
    }
    points = {float(point) for a, b in pairwise(sorted(poles)) for point in points_between(a, b)} | {1.0}
    points = {point for point in points if low < point <= 1.0}
    for a, b, c in zip(ordered := sorted(points), ordered[1:], ordered[2:], strict=False):
        before, here, after = ratio(a), ratio(b), ratio(c)
        if not (math.isfinite(before + here + after) and (here - before) * (after - here) < 0.0):
            continue
        sign = -1.0 if here > before else 1.0
        refined = minimize_scalar(
            lambda mu_d, sign=sign: sign * _logarithm(ratio(float(mu_d))),
            bounds=(a, c),
            method="bounded",
            options={"xatol": 1e-12},
        )
        points.add(float(refined.x))
    return sorted(points)


def _logarithm(ratio: float) -> float:
    """The logarithm of a ratio; finite for 0 and for inf too, with which no minimum is found."""
    return math.log(min(max(ratio, 1e-300), 1e300))


def edge(inside: float, outside: float, holds: Callable[[float], bool], within: float = _XTOL) -> float:
    """The last number on the way from `inside`, where something holds, to `outside`, where it does not, at which it holds.

    By bisection, to `within`; it must change only once on the way.
    """
    while abs(outside - inside) > within:
        middle = 0.5 * (inside + outside)
        if holds(middle):
            inside = middle
        else:
            outside = middle
    return inside


def _impossible(
    process: Process,
    mu: float,
    adversaries: Sequence[Adversary],
    min_ratio: float,
    intervals: Sequence[tuple[float, float]],
    minimum: float | None,
    max_trace: float | None,
) -> str:
    """The reason why no μ_d can be chosen: the largest ratio, where it is, what it costs, and whether Ω prevents a larger one."""
    most = largest_ratio(process, mu, adversaries, minimum)
    every = " against every eavesdropper" if len(adversaries) > 1 else f" against {adversaries[0].name}"
    bounded = "" if minimum is None else f" with a legitimate trace below {max_trace:g}"
    if most is None:
        return f"no μ_d gives {min_ratio:g}×{every}{bounded}; ask for a larger trace"
    dear = "is unbounded" if math.isinf(most.cost) else f"is {most.cost:.3g} times that of sending all states"
    where = f"at μ_d = {most.mu_d:.4g}" if most.attained else f"approached as μ_d falls to {most.mu_d:.4g}"
    sentence = f"no μ_d gives {min_ratio:g}×{every}{bounded}; the most is {most.ratio:.4g}× {where}"
    sentence += f", where the legitimate error {dear}"
    if len(adversaries) > 1 and most.attained:
        each = _ratios(process, mu, adversaries, most.mu_d)
        sentence += f" ({', '.join(f'{name} {ratio:.4g}×' for name, ratio in each.items())})".replace("inf×", "∞×")
    if intervals:
        trace = limit_trace(process, Outcomes.legitimate(mu, intervals[-1][1]))
        sentence += f"; {min_ratio:g}× needs a legitimate trace of {trace:.4g}, at μ_d = {intervals[-1][1]:.4g}"
    return sentence
