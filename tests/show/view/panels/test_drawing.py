"""A house as the scene draws it: heights of bars, widths and directions of arrows, and words, from known states and powers."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from evedrop.scenario.application import APPLICATIONS, DrawnFlow, DrawnLevel, Sketch
from evedrop.scenario.closed_loop import controlled_plant
from evedrop.scenario.loading import load
from evedrop.show.view.panels.curves import Levels
from evedrop.show.view.panels.drawing import DrawnPlant, arrow, filled, flow_text, half_widths, height, level_text
from evedrop.show.view.panels.panel import PlacedView
from evedrop.show.view.scene import Moved, Scene, SceneSlots, Shown

STORE = DrawnLevel("battery", 0, 0.0, 100.0, (4.0, 6.0), 2.0, (20.0,))
GRID = DrawnFlow("from grid", "to grid", (1.0, 0.0), (11.0, 4.0), (9.0, 4.0), (10.0, 3.0))
SCENE = Scene(
    "", "r", 5, 1, 1, 0.0, (Shown("legitimate", "legitimate", "plain", 1.0),), 1.0, units=("%",), moving=("a", "b")
)


def drawing_of(name: str) -> Sketch:
    """The drawing of a built-in scenario."""
    scenario = load(name)
    loop = controlled_plant(scenario)
    assert loop is not None
    (drawing,) = (APPLICATIONS[table].drawing(loop, scenario.applications[table]) for table in scenario.applications)
    assert drawing is not None
    return drawing


def test_a_bar_is_as_high_as_its_state() -> None:
    """From the foot to the top, within the bar even beyond its range; the strokes' round ends are within it, too."""
    values = np.array([0.0, 25.0, 51.0, 100.0, -3.0, 140.0])
    np.testing.assert_allclose(height(STORE, values), [6.0, 5.0, 3.96, 2.0, 6.0, 2.0])
    strokes, half = filled(STORE, values), 0.07
    assert (strokes[..., 0].min() - half, strokes[..., 0].max() + half) == pytest.approx((3.6, 4.4), abs=1e-5)
    np.testing.assert_allclose(strokes[1:4, :, 1].min(axis=1) - half, [5.0, 3.96, 2.0], rtol=1e-5)
    np.testing.assert_allclose(strokes[..., 1].max(axis=1) + half, 6.0, rtol=1e-5)


def test_an_arrow_points_where_power_flows_and_is_as_wide() -> None:
    """Back where the power is negative; hardly to be seen, and a dot, where there is none."""
    powers = np.array([2.0, -1.0, 0.001])
    widths = half_widths(powers, 2.0)
    assert widths[0] == pytest.approx(2.0 * widths[1])
    assert widths[2] < widths[1] / 3
    drawn = arrow(GRID, powers, widths)
    assert drawn[:, :2].tolist() == [[[11.0, 4.0], [9.0, 4.0]], [[9.0, 4.0], [11.0, 4.0]], [[11.0, 4.0]] * 2]
    assert (drawn[0, [2, 4], 0] > 9.0).all()
    assert (drawn[1, [2, 4], 0] < 11.0).all()


def test_words_have_units_and_directions() -> None:
    """A battery in per cent; power to and from the grid; a heater whose power is what it gives beyond a constant."""
    assert level_text(STORE, 51.34, SCENE) == "battery 51.3 %"
    assert level_text(STORE, 51.34, replace(SCENE, units=())) == "battery 51.3"
    assert [flow_text(GRID, power) for power in (0.2, -1.234, 0.0, -0.001)] == [
        "from grid 0.20 kW",
        "to grid 1.23 kW",
        "from grid 0.00 kW",
        "from grid 0.00 kW",
    ]
    heating = replace(GRID, positive="heating", negative="heating", signed=True)
    assert [flow_text(heating, power) for power in (0.5, -0.5)] == ["heating +0.50 kW", "heating −0.50 kW"]


def test_the_house_and_the_room_have_their_parts() -> None:
    """Battery, hydrogen, load, grid, sun and fuel cell or electrolyser; room, wall and heater."""
    house, room = drawing_of("microgrid"), drawing_of("heated-room")
    assert [level.name for level in house.levels] == ["battery", "hydrogen"]
    assert {flow.positive for flow in house.flows} == {"load", "from grid", "sun", "fuel cell", ""}
    (charge,) = (flow.weights for flow in house.flows if not flow.positive)
    assert charge == pytest.approx((1.0, -1.0, 1.0, 1.0))  # P_solar, P_load, P_H, P_grid
    assert house.most > 3.0
    assert [level.name for level in room.levels] == ["room", "wall"]
    assert room.levels[0].marks == (20.5, 22.5)
    assert room.levels[0].low < 17.0  # where it starts


SMALL, LARGE = (391.0, 455.0), (854.0, 620.0)
BETWEEN = [(569.0, 330.0), (569.0, 424.0)]


@pytest.mark.parametrize("name", ["microgrid", "heated-room"])
@pytest.mark.parametrize("size", [SMALL, LARGE, *(pytest.param(size, marks=pytest.mark.long) for size in BETWEEN)])
def test_words_do_not_cover_each_other(name: str, size: tuple[float, float]) -> None:
    """Nor are they cut: in a picture of 880 × 660, in windows of 1280 × 720, with a high strip as well, and of 1920 × 1080."""
    drawing = drawing_of(name)
    scale = min(pixels / length for pixels, length in zip(size, drawing.size, strict=True))
    words = [(f"{level.name} 100.0 %", level.foot[0], level.foot[1] + 0.25) for level in drawing.levels]
    for flow in drawing.flows:
        if flow.positive:
            longest = max(flow.positive, flow.negative, key=len)
            words.append((f"{longest} 3.00 kW", *flow.label))
    boxes = [(x * scale, y * scale + 11.0, 3.0 * len(text) + 6.0, 10.0) for text, x, y in words]
    for (x, y, half_width, half_height), other in combinations(boxes, 2):
        assert abs(x - other[0]) >= half_width + other[2] or abs(y - other[1]) >= half_height + other[3], words
    left = (size[0] - drawing.size[0] * scale) / 2
    assert all(-left <= x - half and x + half <= size[0] - left for x, _, half, _ in boxes)


def test_a_drawing_takes_the_place_of_the_curve() -> None:
    """Of what happens, and of nothing else."""
    drawing = drawing_of("heated-room")
    scene = replace(SCENE, n=2, units=("°C", "°C"), moving=("P_heat (kW)",), drawing=drawing)
    assert DrawnPlant.applies(scene)
    assert not DrawnPlant.applies(SCENE)

    def sides(views: list[PlacedView]) -> list[str]:
        return [view.side for view in views if view.side in ("truth", "worlds")]

    assert sides([*DrawnPlant(scene).views(), *Levels(scene).views()]) == ["truth", "worlds"]
    assert sides([*Levels(replace(scene, drawing=None)).views()]) == ["truth", "worlds"]


def test_the_curves_beside_it_are_dark_in_both_themes() -> None:
    """A yellow or a light green curve cannot be seen on the white ground of a light window."""
    scene = replace(SCENE, moving=("P_heat (kW)",))
    for placed in Levels(scene).views():
        assert "PlotBackground" in placed.view.properties


def test_every_frame_has_all_parts() -> None:
    """Bars, arrows and words, of the slots that are frames."""
    drawing = drawing_of("heated-room")
    scene = replace(SCENE, n=2, units=("°C", "°C"), moving=("P_heat (kW)",), drawing=drawing)
    moved = Moved(np.array([[0.5], [-0.25], [0.0]]))
    x = np.array([[21.0, 18.0], [21.04, 18.0], [20.0, 18.0]])
    columns = [*DrawnPlant(scene).columns(SceneSlots(0, x, np.zeros(3, np.bool_), {}, moved))]
    assert [column.path for column in columns] == ["drawing/bars", "drawing/arrows", "drawing/words"]
    (labels,) = columns[2].values
    assert labels.as_arrow_array().to_pylist() == [
        ["room 21.0 °C", "wall 18.0 °C", "heating +0.50 kW"],
        ["room 21.0 °C", "wall 18.0 °C", "heating −0.25 kW"],
        ["room 20.0 °C", "wall 18.0 °C", "heating +0.00 kW"],
    ]


def test_the_widest_arrow_is_that_of_the_largest_power() -> None:
    """Of the drawing, whatever it is, and widths are in proportion."""
    widths = half_widths(np.array([[2.0, -4.0, 8.0]]), 8.0)[0]
    np.testing.assert_allclose(widths, np.array([0.25, 0.5, 1.0]) * widths[2])
    assert half_widths(np.array([[80.0]]), 80.0)[0, 0] == widths[2]
