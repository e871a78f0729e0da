"""The map of sender and receivers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import rerun as rr

from evedrop.model.links.way import Way
from evedrop.scenario.loading import load
from evedrop.show.view.panels.plane import GroundMap
from evedrop.show.view.recording import ViewRecording
from evedrop.show.view.scene_slots import open_recording
from tests.show.view.read_back import rows
from tests.show.view.simulated_run import Simulated, orbit, simulate


def test_only_links_by_distance_have_ways() -> None:
    """The legitimate link of `driving-away` loses packets wherever the sender is, that of the eavesdropper does not."""
    scenario = load("driving-away")
    assert scenario.link("legitimate").model.ways is None
    ways = scenario.link("parked").model.ways
    assert ways is not None
    assert [float(axis[0]) for axis in ways[0].at(np.array([750.0]))] == [212.5, 0.0]


def test_the_map_shows_both_ends_and_their_distance(tmp_path: Path) -> None:
    """In every frame of a run; the sender leaves at slot 300."""
    scenario = load("driving-away")
    run: Simulated = simulate(orbit(), 1500)
    recording = open_recording(scenario, "r", tmp_path / "r.rrd")
    peers = {"legitimate": run.slots.peers["legitimate"], "parked": run.slots.peers["smart"]}
    for slots in run.chunks(400):
        at = slice(slots.first, slots.first + slots.count)
        some = {name: peer.rows(at) for name, peer in peers.items()}
        recording.add(replace(slots, peers=some))
    assert recording.close()
    places = rows(tmp_path / "r.rrd", "map/parked/at", "Points2D:positions")
    labels = rows(tmp_path / "r.rrd", "map/parked/words", "Points2D:labels")
    for k, distance in ((0, 25.0), (300, 25.0), (750, 212.5), (1499, 400.0)):
        np.testing.assert_allclose(places[k], [[distance, 0.0], [0.0, 0.0]], rtol=1e-6)
        assert labels[k] == ["sensor", f"parked: {distance:,.0f} m away"]
    assert not rows(tmp_path / "r.rrd", "map/legitimate/at", "Points2D:positions")
    assert not GroundMap.applies(run.scene)


def test_both_ends_may_move(tmp_path: Path) -> None:
    """North is up, where Rerun's y axis points down; the lines of the ways bend at every waypoint of the run, and end with it."""
    run: Simulated = simulate(orbit(), 60)
    sender, receiver = Way([[0, 0.0, 10.0], [20, 0.0, 30.0], [90, 70.0, 30.0]]), Way([30.0, -10.0])
    scene = replace(run.scene, ways={"smart": (sender, receiver)})
    recording = ViewRecording(tmp_path / "r.rrd", scene)
    recording.add(run.slots)
    assert recording.close()
    places = rows(tmp_path / "r.rrd", "map/smart/at", "Points2D:positions")
    np.testing.assert_allclose(places[0], [[0.0, -10.0], [30.0, 10.0]])
    np.testing.assert_allclose(places[59], [[39.0, -30.0], [30.0, 10.0]])
    labels = rows(tmp_path / "r.rrd", "map/smart/words", "Points2D:labels")
    assert [labels[k][1] for k in (0, 20)] == ["smart: 36 m away", "smart: 50 m away"]
    ways = GroundMap(scene).styles()["map/smart/ways"]
    assert isinstance(ways, rr.LineStrips2D)
    assert ways.strips is not None
    lines = ways.strips.as_arrow_array().to_pylist()
    assert lines == [[[0.0, -10.0], [0.0, -30.0], [39.0, -30.0]], [[30.0, 10.0], [30.0, 10.0]]]
    assert GroundMap.applies(scene)
    assert not GroundMap.applies(replace(scene, moving=("P (kW)",)))
