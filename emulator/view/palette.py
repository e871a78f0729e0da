"""The colours of the view, distinct for the colour-blind, and on dark and light backgrounds: no curve is white or black."""

from __future__ import annotations

Colour = tuple[int, int, int]

GROUND: Colour = (16, 18, 22)
"""The background of the state plane, which is dark in both themes."""
TRUTH: Colour = (226, 228, 234)
"""The truth on `GROUND`."""
TRUTH_CURVE: Colour = (138, 144, 156)
"""The truth on the background of the theme."""

_RECEIVERS: tuple[Colour, ...] = (
    (45, 190, 165),  # teal
    (245, 130, 70),  # orange
    (175, 130, 250),  # violet
    (80, 170, 245),  # sky
    (222, 184, 48),  # yellow
    (236, 106, 168),  # pink
    (142, 168, 66),  # olive
)


def colour(i: int) -> Colour:
    """Colour of the i-th receiver; the legitimate estimator is 0. Repeats after seven."""
    return _RECEIVERS[i % len(_RECEIVERS)]


def dim(of: Colour, share: float) -> Colour:
    """The same colour at a share of its brightness."""
    r, g, b = of
    return int(r * share), int(g * share), int(b * share)
