"""The colours of Evedrop, by meaning: view, plots, figures, comparisons and reports take theirs from here.

A hue is an identity. Green is the legitimate estimator's, and each strategy of an eavesdropper has a colour of its own, the same
everywhere. Vermilion means broken secrecy, and nothing else. What became of a packet, and everything that is not a receiver, has
tones with almost no hue, which differ in brightness.

tests/show/view/test_palette.py states how much colours that share a panel differ, for full colour vision and for protanopia,
deuteranopia and tritanopia, and how well letters can be read. The colours of text and grids are elsewhere.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from functools import cache

from evedrop.names import LEGITIMATE as _LEGITIMATE_NAME
from evedrop.score.verdict import SecrecyOutcome

Colour = tuple[int, int, int]

GROUND: Colour = (16, 18, 22)
"""The background of the panels whose colours would be illegible on white: it is dark in both themes."""
TRUTH: Colour = (226, 228, 234)
"""The truth on `GROUND`."""
LABEL: Colour = (255, 255, 255)
"""Letters in labels of two-dimensional panels, whose ground is nearly black, or (120, 121, 123) in the viewer's light theme.

White has the greatest contrast with the latter, 4.36, of all colours that can be read on the former.
"""
TRUTH_CURVE: Colour = (151, 154, 159)
"""The truth on the background of a page: no curve is white or black."""

LEGITIMATE: Colour = (169, 236, 182)  # green
STRATEGIES: Mapping[str, Colour] = {
    "naive": (245, 218, 27),  # yellow
    "suspicious": (117, 52, 245),  # violet
    "smart": (108, 161, 248),  # blue
    "bayesian": (106, 126, 190),  # indigo
    "genie": (249, 144, 196),  # pink
    "likelihood": (171, 79, 4),  # rust
    "constant": (162, 104, 53),  # ochre
    "learning-em": (209, 196, 118),  # straw
    "power-test": (110, 195, 235),  # sky blue
    "clear-states": (186, 128, 180),  # mauve
    "colluding": (183, 78, 116),  # raspberry
    "reference": (133, 94, 249),  # lavender
    "replay-informed": (192, 8, 127),  # magenta
    "selective": (142, 113, 80),  # umber
    "tracker": (141, 96, 89),  # chestnut
    "learning-particle": (228, 179, 193),  # rose
}
"""The eavesdroppers' strategies that are built in."""
RESERVE: tuple[Colour, ...] = (
    (230, 133, 74),
    (139, 144, 211),
    (163, 107, 158),
    (189, 106, 7),
    (127, 76, 196),
)
"""For strategies of packages and users, and for the links of a wire."""

ALARM: Colour = (255, 101, 64)
"""Broken secrecy."""

# Outcomes of a packet, brighter where more was used, and fates of a wire's messages, brighter where they are worse.
SILENT: Colour = (25, 29, 33)
DROPPED: Colour = (53, 74, 95)  # slate
DISCARDED: Colour = (122, 91, 78)  # brown
DECODED: Colour = (179, 200, 223)  # light blue-grey
MISLED: Colour = (184, 156, 124)  # sand
STATE: Colour = (242, 237, 222)  # ivory
STEEL: Colour = (106, 131, 157)

PLANT: tuple[Colour, ...] = (STATE, MISLED, DECODED, STEEL, DISCARDED)
"""Disturbances and inputs of a closed loop, and other curves of its plant, in order, on `GROUND`."""

SYNCHRONISED: Colour = (64, 146, 92)  # darker green
"""The legitimate estimator, where it knows the state."""
KNOWLEDGE: tuple[Colour, ...] = (SYNCHRONISED, DECODED, DROPPED)
"""What the legitimate estimator knows: synchronised, uncertain, overconfident."""
SPIED: tuple[Colour, ...] = (ALARM, DECODED, DROPPED)
"""What an eavesdropper knows, in the same order."""

BLUE: Colour = (0, 114, 178)
RED: Colour = (193, 39, 45)
"""Good and bad outcomes of a page, such as of an expectation."""

SLATE: Colour = (49, 70, 91)
OCHRE: Colour = (164, 120, 66)
GREY: Colour = (125, 130, 136)
FIGURES: tuple[Colour, ...] = (SLATE, OCHRE, GREY)
"""Curves of figures that are not those of receivers, on white."""

VERDICTS: Mapping[SecrecyOutcome, Colour] = {
    SecrecyOutcome.PERFECT: (31, 111, 178),
    SecrecyOutcome.RELATIVE: (169, 205, 234),
    SecrecyOutcome.OPEN: (241, 239, 232),
    SecrecyOutcome.BROKEN: ALARM,
}
"""The backgrounds of verdicts on secrecy in a comparison."""


def identities(strategies: Mapping[str, str]) -> dict[str, Colour]:
    """Receiver → its colour on a dark ground; strategies: of each receiver, in the order of the scenario.

    The legitimate estimator's is green, whatever its scheme is. The first receiver with a strategy has the strategy's own colour,
    the next ones shades of it.
    """
    taken = {strategy: STRATEGIES[strategy] for strategy in strategies.values() if strategy in STRATEGIES}
    counts, seen = Counter(strategies.values()), Counter[str]()
    colours = {}
    for name, strategy in strategies.items():
        if name == _LEGITIMATE_NAME:
            colours[name] = LEGITIMATE
            continue
        if strategy not in taken:
            taken[strategy] = _reserved(strategy, taken.values())
        colours[name] = shade(taken[strategy], seen[strategy], counts[strategy])
        seen[strategy] += 1
    return colours


def _reserved(strategy: str, taken: Iterable[Colour]) -> Colour:
    """A colour for a strategy that is not built in: by its name, and another one only if that is taken."""
    first, used = zlib.crc32(strategy.encode()), {*taken}
    order = [RESERVE[(first + i) % len(RESERVE)] for i in range(len(RESERVE))]
    return next((colour for colour in order if colour not in used), order[0])


def series(count: int) -> list[Colour]:
    """Colours of curves that are not of receivers, such as those of a wire's links."""
    shades = -(-count // len(RESERVE))
    return [shade(RESERVE[i % len(RESERVE)], i // len(RESERVE), shades) for i in range(count)]


_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)
_SHADES = 8
_FEW, _STEP = 3, 0.16  # few shades stay near the colour itself, and so away from other strategies
_PALEST = 0.7  # white in the last shade of a colour that is not bright
_BRIGHT = 0.5  # luminance
_DARKEST = 0.125  # luminance of the last shade, for a contrast of 3 with `GROUND`


def shade(of: Colour, number: int, count: int) -> Colour:
    """One of `count` shades of the same colour; number 0 is the colour itself. They repeat after eight."""
    luminance, last = _luminance(of), min(count, _SHADES) - 1
    bright = luminance > _BRIGHT
    if last < _FEW:
        return mixed(of, _BLACK if bright else _WHITE, _STEP * number)
    palest, darkest = 0.0 if bright else _PALEST, 1.0 - min(1.0, (_DARKEST / luminance) ** (1.0 / 2.2))
    darker = round(last * darkest / (darkest + palest))
    places = sorted(range(-darker, last - darker + 1), key=lambda place: (abs(place), place))
    place = places[number % _SHADES]
    return (
        mixed(of, _BLACK, -place * darkest / darker)
        if place < 0
        else mixed(of, _WHITE, place * palest / max(1, last - darker))
    )


def mixed(of: Colour, other: Colour, fraction: float) -> Colour:
    """The colour with a fraction of another."""
    r, g, b = (round(own + fraction * (added - own)) for own, added in zip(of, other, strict=True))
    return r, g, b


DIM = 0.66
"""How much of a colour remains in theory, bands and paths."""


def dim(of: Colour) -> Colour:
    """The colour of what belongs to a receiver and is not itself measured, such as its theory or its path, on `GROUND`."""
    return mixed(GROUND, of, DIM)


_MOST_ON_PAPER = 0.3  # luminance, for a contrast of 3 with white
_OF_LETTERS = 0.188  # in the middle between white and the viewer's darkest ground


def on_paper(of: Colour) -> Colour:
    """The same colour where the ground may be white: not brighter than can be seen there."""
    fraction = min(1.0, _MOST_ON_PAPER / _luminance(of))
    r, g, b = (int(255.0 * _encoded(fraction * part)) for part in _linear(of))
    return r, g, b


@cache  # of a handful of colours, for each node and frame
def letters(of: Colour) -> Colour:
    """The same colour for letters in a node of a graph, whose ground is white or nearly black with the theme.

    No colour has a greater contrast with both than 4.4.
    """
    luminance = _luminance(of)
    darker = min(1.0, _OF_LETTERS / luminance)
    whiter = max(0.0, (_OF_LETTERS - luminance) / (1.0 - luminance))
    r, g, b = (round(255.0 * _encoded(darker * part + whiter * (1.0 - part))) for part in _linear(of))
    return r, g, b


def _luminance(of: Colour) -> float:
    return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), _linear(of), strict=True))


def _linear(of: Colour) -> list[float]:
    parts = [part / 255.0 for part in of]
    return [part / 12.92 if part <= 0.04045 else float(((part + 0.055) / 1.055) ** 2.4) for part in parts]


def _encoded(part: float) -> float:
    return part * 12.92 if part <= 0.0031308 else float(1.055 * part ** (1 / 2.4) - 0.055)


def paper_inks(receivers: Iterable[str], strategies: Mapping[str, str]) -> dict[str, str]:
    """Receiver → its colour where the ground may be white, as matplotlib and HTML write it.

    strategies: as far as they are known, as for `identities`; a receiver without one is taken to be named after it.
    """
    colours = identities({name: strategies.get(name, name) for name in receivers})
    return {name: hexadecimal(on_paper(bright)) for name, bright in colours.items()}


def hexadecimal(of: Colour) -> str:
    """The colour as matplotlib and HTML write it, such as `#64c795`."""
    return "#{:02x}{:02x}{:02x}".format(*of)
