"""The colours of Evedrop, by meaning: view, figures and comparisons take theirs from here.

The colours of text and grids, and those that a figure takes from the paper that it repeats, are elsewhere.

Two colours of one panel differ by at least 15 (CIEDE2000) for full colour vision, deuteranopia, protanopia and tritanopia;
the colours of a lane differ in brightness, too. tests/show/view/test_palette.py checks both.
"""

from __future__ import annotations

Colour = tuple[int, int, int]

GROUND: Colour = (16, 18, 22)
"""The background of the state plane, which is dark in both themes."""
TRUTH: Colour = (226, 228, 234)
"""The truth on `GROUND`."""
TRUTH_CURVE: Colour = (151, 154, 159)
"""The truth on the background of the theme: no curve is white or black."""

RECEIVERS: tuple[Colour, ...] = (
    (100, 199, 149),  # mint
    (244, 182, 33),  # yellow
    (144, 4, 250),  # violet
    (207, 2, 26),  # red
    (186, 110, 223),  # lilac
    (65, 144, 97),  # green
    (146, 73, 136),  # plum
)
"""The legitimate estimator first, then the eavesdroppers in the scenario's order; the same in the view and in sweeps."""

PLANT: tuple[Colour, ...] = (*RECEIVERS[1:], TRUTH_CURVE)
"""Disturbances and inputs of a closed loop, and other curves of its plant, in order."""

STATE: Colour = (83, 148, 249)  # blue
DECODED: Colour = (36, 112, 99)  # green
DISCARDED: Colour = (91, 60, 106)  # purple
MISLED: Colour = (246, 176, 40)  # amber
DROPPED: Colour = (209, 70, 34)  # red
SILENT: Colour = (34, 37, 44)  # dark
LANES: tuple[Colour, ...] = (STATE, DECODED, DISCARDED, MISLED, DROPPED, SILENT)
"""The outcomes of a packet."""

KNOWLEDGE: tuple[Colour, ...] = (DECODED, MISLED, DROPPED)
"""What a receiver knows: synchronised, uncertain, overconfident."""

WIRE_LANES: tuple[Colour, ...] = (STATE, DECODED, DISCARDED, MISLED, DROPPED, SILENT, TRUTH)
"""The fates of the messages of a wire's link; white is cut."""

DROPPED_TEXT: Colour = (230, 78, 44)
"""`DROPPED` for letters on the background of the theme, which need to be brighter than a lane."""
WIRE_TEXTS: tuple[Colour, ...] = (STATE, MISLED, DROPPED_TEXT, TRUTH_CURVE, TRUTH)
"""The links of a wire's graph by the fraction that they lost, those without messages, and the sides."""

SYNCHRONISED_TEXT: Colour = (80, 255, 180)
"""`DECODED` for letters on the background of the theme."""
RUN_TEXTS: tuple[Colour, ...] = (TRUTH, TRUTH_CURVE, STATE, MISLED, DROPPED_TEXT, SYNCHRONISED_TEXT)
"""The nodes of a run's graph: packets by their fate, and receivers by what they know."""

BLUE: Colour = (0, 114, 178)
RED: Colour = (193, 39, 45)
GREEN: Colour = (79, 191, 139)
ORANGE: Colour = (217, 130, 0)
GREY: Colour = (95, 99, 104)
FIGURES: tuple[Colour, ...] = (BLUE, RED, GREEN, ORANGE, GREY)
"""Curves of the figures of papers, on white."""

PERFECT: Colour = (31, 111, 178)
RELATIVE: Colour = (169, 205, 234)
UNDECIDED: Colour = (241, 239, 232)
BROKEN: Colour = (232, 131, 58)
VERDICTS: tuple[Colour, ...] = (PERFECT, RELATIVE, UNDECIDED, BROKEN)
"""The backgrounds of verdicts on secrecy in a comparison."""

PANELS: dict[str, tuple[Colour, ...]] = {
    "state plane": (*RECEIVERS, TRUTH, GROUND),
    "curves": (*RECEIVERS, TRUTH_CURVE),
    "plant": PLANT,
    "lanes": LANES,
    "who knows what": KNOWLEDGE,
    "lanes of a wire": WIRE_LANES,
    "graph of a wire": WIRE_TEXTS,
    "graph of a run": RUN_TEXTS,
    "figures": FIGURES,
    "verdicts": VERDICTS,
}
"""The colours that share a panel."""


def colour(i: int) -> Colour:
    """Colour of the i-th receiver; the legitimate estimator is 0. Repeats after seven."""
    return RECEIVERS[i % len(RECEIVERS)]


def dim(of: Colour, fraction: float) -> Colour:
    """The same colour at a fraction of its brightness."""
    r, g, b = of
    return int(r * fraction), int(g * fraction), int(b * fraction)


def hexadecimal(of: Colour) -> str:
    """The colour as matplotlib and HTML write it, such as `#64c795`."""
    return "#{:02x}{:02x}{:02x}".format(*of)
