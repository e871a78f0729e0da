"""The colours that pages name are those that the view gives to receivers, and what the page says of them is so."""

from __future__ import annotations

import colorsys
import math
import re
from pathlib import Path

import pytest

from evedrop.scenario.loading import load
from evedrop.score.synchronisation import FACTOR
from evedrop.show.view import palette
from evedrop.show.view.palette import STRATEGIES, Colour, identities

ROOT = Path(__file__).parents[2]
HUES = {"yellow": (45, 60), "green": (120, 165), "blue": (205, 230), "violet": (250, 275)}
"""Name of a colour → its hues, in degrees."""


def name_of(colour: Colour) -> str | None:
    """What a page calls a colour; None if it is none of these."""
    hue = 360.0 * colorsys.rgb_to_hsv(*(part / 255.0 for part in colour))[0]
    return next((name for name, (low, high) in HUES.items() if low <= hue <= high), None)


def text(name: str) -> str:
    """A file with single spaces."""
    return re.sub(r"[\s#]+", " ", (ROOT / name).read_text(encoding="utf-8"))


def test_the_readme_names_the_colours_of_the_vehicle_s_receivers() -> None:
    """In the words below its picture."""
    receivers = load("vehicle").receivers
    assert receivers == ("legitimate", "naive", "suspicious", "smart")
    inks = identities({name: name for name in receivers})
    colours = re.findall(r"The legitimate estimator \((\w+)\).*?naive eavesdropper \((\w+)\)", text("README.md"))
    more = re.findall(r"the suspicious one \((\w+)\).*?the smart one \((\w+)\)", text("README.md"))
    assert [*colours[0], *more[0]] == [name_of(colour) for colour in inks.values()]


def test_the_page_of_the_view_names_the_colour_of_every_strategy() -> None:
    """With the words of the table of colours."""
    source = Path(palette.__file__).read_text(encoding="utf-8")
    words = {strategy: re.findall(rf'"{strategy}": \(.*\),  # (.+)', source)[0] for strategy in STRATEGIES}
    assert len({*words.values()}) == len(STRATEGIES)
    page = text("docs/view.md")
    assert {strategy for strategy, word in words.items() if f"`{strategy}` {word}" not in page} == set()
    assert [words[name] for name in ("naive", "suspicious", "smart")] == [
        name_of(STRATEGIES[name]) for name in ("naive", "suspicious", "smart")
    ]


@pytest.mark.parametrize("path", sorted((ROOT / "scenarios").glob("*.toml")), ids=lambda path: path.name)
def test_a_scenario_names_colours_that_there_are(path: Path) -> None:
    """No receiver is teal."""
    assert not re.search(r"\b(teal|cyan|orange|magenta|pink)\b", path.read_text(encoding="utf-8"))


def test_how_often_a_right_covariance_is_called_wrong() -> None:
    """P(χ² with one degree of freedom > 20): the number in the page."""
    probability = math.erfc(math.sqrt(FACTOR / 2.0))
    page = text("docs/view.md")
    assert (
        rf"exceeds the factor {FACTOR:.0f} with probability at most ${probability * 1e6:.1f} \cdot 10^{{-6}}$ a slot"
        in page
    )
