"""The gallery of built-in scenarios."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from itertools import pairwise

import numpy as np
import pytest

from evedrop import Scenario, montecarlo
from evedrop.scenarios import shipped
from tests.docs.site_tools import site_tool

_LONGEST = 170
_MOST_BYTES = 60_000


@pytest.mark.parametrize("name", shipped())
def test_a_scenario_says_first_what_one_learns(name: str) -> None:
    """In a sentence or two, which fit on a card."""
    learned = site_tool("gallery").learned(name)
    assert learned.endswith(".")
    assert 20 < len(learned) < _LONGEST


def test_cards_lead_to_pages_and_belong_to_what_they_are_about() -> None:
    """Every scenario has a card; every filter leaves some."""
    gallery = site_tool("gallery")
    page = gallery.gallery_page()
    for name in shipped():
        assert f'href="gallery/{name}.html"' in page
    kinds = {entry.name: set(entry.kinds) for entry in gallery.entries()}
    assert kinds["acknowledged"] == {"attack"}
    assert kinds["replay-attack-before"] == {"attack", "closed-loop"}
    assert kinds["nemesis"] == {"faults"}
    assert kinds["late"] == {"links"}
    assert kinds["vehicle"] == set()
    assert set().union(*kinds.values()) | {"all", "wire"} == set(gallery._FILTERS)


def test_the_demo_comes_first_and_then_what_belongs_together() -> None:
    """Attacks before closed loops, in the order of the filters."""
    names = re.findall(r'href="gallery/([\w-]+)\.html"', site_tool("gallery").gallery_page())
    assert sorted(names) == sorted(shipped())
    assert names[0] == "vehicle"
    assert names.index("acknowledged") < names.index("late") < names.index("nemesis") < names.index("microgrid")


@pytest.mark.thorough
def test_a_filter_hides_the_cards_without_its_class() -> None:
    """Some cards have the class, and the button that the rule names is there."""
    page = site_tool("gallery").gallery_page()
    rules = re.findall(r"\.gallery:has\(#([\w-]+):checked\) \.card:not\(\.([\w-]+)\)", page)
    assert len(rules) > 10
    for button, class_ in rules:
        assert f'id="{button}"' in page
        assert re.search(rf'class="card [^"]*\b{class_}\b', page)


@pytest.mark.parametrize("moves", [True, False])
@pytest.mark.parametrize("states", [1, 2])
def test_a_card_is_small_and_moves_or_not(states: int, moves: bool) -> None:
    """Whatever the run's length, and with an estimate far outside."""
    drawing = site_tool("card_drawing")
    slots = 5000
    truth = np.cumsum(np.random.default_rng(1).normal(size=(slots, states)), axis=0)
    estimates = {"legitimate": truth + 0.1, "naive <b>": truth * 100.0}
    inks = dict.fromkeys(estimates, "#64c795")
    curves = [drawing.Curve("#64c795", np.full(slots, error)) for error in (0.0, 1.0)]
    shown = drawing.Shown("Title & more", range(slots), slots, truth, estimates, inks, curves)
    picture = drawing.card(shown, dark=True, moves=moves)
    assert len(picture) < _MOST_BYTES
    assert "http" not in picture.replace("http://www.w3.org/2000/svg", "")
    assert "nan" not in picture
    root = ET.fromstring(picture)  # noqa: S314 - our own picture
    assert bool(list(root.iter("{http://www.w3.org/2000/svg}animate"))) is moves
    points = root.iter("{http://www.w3.org/2000/svg}circle")
    assert all(0 <= float(circle.attrib["cx"]) <= 320 for circle in points)


def test_an_attack_that_nobody_notices_can_be_seen() -> None:
    """The true state leaves the estimate, while the statistic stays below the alarm."""
    results = montecarlo("replay-attack-before", trials=2)
    attack = site_tool("gallery_pictures")._Attack.of(Scenario.load(results.folder), results)
    off = np.abs(attack.truth - attack.estimate)[:, 0]
    assert off[: attack.begins].max() < 2.0
    assert off[-1] > 10.0
    assert attack.statistic.max() < attack.threshold


def test_the_list_in_the_reference_has_every_scenario_in_order() -> None:
    """By name, with its title and a link to its page."""
    page = site_tool("gallery").scenarios_page()
    places = [page.index(f"| [`{name}`](../gallery/{name}.md) |") for name in sorted(shipped())]
    assert all(before < after for before, after in pairwise(places))
