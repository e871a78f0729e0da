"""The logarithmic axis of errors: one rule for the view, the figures from Python, and the report.

A receiver that has just decoded a state has no error but that of rounding, such as 1e-30. Drawn as it is, it would leave a
hundredth of the axis for the errors that matter.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evedrop.model.process import Floats

_ROOM = 1.6  # the factor by which the axis goes beyond the errors
_MOST = 1e30  # times the lowest value shown is the highest


def error_floor(noise: float, trials: int) -> float:
    """The least squared error that is drawn; lesser ones are drawn there. 0 if the noise is not known (0).

    noise: tr Q, the squared error of one step, which a trial adds to a mean over several when it loses its last packet. The
    floor is the power of ten below tr Q / trials, and a tenth of it.
    """
    return 10.0 ** (math.floor(math.log10(noise / trials)) - 1) if noise > 0.0 else 0.0


def mean_band(means: Floats, standard_errors: Floats, trials: Floats | int) -> tuple[Floats, Floats]:
    """The ends of the 95 % intervals of means over trials: Student's, of logarithms, so they stay above 0 if the means do."""
    reach: Floats | float = math.nan  # a single trial has no standard error
    if np.max(trials) > 1:
        from scipy.special import stdtrit  # noqa: PLC0415 - a tenth of the memory of a process that draws one trial

        reach = np.asarray(stdtrit(np.maximum(trials, 2) - 1, 0.975))
    with np.errstate(all="ignore"):
        factor = np.where(means == 0.0, 1.0, np.exp(reach * standard_errors / means))
        return means / factor, means * factor


@dataclass(frozen=True)
class ErrorAxis:
    """The ends of a logarithmic axis."""

    low: float
    high: float
    below: bool
    """Whether values lie below it."""

    @property
    def words(self) -> str:
        """The end of a caption, which says that values lie below the axis; empty if none does."""
        return f"; values below {self.low:.3g} lie on the lower edge" if self.below else ""

    @classmethod
    def of(cls, heights: Sequence[Floats], floor: float) -> ErrorAxis | None:
        """The axis on which to draw these values; None if none of them is positive."""
        finite = np.concatenate([np.empty(0), *(part[np.isfinite(part)] for part in heights)])
        shown = np.maximum(finite, floor)
        shown = shown[shown > 0.0]
        if not shown.size:
            return None
        high = float(shown.max())
        low = max(float(shown.min()), high / _MOST)
        below = bool((finite < low).any())
        most = min(max(high * _ROOM, 10.0 * floor), sys.float_info.max)
        return cls(low if below else low / _ROOM, most, below)

    def inside(self, values: Floats) -> Floats:
        """The values; those beyond the ends of the axis lie on its edges, and those that are not finite are NaN."""
        return np.clip(np.where(np.isfinite(values), values, np.nan), self.low, self.high)
