"""The models that may have produced a recording, fitted to it, and how well each explains it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from evedrop.model.process import Floats
from evedrop.scenario.fitting.hidden import TwoStates, most_likely
from evedrop.scenario.recordings.link_recording import Outcomes

Interval = tuple[float, float]
_NORMAL = 1.959963984540054  # for 95 %


@dataclass(frozen=True)
class Candidate:
    """One model with its most likely parameters."""

    name: str
    spec: Mapping[str, Any]
    """The model as a scenario describes it: `model`, and the parameters."""
    log_likelihood: float
    parameters: int
    """The number of parameters that were estimated."""
    intervals: Mapping[str, Interval] = field(default_factory=dict)
    """95 % confidence intervals, for parameters that have a simple one."""

    def bic(self, count: int) -> float:
        """Schwarz's criterion for `count` observations; smaller is better."""
        return -2.0 * self.log_likelihood + self.parameters * math.log(count)

    def as_dict(self, count: int) -> dict[str, Any]:
        """The candidate as JSON values."""
        return {
            "name": self.name,
            "spec": dict(self.spec),
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
                interval = self.intervals.get(name)
                parts.append(
                    f"{name} = {value:.4g}" + (f" ({interval[0]:.4g} … {interval[1]:.4g})" if interval else "")
                )
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


def delay_candidates(delays: Floats) -> list[Candidate]:
    """Models for delays in slots, (packets,): constant if all are equal, otherwise normal, or Pareto if none is 0."""
    count, least, mean = len(delays), float(delays.min()), float(delays.mean())
    if least == float(delays.max()):
        return [Candidate("constant", {"model": "constant", "value": rounded(least)}, 0.0, 1)]
    standard_deviation = float(delays.std())
    spread = -0.5 * count * (math.log(2.0 * math.pi * standard_deviation * standard_deviation) + 1.0)
    candidates = [
        Candidate(
            "normal",
            {"model": "normal", "mean": rounded(mean), "standard_deviation": rounded(standard_deviation)},
            spread,
            2,
            {
                "mean": normal_interval(mean, standard_deviation / math.sqrt(count)),
                "standard_deviation": normal_interval(standard_deviation, standard_deviation / math.sqrt(2.0 * count)),
            },
        )
    ]
    if least > 0.0:
        logs = float(np.log(delays / least).sum())
        shape = count / logs
        likelihood = count * (math.log(shape) - math.log(least)) - (shape + 1.0) * logs
        candidates.append(
            Candidate(
                "pareto",
                {"model": "pareto", "least": rounded(least), "shape": rounded(shape)},
                likelihood,
                2,
                {"shape": normal_interval(shape, shape / math.sqrt(count))},
            )
        )
    return candidates


def bernoulli(outcomes: Outcomes) -> Candidate:
    """The same quality for every packet."""
    count, hits = len(outcomes), int(outcomes.sum())
    quality = hits / count
    likelihood = hits * math.log(quality) + (count - hits) * math.log1p(-quality)
    return Candidate(
        "bernoulli",
        {"model": "bernoulli", "quality": rounded(quality)},
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
        {"model": "gilbert-elliott", "p": rounded(model.p), "r": rounded(model.r)},
        model.log_likelihood_of_states(outcomes == 0),
        2,
        {"p": wilson(worse, max(1, from_good)), "r": wilson(better, max(1, from_bad))},
    )


def gilbert_elliott(outcomes: Outcomes) -> Candidate:
    """Gilbert and Elliott's model with all four parameters, by expectation-maximisation."""
    model, likelihood = most_likely(outcomes, _starts(outcomes))
    spec = {"model": "gilbert-elliott", "p": rounded(model.p), "r": rounded(model.r)}
    spec |= {"good": rounded(model.good), "bad": rounded(model.bad)}
    return Candidate("gilbert-elliott", spec, likelihood, 4)


def _starts(outcomes: Outcomes) -> list[TwoStates]:
    """Starting points: Gilbert's own solution, softened, and regimes of tens, hundreds and thousands of slots."""
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
    return [
        TwoStates(*(float(np.clip(value, 1e-4, 0.999)) for value in vars(two_states).values())) for two_states in starts
    ]
