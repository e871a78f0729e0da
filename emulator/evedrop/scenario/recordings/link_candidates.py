"""The loss models that may have produced a link's recording, each with its most likely parameters.

Source: docs/mathematics/links.md, estimating a link.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from evedrop.scenario.recordings.link_recording import Outcomes
from evedrop.scenario.recordings.two_states import TwoStates, most_likely

Interval = tuple[float, float]
_NORMAL = 1.959963984540054  # for 95 %


@dataclass(frozen=True)
class Candidate:
    """One model with its most likely parameters."""

    name: str
    exact: Mapping[str, Any]
    """`model`, and the parameters, not rounded."""
    log_likelihood: float
    parameters: int
    """The number of parameters that were estimated."""
    intervals: Mapping[str, Interval] = field(default_factory=dict)
    """95 % confidence intervals, for parameters that have a simple one."""

    @property
    def spec(self) -> dict[str, Any]:
        """The model as a scenario describes it: `model`, and the parameters, rounded."""
        return {name: value if name == "model" else _rounded(name, value) for name, value in self.exact.items()}

    def bic(self, count: int) -> float:
        """Schwarz's criterion for `count` observations; smaller is better."""
        return -2.0 * self.log_likelihood + self.parameters * math.log(count)

    def as_dict(self, count: int) -> dict[str, Any]:
        """The candidate as JSON values."""
        return {
            "name": self.name,
            "spec": self.spec,
            "log_likelihood": self.log_likelihood if math.isfinite(self.log_likelihood) else None,
            "bic": self.bic(count) if math.isfinite(self.log_likelihood) else None,
            "intervals": {name: list(interval) for name, interval in self.intervals.items()},
        }

    @property
    def text(self) -> str:
        """The parameters, with their intervals."""
        parts = []
        for name, value in self.spec.items():
            if name != "model":
                bounds = [f"{_rounded(name, bound):.10g}" for bound in self.intervals.get(name, ())]
                parts.append(f"{name} = {value:.10g}" + (f" ({' … '.join(bounds)})" if bounds else ""))
        return ", ".join(parts)


def wilson(hits: int, count: int) -> Interval:
    """The 95 % confidence interval of a probability, from the number of hits in `count` trials.

    Source: Wilson (1927).
    """
    square = _NORMAL * _NORMAL
    middle = (hits + 0.5 * square) / (count + square)
    half = _NORMAL / (count + square) * math.sqrt(hits * (count - hits) / count + 0.25 * square)
    return max(0.0, middle - half), min(1.0, middle + half)


def normal_interval(value: float, error: float) -> Interval:
    """The 95 % confidence interval of an estimate with this standard error."""
    return value - _NORMAL * error, value + _NORMAL * error


def rounded(value: float) -> float:
    """Rounded to four digits, which is the precision that recordings allow."""
    return float(f"{value:.4g}")


def _rounded(parameter: str, value: float) -> float:
    """The same for a parameter of a model; of a quality close to 1, the rest to 1, the loss, has four digits."""
    loss = 1.0 - value
    if parameter != "quality" or not 0.0 < loss < 0.1:
        return rounded(value)
    return round(value, 3 - math.floor(math.log10(loss)))


def bernoulli(outcomes: Outcomes) -> Candidate:
    """The same quality for every packet."""
    count, hits = len(outcomes), int(outcomes.sum())
    quality = hits / count
    likelihood = hits * math.log(quality) + (count - hits) * math.log1p(-quality)
    return Candidate(
        "bernoulli",
        {"model": "bernoulli", "quality": quality},
        likelihood,
        1,
        {"quality": wilson(hits, count)},
    )


def gilbert(outcomes: Outcomes) -> Candidate:
    """Gilbert's model: good loses nothing and bad everything, so outcomes are states, and their changes are counted."""
    before, after = outcomes[:-1] == 0, outcomes[1:] == 0
    from_bad = int(before.sum())
    from_good = len(before) - from_bad
    worse, better = int((~before & after).sum()), int((before & ~after).sum())
    # A recording that ends or begins in its only burst lacks one of the changes, which then counts as half a change.
    p, r = (worse or 0.5) / max(1, from_good), (better or 0.5) / max(1, from_bad)
    model = TwoStates(min(p, 1.0), min(r, 1.0), 0.0, 1.0)
    return Candidate(
        "gilbert",
        {"model": "gilbert-elliott", "p": model.p, "r": model.r},
        model.log_likelihood_of_states(outcomes == 0),
        2,
        {"p": wilson(worse, max(1, from_good)), "r": wilson(better, max(1, from_bad))},
    )


def gilbert_elliott(outcomes: Outcomes) -> Candidate:
    """Gilbert and Elliott's model with all four parameters, by expectation-maximisation."""
    model, likelihood = most_likely(outcomes, _starts(outcomes))
    return Candidate("gilbert-elliott", {"model": "gilbert-elliott", **vars(model)}, likelihood, 4)


def _starts(outcomes: Outcomes) -> list[TwoStates]:
    """Starting points: Gilbert's own solution, softened, and rare bad or good regimes of tens to thousands of slots."""
    loss = 1.0 - float(outcomes.mean())
    own = gilbert(outcomes).spec
    mild, harsh = 0.5 * loss, min(0.95, 0.5 + 0.5 * loss)
    starts = [
        TwoStates(own["p"], own["r"], 0.1 * loss, 0.95),
        TwoStates(0.5 * own["p"], 0.5 * own["r"], mild, harsh),
    ]
    for slots in (20.0, 200.0, 2000.0):
        if slots * 4 < len(outcomes):
            starts.append(TwoStates(0.5 / slots, 1.0 / slots, 0.3 * loss, min(0.95, 2.5 * loss)))
            starts.append(TwoStates(1.0 / slots, 0.5 / slots, 0.1 * loss, min(0.95, 1.3 * loss)))
    return [
        TwoStates(*(float(np.clip(value, 1e-4, 0.999)) for value in vars(two_states).values())) for two_states in starts
    ]
