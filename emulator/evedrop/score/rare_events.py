"""What rare events carry of a receiver's expected error, and the z-score of an error that they do not carry.

Source: docs/mathematics/verdicts.md, rare events and z-scores.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from evedrop.errors import UsageError
from evedrop.model.metrics.standard_error import mean_skewness, z_of
from evedrop.model.process import Floats
from evedrop.scenario.recorded import recorded
from evedrop.scenario.theory import Alike, Expectation, expectations_of
from evedrop.score.summary import RARE_FRACTION, RareEvents
from evedrop.score.sums import Tally

_LARGEST_SKEWNESS = 0.3
"""Of a mean whose rare events are unknown. Beyond it the correction of a z-score is too small."""


def rare_events_of(expected: Expectation, tally: Tally) -> RareEvents | None:
    """The rare events of a receiver over the slots so far; None if they are unknown."""
    return _rare_events(expected.alike, tally.done, tally.trials) if tally.alike else None


@lru_cache(maxsize=64)
def _rare_events(expected: Alike, slots: int, trials: int) -> RareEvents | None:
    streaks = expected.expectation.streaks(slots)
    return None if streaks is None else RareEvents(streaks.fraction(trials), streaks.trials_for(RARE_FRACTION))


def recorded_rare_errors(folder: Path, slots: int, trials: int) -> Mapping[str, Floats]:
    """Receiver → what rare events carry of its expected error in each slot, for the scenario in a results folder.

    Without receivers for which that is unknown; empty if the scenario cannot be read, or names classes that are not built in.
    """
    try:
        of = recorded(folder)
        rare = {name: expected.rare(slots, trials) for name, expected in expectations_of(of.scenario).items()}
    except UsageError:
        return {}
    return {name: carried for name, carried in rare.items() if carried is not None} if of.complete else {}


def sound_errors(standard_errors: Floats, rare: Floats | None) -> Floats:
    """The standard errors of slots, NaN where rare events carry more than two of them: there the mean is probably too small.

    rare: what rare events carry of the expected error in these slots; None if that is unknown.
    """
    return standard_errors if rare is None else np.where(rare > 2.0 * standard_errors, np.nan, standard_errors)


def z_of_error(
    of_trials: Floats | None, theory: float | None, expected: Expectation, slots: int, rare: RareEvents | None
) -> float | None:
    """The z-score of a mean error over slots 0 … slots−1, from the mean error of every trial, (R,), and theory's.

    rare: the receiver's rare events, None if they are unknown: then the trials must not be skewed too much. None where rare
    events carry more than RARE_FRACTION of the expectation, where the variance is infinite, and as from `z_of`.
    """
    if theory is None or expected.infinite_variance or (rare is not None and rare.fraction > RARE_FRACTION):
        return None
    if rare is None and of_trials is not None and abs(mean_skewness(of_trials)) > _LARGEST_SKEWNESS:
        return None
    if of_trials is None or not slots or expected.is_rounding(max(theory, float(np.mean(of_trials))), slots):
        return None
    return z_of(of_trials, theory)
