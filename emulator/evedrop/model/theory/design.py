"""The choice of μ_d: which values are admissible, secret against which eavesdropper, optimal, and at what cost.

Source: docs/mathematics/secrecy.md, design.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from evedrop.errors import UsageError
from evedrop.model.process import Process
from evedrop.model.receiver import Flags
from evedrop.model.theory.covariances import Outcomes, legitimate_bound, limit_trace, theoretical_traces
from evedrop.model.theory.json_values import json_value
from evedrop.model.theory.ratio import (
    ATTAINED,
    Adversary,
    Choice,
    LargestRatio,
    adversary_bound,
    cheapest,
    largest_ratio,
    points_between,
    ratio_of,
    suggestion,
    traces_of,
)
from evedrop.names import LEGITIMATE

Interval = tuple[float, float]

_EQUAL = 1e-12  # relative difference below which two traces count as equal
_XTOL = 1e-13


@dataclass(frozen=True)
class Against:
    """The secrecy that is possible against one eavesdropper."""

    bound: float
    """Lower end of the μ_d at which its error is bounded: (1 − ρ⁻²)/μ_e for smart; inf if there is no such μ_d."""
    perfect: Interval | None
    """(lo, hi]: its error is unbounded and the legitimate one is not."""
    relative: tuple[Interval, ...]
    """Where J < J_e ≤ ∞ and J is bounded: secrecy in the limit, between the ends."""
    best_difference: float | None
    """μ_d* that maximises J_r = J_e − J; None if there is no maximum: J_r is unbounded, or nowhere positive."""
    best_ratio: float | None
    """μ_d that maximises J_r / J, and so J_e / J; None if there is no maximum."""
    ratio: float
    """J_e / J at the scenario's own μ_d; inf if only its error is unbounded, nan if both are."""
    largest: LargestRatio | None
    """The largest J_e / J over the admissible μ_d; None if no μ_d is admissible."""
    trace: float
    """J_e at the scenario's own μ_d."""
    difference: float
    """J_r = J_e − J at that μ_d: the gain. nan if both are unbounded."""
    violated: tuple[tuple[int, int], ...]
    """(first, last) of each stretch of the run's slots k ≥ 1 in which tr E P_k < tr E Pᵉ_k does not hold at the
    scenario's own μ_d."""
    relative_from: int | None
    """First slot k ≥ 1 from which on it holds until the end of the run; None if it fails in the last slot. 1 is the paper's
    "for all k"."""

    def as_dict(self) -> dict[str, Any]:
        """The JSON of `evedrop design`; inf is null."""
        before = ("bound", "perfect", "relative", "best_difference", "best_ratio", "ratio")
        values = {name: json_value(getattr(self, name)) for name in before}
        return {**values, "largest_ratio": json_value(self.largest), "trace": json_value(self.trace)}


@dataclass(frozen=True)
class Design:
    """The design of μ_d for one process, one legitimate link and any number of eavesdroppers."""

    rho: float
    """ρ(A)."""
    mu: float
    mu_d: float
    """The scenario's own μ_d."""
    bound: float
    """(1 − ρ⁻²)/μ, or 0 for μ = 1: the legitimate error is bounded iff μ_d lies above it."""
    admissible: Interval | None
    """(lo, 1], the μ_d of a bounded legitimate error; None if there are none."""
    minimum: float | None
    """μ_d_min for the Ω asked for; None if none was."""
    trace: float
    """J at the scenario's own μ_d; inf if unbounded."""
    plain_trace: float
    """J(1): the error over the same link if every packet is the state."""
    eavesdroppers: dict[str, Against]
    choice: Choice | None = None
    """The cheapest μ_d with the ratio asked for; None if none was."""
    suggestion: Choice | None = None
    """The cheapest μ_d with nearly the largest ratio against every eavesdropper, which keeps Ω; None without a ratio above 1."""
    process: Process | None = field(default=None, repr=False)
    adversaries: tuple[Adversary, ...] = field(default=(), repr=False)
    """Whose errors `traces_at` gives, in the order of `eavesdroppers`."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Eavesdropper → strategy, for those whose error has no closed form, which cannot be designed for."""
    measuring: str = ""
    """The command that measures their errors at several μ_d; empty if there is no scenario."""

    @property
    def cost(self) -> float:
        """J(μ_d) / J(1), the factor by which secrecy raises the legitimate error: 1 for a lossless link, nan for a bad one."""
        return 1.0 if self.plain_trace == 0.0 else self.trace / self.plain_trace

    def traces_at(self, mu_d: float) -> dict[str, float]:
        """J_e of each eavesdropper at μ_d, and that of the legitimate estimator under its name; inf where unbounded."""
        assert self.process is not None  # noqa: S101 - `design` sets it
        theirs = {each.name: limit_trace(self.process, each.outcomes(mu_d)) for each in self.adversaries}
        return {LEGITIMATE: limit_trace(self.process, Outcomes.legitimate(self.mu, mu_d)), **theirs}

    @property
    def remark(self) -> str | None:
        """A sentence if no μ_d is admissible."""
        if self.admissible is not None:
            return None
        return (
            f"no μ_d is admissible: the legitimate link's quality μ = {self.mu:g} does not exceed "
            f"1 − ρ⁻² = {1.0 - self.rho**-2:.6g}, so its error is unbounded even if every packet is the state; "
            "a better link is needed"
        )

    @property
    def omission(self) -> str | None:
        """A sentence if eavesdroppers were left out."""
        if not self.left_out:
            return None
        who = ", ".join(f"{name} ({strategy})" for name, strategy in self.left_out.items())
        return (
            f"left out: {who}: no closed form of its error is known; a guarantee against a genie holds against every "
            f"eavesdropper{f', and this measures it: {self.measuring}' if self.measuring else ''}"
        )

    def as_dict(self) -> dict[str, Any]:
        """The JSON of `evedrop design`; inf is null; `minimum`, `choice` and `left_out` are present only if they have values."""
        legitimate: dict[str, Any] = {"bound": json_value(self.bound), "trace": json_value(self.trace)}
        if self.minimum is not None:
            legitimate["minimum"] = self.minimum
        entries = {
            "rho": self.rho,
            "legitimate": legitimate,
            "eavesdroppers": {name: against.as_dict() for name, against in self.eavesdroppers.items()},
        }
        if self.choice is not None:
            entries["choice"] = self.choice.as_dict()
        return {**entries, "left_out": self.left_out} if self.left_out else entries


def design(
    process: Process,
    mu: float,
    mu_d: float,
    eavesdroppers: Sequence[Adversary],
    slots: int,
    max_trace: float | None = None,
    min_ratio: float | None = None,
) -> Design:
    """Compute everything that the choice of μ_d depends on. `slots` is the run's length, `max_trace` is Ω.

    min_ratio: the least J_e / J against every eavesdropper, for which the cheapest μ_d is chosen.

    Raises UsageError if no μ_d can keep Ω, or has the ratio, or does both.

    Source: docs/mathematics/secrecy.md, design.
    """
    bound = legitimate_bound(process, mu)
    own = Outcomes.legitimate(mu, mu_d)
    ours = theoretical_traces(process, own, slots)
    trace = limit_trace(process, own)

    def against(adversary: Adversary) -> Against:
        theirs = theoretical_traces(process, adversary.outcomes(mu_d), slots)
        violated = _stretches(~(ours[1:] < theirs[1:]))
        held_from = violated[-1][1] + 1 if violated else 1
        its_trace = limit_trace(process, adversary.outcomes(mu_d))
        return Against(
            bound=adversary_bound(process, adversary),
            perfect=perfect_secrecy(process, mu, adversary),
            relative=relative_secrecy(process, mu, adversary),
            best_difference=best_difference(process, mu, adversary),
            best_ratio=best_ratio(process, mu, adversary),
            ratio=ratio_of(trace, its_trace),
            largest=largest_ratio(process, mu, [adversary]),
            trace=its_trace,
            difference=math.nan if math.isinf(trace) and math.isinf(its_trace) else its_trace - trace,
            violated=violated,
            relative_from=held_from if held_from < slots else None,
        )

    minimum = None if max_trace is None else least_state_probability(process, mu, max_trace)
    return Design(
        rho=process.spectral_radius,
        mu=mu,
        mu_d=mu_d,
        bound=bound,
        admissible=(bound, 1.0) if bound < 1.0 else None,
        minimum=minimum,
        trace=trace,
        plain_trace=limit_trace(process, Outcomes.plain(mu)),
        eavesdroppers={adversary.name: against(adversary) for adversary in eavesdroppers},
        choice=None if min_ratio is None else cheapest(process, mu, eavesdroppers, min_ratio, minimum, max_trace),
        suggestion=suggestion(process, mu, eavesdroppers, minimum) if min_ratio is None else None,
        process=process,
        adversaries=tuple(eavesdroppers),
    )


def perfect_secrecy(process: Process, mu: float, adversary: Adversary) -> Interval | None:
    """(lo, hi] of the μ_d with J bounded and J_e unbounded; None if there are none.

    hi = 1 itself is excluded where only innovations, which do not occur at μ_d = 1, make the error unbounded.

    Source: Theorem V.9, Corollaries V.3 and V.4.
    """
    low = legitimate_bound(process, mu)
    high = min(1.0, adversary_bound(process, adversary))
    return (low, high) if low < high else None


def relative_secrecy(process: Process, mu: float, adversary: Adversary) -> tuple[Interval, ...]:
    """The intervals of μ_d on which J < J_e ≤ ∞ with J bounded.

    Source: Theorem V.8 for μ_e ≤ μ; docs/mathematics/secrecy.md, design (for any μ_e).
    """
    from scipy.optimize import brentq  # noqa: PLC0415 - slow to import

    low = legitimate_bound(process, mu)
    if low >= 1.0:
        return ()

    def advantage(mu_d: float) -> float:
        return _advantage(*traces_of(process, mu, adversary, mu_d))

    poles = sorted({low, min(max(low, adversary_bound(process, adversary)), 1.0)})
    points = np.concatenate([points_between(a, b) for a, b in zip(poles, [*poles[1:], 1.0], strict=True) if a < b])
    signs = [np.sign(advantage(point)) for point in points]
    edges = [low]
    for (a, before), (b, after) in pairwise(zip(points, signs, strict=True)):
        if before * after < 0:
            edges.append(float(brentq(advantage, a, b, xtol=_XTOL)))
        elif before != after:
            edges.append(float(b if after == 0 else a))
    edges.append(1.0)
    edges = [low, *(b for a, b in pairwise(edges) if b - a > _EQUAL)]
    wins = np.array([advantage(0.5 * (a + b)) > 0.0 for a, b in pairwise(edges)], np.bool_)
    return tuple((edges[first - 1], edges[last]) for first, last in _stretches(wins))


def least_state_probability(process: Process, mu: float, max_trace: float) -> float:
    """μ_d_min, the root of J = Ω: the error stays below Ω, in the limit, for every larger μ_d. Ω is `max_trace`.

    It is 0 for a lossless link. Raises UsageError if not even μ_d = 1 keeps Ω.

    Source: docs/mathematics/secrecy.md, design; Lemma VI.1 (J falls).
    """
    from scipy.optimize import brentq  # noqa: PLC0415 - slow to import

    low = legitimate_bound(process, mu)
    best = limit_trace(process, Outcomes.plain(mu))
    if not low < 1.0 or not best < max_trace:
        least = f"{best:.6g}" if low < 1.0 and math.isfinite(best) else "unbounded"
        raise UsageError(
            f"no μ_d keeps the legitimate trace below {max_trace:g}: at μ_d = 1, where it is least, it is {least}; "
            "ask for a larger trace, or improve the legitimate link"
        )

    def excess(mu_d: float) -> float:
        trace = limit_trace(process, Outcomes.legitimate(mu, mu_d))
        return 1.0 if math.isinf(trace) else (trace - max_trace) / (trace + max_trace)

    start = next((mu_d for e in range(1, 16) if excess(mu_d := low + 10.0**-e * (1.0 - low)) > 0.0), None)
    return low if start is None else float(brentq(excess, start, 1.0, xtol=_XTOL))


def best_difference(process: Process, mu: float, adversary: Adversary) -> float | None:
    """μ_d* = argmax J_r over the admissible μ_d; None if J_r has no maximum or is nowhere positive.

    None for smart with μ_e ≤ μ, where J_r → ∞ at the lower end.

    Source: docs/mathematics/secrecy.md, design.
    """
    return _argmax(process, mu, adversary, lambda ours, theirs: theirs - ours)


def best_ratio(process: Process, mu: float, adversary: Adversary) -> float | None:
    """Argmax of J_r / J over the admissible μ_d; None if it has no maximum or J_r is nowhere positive.

    Source: docs/mathematics/secrecy.md, design.
    """
    return _argmax(process, mu, adversary, lambda ours, theirs: (theirs - ours) / ours if ours else math.inf)


def _argmax(process: Process, mu: float, adversary: Adversary, gain: Callable[[float, float], float]) -> float | None:
    from scipy.optimize import minimize_scalar  # noqa: PLC0415 - slow to import

    low = legitimate_bound(process, mu)
    if low >= 1.0 or adversary_bound(process, adversary) > low + _EQUAL:
        return None

    def loss(mu_d: float) -> float:
        return -gain(*traces_of(process, mu, adversary, mu_d))

    points = points_between(low, 1.0)
    points = points[points - low > 0.1 * ATTAINED * (1.0 - low)]
    losses = np.array([loss(point) for point in points])
    lowest = int(np.argmin(losses))
    if not np.all(np.isfinite(losses)) or losses[lowest] >= 0.0 or lowest == 0:
        return None
    neighbours = points[lowest - 1 : lowest + 2]
    optimum = minimize_scalar(loss, bounds=(neighbours[0], neighbours[-1]), method="bounded", options={"xatol": 1e-10})
    if lowest == len(points) - 1 and losses[lowest] <= optimum.fun:
        return 1.0
    mu_d = float(optimum.x)
    return mu_d if mu_d - low > ATTAINED * (1.0 - low) else None


def _advantage(ours: float, theirs: float) -> float:
    """(J_e − J)/(J_e + J), −1 … 1, and 0 where the two are equal to rounding; −1 if J is unbounded."""
    if math.isinf(ours):
        return -1.0
    if math.isinf(theirs):
        return 1.0
    relative = (theirs - ours) / (theirs + ours) if theirs + ours else 0.0
    return relative if abs(relative) > _EQUAL else 0.0


def _stretches(flags: Flags) -> tuple[tuple[int, int], ...]:
    """(first, last) of each stretch of true flags; the first flag is that of slot 1."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))) + 1
    return tuple((int(first), int(end) - 1) for first, end in edges.reshape(-1, 2))
