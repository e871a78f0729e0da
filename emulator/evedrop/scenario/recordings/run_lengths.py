"""The goodness of a link's fit: the lengths of bursts and gaps in the recording, and under the model.

Source: docs/mathematics/links.md, estimating a link.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags

_BINS, _LEAST_EXPECTED, FEWEST_RUNS = 20, 5.0, 30


def lengths_of(within: Flags) -> NDArray[np.intp]:
    """Lengths of the runs that begin and end within the recording, (runs,)."""
    edges = np.flatnonzero(within[1:] != within[:-1]) + 1
    lengths = np.diff(edges)
    return lengths[within[edges[:-1]]]


@dataclass(frozen=True)
class RunLengthDistribution:
    """How long the runs of one outcome are: for a chain with transitions (states, states), stationary distribution (states,)."""

    transitions: Floats
    stationary: Floats
    chance: Floats
    """Probability of the outcome in each state, (states,)."""

    @classmethod
    def of(cls, spec: Mapping[str, Any], lost: bool) -> RunLengthDistribution:
        """The distribution of the bursts (lost) or gaps of a fitted loss model."""
        if spec["model"] == "bernoulli":
            T, stationary, loss = np.ones((1, 1)), np.ones(1), np.array([1.0 - spec["quality"]])
        else:
            p, r = spec["p"], spec["r"]
            T, stationary = np.array([[1.0 - p, p], [r, 1.0 - r]]), np.array([r, p]) / (p + r)
            loss = np.array([spec.get("good", 0.0), spec.get("bad", 1.0)])
        return cls(T, stationary, loss if lost else 1.0 - loss)

    @property
    def _opening(self) -> Floats:
        """The states in which a run begins, (states,)."""
        opening: Floats = ((self.stationary * (1.0 - self.chance)) @ self.transitions) * self.chance
        opening /= opening.sum()
        return opening

    @property
    def mean(self) -> float:
        """Mean length."""
        stay = self.transitions * self.chance
        return float(
            self._opening @ np.linalg.solve(np.eye(len(self.stationary)) - stay, np.ones(len(self.stationary)))
        )

    def longer(self, most: int) -> Floats:
        """P(length > l) for l = 0 … most, (most + 1,)."""
        stay, at = (self.transitions * self.chance).tolist(), self._opening.tolist()
        probabilities = []
        for _ in range(most + 1):
            probabilities.append(sum_in_order(at))
            at = [sum_in_order(a * row[j] for a, row in zip(at, stay, strict=True)) for j in range(len(at))]
        return np.array(probabilities)


def p_value(lengths: NDArray[np.intp], distribution: RunLengthDistribution, parameters: int) -> float | None:
    """Probability of runs at least as unlikely under the distribution, by Pearson's test. None for too few runs.

    parameters: the number of parameters of the distribution that were estimated from the recording.
    """
    if len(lengths) < FEWEST_RUNS:
        return None
    longer = distribution.longer(int(lengths.max()) + 1)
    least = max(_LEAST_EXPECTED, len(lengths) / _BINS)
    bounds, left = [0], float(longer[0])
    for length in range(1, len(longer)):
        if (left - longer[length]) * len(lengths) >= least and longer[length] * len(lengths) >= least:
            bounds.append(length)
            left = float(longer[length])
    if len(bounds) < 2:
        return None
    expected = -np.diff([*longer[bounds], 0.0]) * len(lengths)
    counts = np.bincount(np.searchsorted(bounds, lengths, side="left") - 1, minlength=len(bounds))
    statistic = float(((counts - expected) ** 2 / expected).sum())
    from scipy.stats import chi2  # noqa: PLC0415 - takes a second, which reading recordings does not need

    return float(chi2.sf(statistic, max(1, len(bounds) - 1 - parameters)))


@dataclass(frozen=True)
class RunLengths:
    """Bursts or gaps: runs of lost or delivered packets that begin and end within the recording."""

    count: int
    mean: float | None
    """Slots, observed; None if there are no runs."""
    fitted: float
    """Slots, under the chosen model."""
    p_value: float | None
    """None: too few runs for a test."""
