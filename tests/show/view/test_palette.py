"""Who a colour stands for, and that colours can be distinguished, also by the colour-blind, and letters be read.

Vision (Machado, Oliveira and Fernandes 2009, severity 1), distance (CIEDE2000) and contrast (WCAG 2.1) are those of the library
coloraide.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from itertools import combinations, pairwise, permutations, product

import pytest
from coloraide import Color

from evedrop.model.eavesdroppers import STRATEGIES as STRATEGY_CLASSES
from evedrop.names import LEGITIMATE
from evedrop.scenario.application import APPLICATIONS
from evedrop.scenario.closed_loop import controlled_plant
from evedrop.scenario.loading import load
from evedrop.scenarios import shipped
from evedrop.show.view import lanes, palette
from evedrop.show.view.palette import (
    ALARM,
    GROUND,
    PLANT,
    RESERVE,
    STRATEGIES,
    TRUTH,
    TRUTH_CURVE,
    VERDICTS,
    Colour,
    dim,
    hexadecimal,
    identities,
    letters,
    on_paper,
    series,
)
from evedrop.show.view.panels.fates import FATES
from evedrop.wire.time_steps import LaneState

_EIGHT = ("naive", "suspicious", "smart", "likelihood", "bayesian", "genie", "power-test", "clear-states")
_VISIONS = (None, "deutan", "protan", "tritan")
_WHITE = (255, 255, 255)
_BLACK, _DARK = (0, 0, 0), (13, 13, 13)
"""The second is the ground of nodes in the dark theme."""
_LABEL_GROUNDS = (30, 31, 33), (120, 121, 123)
"""The grounds of labels on `GROUND`, in the dark theme and in the light one."""
_BOTH = 4.35  # 4.4 is the greatest contrast with white and `_DARK` that any colour has
_TEXT, _LARGE = 4.5, 3.0  # WCAG 2.1, 1.4.3 and 1.4.11: contrasts of letters, and of curves


LANES: tuple[Colour, ...] = (
    palette.STATE, palette.DECODED, palette.DISCARDED, palette.MISLED, palette.DROPPED, palette.SILENT,
)  # fmt: skip
"""The outcomes of a packet, brighter where more was used."""
WIRE_LANES: tuple[Colour, ...] = tuple(state.colour for state in LaneState)
"""The fates of the messages of a wire's link."""
PANELS: dict[str, Iterable[Colour]] = {
    "plant": PLANT,
    "lanes": LANES,
    "what the legitimate estimator knows": palette.KNOWLEDGE,
    "what an eavesdropper knows": palette.SPIED,
    "lanes of a wire": WIRE_LANES,
    "figures": palette.FIGURES,
    "verdicts": VERDICTS.values(),
}
"""The colours that share a panel, other than those of receivers."""


@cache
def _seen(colour: Colour, vision: str | None) -> Color:
    full = Color(hexadecimal(colour))
    return full if vision is None else full.filter(vision, method="machado").clip()


@cache
def _difference(colour: Colour, other: Colour) -> float:
    """CIEDE2000 for the vision to which it is least."""
    return min(_seen(colour, vision).delta_e(_seen(other, vision), method="2000") for vision in _VISIONS)


def _contrast(colour: Colour, ground: Colour) -> float:
    return Color(hexadecimal(colour)).contrast(Color(hexadecimal(ground)))


def _hue_and_chroma(colour: Colour) -> tuple[float, float]:
    _, chroma, hue = Color(hexadecimal(colour)).convert("oklch").coords(nans=False)
    return hue, chroma


def _green(colour: Colour) -> bool:
    hue, chroma = _hue_and_chroma(colour)
    return chroma > 0.04 and 115.0 < hue < 185.0


def _vermilion(colour: Colour) -> bool:
    hue, chroma = _hue_and_chroma(colour)
    return chroma > 0.1 and 15.0 < hue < 42.0


def _of_scenario(name: str) -> dict[str, str]:
    scenario = load(name)
    eavesdroppers = {eavesdropper: table.strategy for eavesdropper, table in scenario.eavesdroppers.items()}
    return {LEGITIMATE: scenario.encoding.scheme, **eavesdroppers}


def _eavesdroppers(*strategies: str) -> dict[str, str]:
    return {LEGITIMATE: "innovation", **{f"eve{i}": strategy for i, strategy in enumerate(strategies)}}


NINE = {
    "eight of one strategy": _eavesdroppers(*["smart"] * 8),
    "eight of three strategies": _eavesdroppers(*["smart", "naive", "suspicious"] * 2, "smart", "naive"),
    "eight strategies": _eavesdroppers(*_EIGHT),
}
TOGETHER = [*shipped(), *NINE]
"""Scenarios, and others, whose receivers appear together."""


@cache
def _together(name: str) -> Mapping[str, str]:
    """Receivers that appear together, with their strategies."""
    return NINE[name] if name in NINE else _of_scenario(name)


def _check(pairs: Iterable[Sequence[Colour]], least: float) -> None:
    for colour, other in pairs:
        difference = _difference(colour, other)
        assert difference >= least, f"{hexadecimal(colour)} and {hexadecimal(other)} differ by {difference:.1f}"


DIFFERENT, SAME, DIM, DIM_TO_BRIGHT, ON_PAPER = 10.0, 3.5, 7.0, 5.5, 7.0
ANY, OWN_DIM = 5.0, 8.0
"""The least differences, by CIEDE2000; 1 is just noticeable side by side."""


def _firsts(strategies: Mapping[str, str]) -> list[Colour]:
    """The colours of the first receiver with each strategy."""
    first: dict[str, Colour] = {}
    for name, colour in identities(strategies).items():
        first.setdefault(strategies[name], colour)
    return list(first.values())


@pytest.mark.parametrize("name", TOGETHER[:-1])
def test_receivers_that_appear_together_differ(name: str) -> None:
    """Full colours, dim ones, one of each, and those on paper; also further receivers with a strategy, which have its shades."""
    colours = _firsts(_together(name))
    pairs = list(combinations(colours, 2))
    _check(pairs, DIFFERENT)
    _check([(dim(colour), dim(other)) for colour, other in pairs], DIM)
    _check([(dim(colour), other) for colour, other in permutations(colours, 2)], DIM_TO_BRIGHT)
    _check([(on_paper(colour), on_paper(other)) for colour, other in pairs], ON_PAPER)
    _check(combinations(identities(_together(name)).values(), 2), SAME)


def test_any_two_strategies_differ() -> None:
    """Any combination of strategies can be in a scenario, with those of users."""
    _check(combinations((palette.LEGITIMATE, *STRATEGIES.values(), *RESERVE), 2), ANY)
    _check(combinations(RESERVE, 2), DIFFERENT)


def test_a_receiver_differs_from_the_truth_and_from_its_own_theory() -> None:
    """Whatever its strategy is."""
    for colour in (palette.LEGITIMATE, *STRATEGIES.values(), *RESERVE):
        _check([(colour, TRUTH), (colour, TRUTH_CURVE), (colour, dim(colour))], OWN_DIM)


def test_every_strategy_has_a_colour() -> None:
    """All that are built in, each another one."""
    assert set(STRATEGIES) == set(STRATEGY_CLASSES.names)
    assert len({*STRATEGIES.values(), *RESERVE, palette.LEGITIMATE}) == len(STRATEGIES) + len(RESERVE) + 1


@pytest.mark.parametrize("name", TOGETHER)
def test_green_is_the_legitimate_estimator_s_and_vermilion_nobody_s(name: str) -> None:
    """Also of variants, on paper, and dim."""
    shades: tuple[Callable[[Colour], Colour], ...] = (lambda colour: colour, dim, on_paper, letters)
    for (receiver, colour), shade in product(identities(_together(name)).items(), shades):
        assert _green(shade(colour)) == (receiver == LEGITIMATE)
        assert not _vermilion(shade(colour))


def test_no_other_colour_is_green_or_vermilion() -> None:
    """Of wires, plants and packets; only broken secrecy is vermilion, and only the legitimate estimator's knowledge green."""
    others = {
        *series(40),
        *LANES,
        *WIRE_LANES,
        *PLANT,
        *palette.FIGURES,
        *VERDICTS.values(),
        *palette.SPIED,
    }
    assert {colour for colour in others if _green(colour)} == set()
    assert {colour for colour in others if _vermilion(colour)} == {ALARM}
    assert [_green(colour) for colour in palette.KNOWLEDGE] == [True, False, False]
    tones = {*LANES, *WIRE_LANES, *PLANT}
    assert max(_hue_and_chroma(colour)[1] for colour in tones) < 0.06


def test_a_strategy_has_the_same_colour_in_every_scenario() -> None:
    """Wherever it stands, and whatever its receiver is called; the second of a kind has another one, and so has one of a user."""
    assert identities({"a": "smart"})["a"] == identities({LEGITIMATE: "plain", "b": "naive", "c": "smart"})["c"]
    assert identities({LEGITIMATE: "smart"})[LEGITIMATE] == palette.LEGITIMATE
    assert len({*identities(dict.fromkeys("abcdefgh", "smart")).values()}) == 8
    assert {*identities({"a": "mine", "b": "theirs", "c": "package:Class"}).values()} <= set(RESERVE)
    assert len({*identities({f"user{i}": f"strategy{i}" for i in range(len(RESERVE))}).values()}) == len(RESERVE)
    assert identities({f"user{i}": f"strategy{i}" for i in range(64)})


@pytest.mark.parametrize("name", TOGETHER)
def test_receivers_can_be_seen(name: str) -> None:
    """Curves have a contrast of 3 on the dark ground and, on paper, with both grounds of a page; letters are tested below."""
    for colour in identities(_together(name)).values():
        assert _contrast(colour, GROUND) >= _LARGE
        assert min(_contrast(on_paper(colour), ground) for ground in (GROUND, _WHITE)) >= _LARGE


def test_letters_can_be_read() -> None:
    """Those of graphs, on both grounds, those of the legend on its own; those in lanes, and of verdicts, are black or white."""
    inks = {
        *FATES,
        *(state.colour for state in LaneState),
        *STRATEGIES.values(),
        *RESERVE,
        palette.LEGITIMATE,
        TRUTH,
        ALARM,
    }
    assert min(_contrast(letters(ink), ground) for ink in inks for ground in (_DARK, _WHITE)) >= _BOTH
    assert min(_contrast(palette.LABEL, ground) for ground in _LABEL_GROUNDS) >= _BOTH
    assert min(_contrast(ink, GROUND) for ink in (TRUTH, ALARM)) >= _TEXT
    for ground in (*palette.KNOWLEDGE, *palette.SPIED, *VERDICTS.values()):
        assert max(_contrast(ink, ground) for ink in (_BLACK, _WHITE)) >= _TEXT
    assert min(_contrast(colour, GROUND) for colour in PLANT) >= _LARGE
    assert min(_contrast(colour, _WHITE) for colour in palette.FIGURES) >= _LARGE


@pytest.mark.parametrize("panel", PANELS)
def test_colours_that_share_a_panel_differ(panel: str) -> None:
    """By CIEDE2000 of at least 15, with full colour vision and with each kind of dichromacy."""
    _check(combinations(PANELS[panel], 2), 15.0)


@pytest.mark.parametrize("colours", [LANES, WIRE_LANES])
def test_lanes_differ_in_brightness(colours: tuple[Colour, ...]) -> None:
    """By at least 10 of 100 in CIE lightness, so that a grey print shows them too."""
    lightness = sorted(Color(hexadecimal(colour)).convert("lab-d65")["l"] for colour in colours)
    assert min(after - before for before, after in pairwise(lightness)) >= 10.0


def test_lanes_use_the_colours_of_the_table() -> None:
    """Every outcome of a lane has a colour of its own, from the table."""
    for lane in (lanes.SENT, lanes.LEGITIMATE, lanes.EAVESDROPPER):
        assert set(lane.colours) <= set(LANES)
        assert len(set(lane.colours)) == len(lane.words)
    assert lanes.EAVESDROPPER.colours[0] == palette.DROPPED


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
        assert set(colours) <= {*PLANT, TRUTH_CURVE}
        assert len(set(colours)) == len(colours)
