"""A model that may have produced a recording, and how well it explains it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

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
        found = []
        for name, value in self.spec.items():
            if name != "model":
                interval = self.intervals.get(name)
                found.append(
                    f"{name} = {value:.4g}" + (f" ({interval[0]:.4g} … {interval[1]:.4g})" if interval else "")
                )
        return ", ".join(found)


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
