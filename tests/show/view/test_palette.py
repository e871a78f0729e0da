"""The colours of a panel can be distinguished, also by the colour-blind. Vision and distance are the library coloraide's."""

from __future__ import annotations

from itertools import combinations, pairwise

import pytest
from coloraide import Color

from evedrop.scenario.application import APPLICATIONS
from evedrop.scenario.closed_loop import controlled_plant
from evedrop.scenario.loading import load
from evedrop.show.view import lanes
from evedrop.show.view.palette import DROPPED, LANES, PANELS, PLANT, WIRE_LANES, Colour, hexadecimal

_LEAST = 15.0  # CIEDE2000; 1 is just noticeable side by side
_VISIONS = (None, "deutan", "protan", "tritan")


def _seen(colour: Colour, vision: str | None) -> Color:
    full = Color(hexadecimal(colour))
    return full if vision is None else full.filter(vision)


@pytest.mark.parametrize("panel", PANELS)
@pytest.mark.parametrize("vision", _VISIONS)
def test_colours_that_share_a_panel_differ(panel: str, vision: str | None) -> None:
    """By CIEDE2000 of at least 15, with full colour vision and with each kind of dichromacy."""
    for colour, other in combinations(PANELS[panel], 2):
        difference = _seen(colour, vision).delta_e(_seen(other, vision), method="2000")
        assert difference >= _LEAST, f"{hexadecimal(colour)} and {hexadecimal(other)} differ by {difference:.1f}"


@pytest.mark.parametrize("colours", [LANES, WIRE_LANES])
def test_lanes_differ_in_brightness(colours: tuple[Colour, ...]) -> None:
    """By at least 6 of 100 in CIE lightness, so that a grey print shows them too."""
    lightness = sorted(Color(hexadecimal(colour)).convert("lab-d65")["l"] for colour in colours)
    assert min(after - before for before, after in pairwise(lightness)) >= 6.0


def test_lanes_use_the_colours_of_the_table() -> None:
    """Every outcome of a lane has a colour of its own, from the table."""
    for lane in (lanes.SENT, lanes.LEGITIMATE, lanes.EAVESDROPPER):
        assert set(lane.colours) <= set(LANES)
        assert len(set(lane.colours)) == len(lane.words)
    assert lanes.EAVESDROPPER.colours[0] == DROPPED


@pytest.mark.parametrize("name", ["microgrid", "heated-room", "replay-attack"])
def test_panels_of_applications_use_the_colours_of_the_table(name: str) -> None:
    """Curves that do not show receivers have colours of the plant, each a different one."""
    scenario = load(name)
    loop = controlled_plant(scenario)
    assert loop is not None
    panels = [panel for key, table in scenario.applications.items() for panel in APPLICATIONS[key].panels(loop, table)]
    assert panels
    for panel in panels:
        colours = [curve.colour for curve in panel.curves if curve.colour is not None]
        assert set(colours) <= set(PLANT)
        assert len(set(colours)) == len(colours)
