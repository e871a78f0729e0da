"""The standard error of a mean over trials, and its distance from theory in standard errors.

Source: docs/results.md, standard errors.
"""

from __future__ import annotations

import math

import numpy as np

from evedrop.model.process import Floats


def standard_error(of_trials: Floats | None) -> float | None:
    """The standard error of the mean of independent trials, (R,): their standard deviation (R − 1 degrees of freedom) over √R.

    None for fewer than two trials, because the slots of a trial depend on each other; None for trials that are not finite.
    """
    if of_trials is None or len(of_trials) < 2 or not np.isfinite(of_trials).all():
        return None
    with np.errstate(over="ignore"):
        found = float(np.std(of_trials, ddof=1)) / math.sqrt(len(of_trials))
    return found if math.isfinite(found) else None


def ratio_error(over: Floats, under: Floats) -> float | None:
    """The standard error of the ratio of two means over the same trials, (R,) each, to first order; None as above.

    Source: docs/results.md, standard errors.
    """
    mean = float(np.mean(under))
    if not mean > 0.0 or not math.isfinite(mean):
        return None
    return standard_error((over - float(np.mean(over)) / mean * under) / mean)


def z_of(found: float | None, expected: float | None, error: float | None) -> float | None:
    """How many standard errors a figure is above its expectation by theory; None without theory or a standard error above 0."""
    if found is None or expected is None or not error or not math.isfinite(found - expected):
        return None
    return (found - expected) / error
