"""Delay models for a recording of delays, each with its most likely parameters."""

from __future__ import annotations

import math

import numpy as np

from evedrop.fitting.candidate import Candidate, normal_interval, rounded
from evedrop.model.process import Floats


def delay_candidates(delays: Floats) -> list[Candidate]:
    """Models for delays in slots, (packets,): constant if all are equal, otherwise normal, or Pareto if none is 0."""
    count, least, mean = len(delays), float(delays.min()), float(delays.mean())
    if least == float(delays.max()):
        return [Candidate("constant", {"model": "constant", "value": rounded(least)}, 0.0, 1)]
    deviation = float(delays.std())
    spread = -0.5 * count * (math.log(2.0 * math.pi * deviation * deviation) + 1.0)
    found = [
        Candidate(
            "normal",
            {"model": "normal", "mean": rounded(mean), "deviation": rounded(deviation)},
            spread,
            2,
            {
                "mean": normal_interval(mean, deviation / math.sqrt(count)),
                "deviation": normal_interval(deviation, deviation / math.sqrt(2.0 * count)),
            },
        )
    ]
    if least > 0.0:
        logs = float(np.log(delays / least).sum())
        shape = count / logs
        likelihood = count * (math.log(shape) - math.log(least)) - (shape + 1.0) * logs
        found.append(
            Candidate(
                "pareto",
                {"model": "pareto", "least": rounded(least), "shape": rounded(shape)},
                likelihood,
                2,
                {"shape": normal_interval(shape, shape / math.sqrt(count))},
            )
        )
    return found
