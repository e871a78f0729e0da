"""The tab with the scene: what happens, the world as each listener believes it, and the verdict above."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.score.verdict import SecrecyOutcome, Verdict
from evedrop.show.view.panels.panel import PlacedView
from evedrop.show.view.panels.plane import StatePlane, TruthDirection, heading_strips, scale_bars
from evedrop.show.view.recording import MOST_WORLDS, PanelSet, ViewRecording, _rows
from evedrop.show.view.scene import Shown
from tests.show.view.read_back import rows
from tests.show.view.simulated_run import Simulated, orbit, simulate


@pytest.mark.parametrize(
    ("count", "shape"), [(1, [1]), (2, [2]), (3, [2, 1]), (4, [2, 2]), (5, [3, 2]), (7, [3, 2, 2]), (9, [3, 3, 3])]
)
def test_a_grid_of_worlds_has_no_empty_cell(count: int, shape: list[int]) -> None:
    """Its rows differ by one cell at most."""
    worlds: list[PlacedView] = [PlacedView(None, "worlds") for _ in range(count)]  # type: ignore[arg-type]
    assert sorted(map(len, _rows(worlds)), reverse=True) == shape
    assert [world for row in _rows(worlds) for world in row] == worlds


def test_a_run_has_a_scene_and_numbers() -> None:
    """One view of what happens, one world for each receiver, one strip; the verdict is above both tabs."""
    run: Simulated = simulate(orbit(), 50)
    layout = str(PanelSet(run.scene, print).layout().root_container.__dict__)
    for word in ("Tabs", "Vertical"):
        assert word in layout
    names = [shown.world_title for shown in run.scene.receivers]
    assert names == ["The estimator believes", "naive believes", "suspicious believes", "smart believes"]
    assert Shown("eve", "eavesdropper", "smart", None).world_title == "eve (smart) believes"


def test_no_more_than_nine_receivers_have_a_world() -> None:
    """More would be too small to be read; the others are in the numbers."""
    run: Simulated = simulate(orbit(), 20)
    crowd = tuple(replace(run.scene.receivers[-1], name=f"e{i}") for i in range(64))
    scene = replace(run.scene, receivers=(run.scene.receivers[0], *crowd))
    names: list[str] = []

    def walk(part: Any) -> None:
        for inner in getattr(part, "contents", None) or ():
            walk(inner) if hasattr(inner, "row_shares") else names.append(str(inner.name))

    walk(PanelSet(scene, print).layout().root_container)
    assert sum(name.endswith("believes") for name in names) == MOST_WORLDS


def test_a_heading_is_the_direction_of_the_last_slots() -> None:
    """Of length one, the same however slots are cut; where nothing moves, the last direction stays."""
    path = np.array([[0.0, 0.0], [3.0, 4.0], [6.0, 8.0], [6.0, 8.0]] + [[6.0, 8.0]] * 20, np.float32)
    whole = TruthDirection().directions(path, np.arange(len(path)))
    np.testing.assert_allclose(whole[1:], np.tile([0.6, 0.8], (len(path) - 1, 1)), rtol=1e-6)
    parts = TruthDirection()
    cut = [parts.directions(piece, np.arange(len(piece))) for piece in (path[:2], path[2:3], path[3:])]
    np.testing.assert_allclose(np.concatenate(cut), whole, rtol=1e-6)
    strip = heading_strips(path[1:2], whole[1:2], np.array([[10.0, 10.0]], np.float32))
    assert strip.shape == (1, 5, 2)
    np.testing.assert_allclose(strip[0, 1] - path[1], 0.6 * 0.09 * 10 * whole[1], rtol=1e-5)


@pytest.mark.parametrize(("width", "length"), [(10.0, 2.0), (4.0, 1.0), (24.0, 5.0), (0.01, 0.002)])
def test_a_scale_is_a_round_length_in_the_corner(width: float, length: float) -> None:
    """1, 2 or 5 times a power of ten, at most a quarter of the frame."""
    low, high = np.zeros((1, 2), np.float32), np.full((1, 2), width, np.float32)
    bars, lengths = scale_bars(low, high)
    assert lengths[0] == pytest.approx(length)
    assert bars[0, 1, 0] - bars[0, 0, 0] == pytest.approx(length, rel=1e-4)


def recorded_texts(run: Simulated, path: Path, length: int) -> dict[int, str]:
    """Slot → the line at the top from it on, of a run that is recorded some slots at a time and has a verdict."""
    recording = ViewRecording(path, run.scene)
    for slots in run.chunks(length):
        recording.add(slots)
    recording.conclude(Verdict(SecrecyOutcome.RELATIVE, "the end", "smart"))
    assert recording.close()
    return {slot: str(text[0]) for slot, text in rows(path, "title", "TextDocument:text").items()}


@pytest.mark.thorough
def test_the_verdict_is_recorded_so_far_and_at_the_end(tmp_path: Path) -> None:
    """Sixty times in a run that is as fast as possible, never from later slots, and the verdict on the run at its last slot."""
    run: Simulated = simulate(orbit(), 1500)
    texts = recorded_texts(run, tmp_path / "a.rrd", 400)
    assert texts == recorded_texts(run, tmp_path / "b.rrd", 1500)
    assert 0 in texts
    assert 40 < len(texts) <= 62
    assert all("so far" in text for slot, text in texts.items() if slot < 1499)
    assert "secret: the end" in texts[1499]
    labels = rows(tmp_path / "a.rrd", "plane/smart/off", "Points2D:labels")
    assert all(str(label[0]).endswith(" off") for label in labels.values())


def test_the_plane_of_the_numbers_has_no_labels_of_the_worlds() -> None:
    """They would cover each other; a world has only its own receiver's."""
    run: Simulated = simulate(orbit(), 20)
    contents_of: list[Any] = [view.view.contents for view in StatePlane(run.scene).views()]
    plane, _, *worlds = contents_of
    assert {"- /plane/smart/off", "- /plane/Scale", "- /plane/Truth/heading"} <= set(plane)
    for shown, contents in zip(run.scene.receivers, worlds, strict=True):
        assert [path for path in contents if str(path).endswith("/off")] == [f"plane/{shown.name}/off"]
