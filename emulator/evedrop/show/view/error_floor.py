"""How far down errors are drawn on a logarithmic axis: one rule for the view, the figures from Python, and the report.

A receiver that has just decoded a state has no error but that of rounding, such as 1e-30. Drawn as it is, it would leave a
hundredth of the axis for the errors that matter.
"""

from __future__ import annotations

import math


def error_floor(noise: float, trials: int) -> float:
    """The least squared error that is drawn; lesser ones are drawn there. 0 if the noise is not known (0).

    noise: tr Q, the squared error of one step, which a trial adds to a mean over several when it loses its last packet. The
    floor is the power of ten below tr Q / trials, and a tenth of it.
    """
    return 10.0 ** (math.floor(math.log10(noise / trials)) - 1) if noise > 0.0 else 0.0


def floor_words(floor: float) -> str:
    """What a caption says if a value is below the floor."""
    return f"values below {floor:g} lie on the lower edge"
