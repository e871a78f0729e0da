"""The state plane: what it follows, and what is far away."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evedrop.show.view.panels.plane import apart, arrows, borders, inside, labels_of, side_by_side, within
from evedrop.show.view.recording import ViewRecording
from tests.show.view.read_back import rows
from tests.show.view.simulated_run import Simulated

LOW, HIGH, TRUTH = (np.array([one], np.float32) for one in ([-10.0, -5.0], [10.0, 5.0], [2.0, 1.0]))


@pytest.mark.parametrize("where", [(50.0, 1.0), (2.0, -40.0), (-30.0, 33.0), (1e30, 1e30), (11.0, 0.0)])
def test_arrows_end_at_the_border_and_point_at_the_estimate(where: tuple[float, float]) -> None:
    """Wherever it is, up to the largest number; their tip lies on the line from the truth."""
    point = np.array([where], np.float32)
    tips = borders(TRUTH, point, LOW, HIGH)
    tip = tips[0].astype(float)
    edge = np.array([2.0, 1.0])
    assert (tip >= LOW[0] + edge - 1e-5).all()
    assert (tip <= HIGH[0] - edge + 1e-5).all()
    assert np.isclose(np.abs(tip), np.array([8.0, 4.0]), atol=1e-5).any()
    towards, moved = point[0].astype(float) - TRUTH[0], tip - TRUTH[0]
    assert np.isclose(towards @ moved, np.hypot(*towards) * np.hypot(*moved), rtol=1e-5)
    shaft = arrows(TRUTH, point, tips, LOW, HIGH)[0]
    np.testing.assert_array_equal(shaft[1], shaft[3])
    np.testing.assert_allclose(shaft[1], tip, rtol=1e-6)
    assert (shaft[1] - shaft[0]) @ towards > 0.0


def test_what_is_inside_stays() -> None:
    """Points and pieces of paths inside the frame are as they were; a piece that leaves it is a dot."""
    point = np.array([[9.9, -4.9]], np.float32)
    np.testing.assert_array_equal(borders(TRUTH, point, LOW, HIGH), point)
    assert inside(point, LOW, HIGH).all()
    stays, leaves = np.array([[[0, 0], [9, 4]]], np.float32), np.array([[[0, 0], [11, 4]]], np.float32)
    np.testing.assert_array_equal(within(stays, LOW, HIGH, TRUTH), stays)
    np.testing.assert_array_equal(within(leaves, LOW, HIGH, TRUTH), [[TRUTH[0], TRUTH[0]]])


@pytest.mark.parametrize(
    ("tip", "centre"),
    [
        ((2.0, 0.0), (2.0, -1.8)),  # above the truth: the letters are above the tip
        ((2.0, 3.0), (2.0, 3.0)),  # below it: they are drawn below the centre anyway
        ((9.0, 1.0), (6.4, -0.8)),  # at a border: moved into the frame
        ((-9.0, -4.5), (-6.4, -5.0)),
        ((2.0, 4.5), (2.0, 4.1)),
    ],
)
def test_a_label_is_beyond_the_tip_and_in_the_frame(tip: tuple[float, float], centre: tuple[float, float]) -> None:
    """The letters do not cover the arrow, which points away from the truth; Rerun's y axis points down."""
    labels = labels_of(TRUTH, np.array([tip], np.float32), LOW, HIGH)
    np.testing.assert_allclose(labels, [centre], rtol=1e-6)


@pytest.mark.parametrize("tip", [(9.0, -4.0), (9.0, 4.0), (2.0, -4.5), (-8.0, 1.0)])
def test_labels_of_estimates_at_one_place_are_below_each_other(tip: tuple[float, float]) -> None:
    """Each is moved by as few lines as needed, and stays in the frame; one that is alone stays where it is."""
    first = labels_of(TRUTH, np.array([tip], np.float32), LOW, HIGH)
    placed = [apart(first, [], LOW, HIGH)]
    np.testing.assert_array_equal(placed[0], first)
    for _ in range(3):
        placed.append(apart(first, placed, LOW, HIGH))
    heights = np.sort([place[0, 1] for place in placed])
    np.testing.assert_allclose(np.diff(heights), 0.11 * 10.0, rtol=1e-5)
    assert {float(place[0, 0]) for place in placed} == {float(first[0, 0])}
    assert all(inside(place, LOW, HIGH)[0] for place in placed)
    beside = first + np.array([[8.0, 0.0]], np.float32)
    np.testing.assert_array_equal(apart(beside, placed, LOW, HIGH), beside)
    nowhere = np.full((1, 2), np.nan, np.float32)
    np.testing.assert_array_equal(apart(first, [nowhere], LOW, HIGH), first)


def test_each_that_is_far_has_an_arrow_of_its_own() -> None:
    """Estimates at one place outside the frame are drawn side by side, inside it; those inside the frame stay where they are."""
    places: list[np.ndarray] = []
    for where in ((50.0, 1.0), (50.0, 1.0), (51.0, 1.0), (0.0, 0.0), (0.0, 0.0)):
        point = np.array([where], np.float32)
        places.append(side_by_side(TRUTH, point, places, LOW, HIGH))
    far = np.concatenate(places[:3])
    gaps = [np.abs(far[i] - far[j]).max() for i in range(3) for j in range(i)]
    assert min(gaps) > 0.05 * 20.0
    assert inside(far, LOW, HIGH).all()
    np.testing.assert_array_equal(places[3], places[4])


def test_two_that_are_far_have_labels_apart(simulated: Callable[..., Simulated], tmp_path: Path) -> None:
    """Where one of them is near, the other's label is where it would be without it."""
    run = simulated(60)
    far = run.slots.x.copy()
    far[30:40] += [3000.0, 4000.0]
    labels = {}
    for name, first in (("both", slice(30, 40)), ("one", slice(35, 40))):
        near = run.slots.x.copy()
        near[first] = far[first]
        estimates = {"naive": near, "suspicious": far, "smart": run.slots.x}
        peers = {who: replace(run.slots.peers[who], x_hat=x_hat) for who, x_hat in estimates.items()}
        recording = ViewRecording(tmp_path / f"{name}.rrd", run.scene)
        recording.add(replace(run.slots, peers={**run.slots.peers, **peers}))
        assert recording.close()
        for who in ("naive", "suspicious"):
            labels[name, who] = rows(tmp_path / f"{name}.rrd", f"plane/{who}/away", "Points2D:positions")
    for k in range(30, 40):
        assert labels["both", "suspicious"][k] != labels["both", "naive"][k]
        alone = labels["one", "suspicious"][k] == labels["both", "naive"][k]
        assert alone == (k < 35)


def test_the_plane_follows_truth_and_legitimate(simulated: Callable[..., Simulated], tmp_path: Path) -> None:
    """An eavesdropper far away changes no frame; it has an arrow with its distance there, and nowhere else."""
    run = simulated(60)
    naive = replace(run.slots.peers["naive"], P=np.broadcast_to(np.eye(2), (60, 2, 2)))
    x_hat = run.slots.x.copy()
    x_hat[30:40] += [3000.0, 4000.0]
    frames = {}
    for name, peer in (("near", replace(naive, x_hat=run.slots.x)), ("far", replace(naive, x_hat=x_hat))):
        slots = replace(run.slots, peers={**run.slots.peers, "naive": peer})
        recording = ViewRecording(tmp_path / f"{name}.rrd", replace(run.scene, units=("m", "m")))
        recording.add(slots)
        assert recording.close()
        frames[name] = rows(tmp_path / f"{name}.rrd", "plane/Frame", "LineStrips2D:strips")
    assert frames["near"] == frames["far"]
    labels = rows(tmp_path / "far.rrd", "plane/naive/away", "Points2D:labels")
    assert {k: text for k, text in labels.items() if text} == {k: ["naive: 5,000 m"] for k in range(30, 40)}
    shown = {
        part: rows(tmp_path / "far.rrd", f"plane/naive/{part}", component)
        for part, component in (
            ("at", "Points2D:positions"),
            ("trail", "LineStrips2D:strips"),
            ("cov", "LineStrips2D:strips"),
        )
    }
    for k in range(60):
        corners = np.array(frames["far"][k][0])
        for part, drawn in shown.items():
            points = np.array(drawn[k]).reshape(-1, 2)
            assert (points >= corners.min(axis=0)).all()
            assert (points <= corners.max(axis=0)).all()
            if part == "cov" and 30 <= k < 40:  # no ellipse is where it is far away
                np.testing.assert_allclose(points, np.broadcast_to(run.slots.x[k] * [1, -1], points.shape), rtol=1e-5)


def test_the_plane_shows_a_legitimate_estimate_wherever_it_is(
    simulated: Callable[..., Simulated], tmp_path: Path
) -> None:
    """The frame is around both."""
    run = simulated(60)
    x_hat = run.slots.x.copy()
    x_hat[30:40] += [300.0, 400.0]
    peers = {**run.slots.peers, "legitimate": replace(run.slots.peers["legitimate"], x_hat=x_hat)}
    recording = ViewRecording(tmp_path / "r.rrd", run.scene)
    recording.add(replace(run.slots, peers=peers))
    assert recording.close()
    result = rows(tmp_path / "r.rrd", "plane/Frame", "LineStrips2D:strips")
    for k in range(30, 40):
        corners = np.array(result[k][0])
        for state in (run.slots.x[k], x_hat[k]):
            assert (corners.min(axis=0) < state * [1, -1]).all()
            assert (corners.max(axis=0) > state * [1, -1]).all()
