"""The graph of a run: the fate of the last packet on every link, and what each receiver knows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from evedrop.view import lanes
from evedrop.view.knowledge import KNOWLEDGE, knowledge
from evedrop.view.palette import RUN_TEXTS
from evedrop.view.panels.fates import FATES, KNOWN, LastPacket
from evedrop.view.recording import ViewRecording
from tests.view.read_back import rows
from tests.view.simulated_run import Simulated


def test_the_graph_tells_fates_and_errors(simulated: Callable[..., Simulated], tmp_path: Path) -> None:
    """In every frame: what was sent, what became of it on each link, and how far off each receiver is."""
    run = simulated(60)
    recording = ViewRecording(tmp_path / "r.rrd", run.scene)
    for slots in run.chunks(7):
        recording.add(slots)
    assert recording.close()
    labels = rows(tmp_path / "r.rrd", "graph", "GraphNodes:labels")
    assert sorted(labels) == list(range(60))
    receivers, nothing = run.scene.receivers, 1e-3 * np.sqrt(run.scene.noise)
    for k, shown in labels.items():
        assert shown[:2] == [f"sensor: {'innovation' if run.slots.nu[k] else 'state'}", "router"]
        for i, one in enumerate(receivers):
            peer = run.slots.peers[one.name]
            word = lanes.lane_of(one).words[int(lanes.received(one, run.slots)[k])]
            assert shown[2 + i] == word
            known = KNOWLEDGE[int(knowledge(run.scene, run.slots.x, peer)[k])]
            name, _, rest = shown[2 + len(receivers) + i].partition(": ")
            what, _, off = rest.partition(", ")
            assert (name, what) == (one.name, known.word)
            distance = float(off.removesuffix(" off").replace(",", ""))
            assert np.isclose(distance, np.linalg.norm(run.slots.x[k] - peer.x_hat[k]), rtol=0.05, atol=nothing)


def test_every_fate_and_state_has_a_colour_of_the_table() -> None:
    """Whatever a lane says, the graph can say it, too."""
    assert {*lanes.LEGITIMATE.words, *lanes.EAVESDROPPER.words} == set(FATES)
    assert set(KNOWN) == set(KNOWLEDGE)
    assert {*FATES.values(), *KNOWN.values()} <= set(RUN_TEXTS)


def test_a_closed_loop_has_no_graph(simulated: Callable[..., Simulated]) -> None:
    """The view of a closed loop has panels of the plant instead."""
    scene = simulated(20).scene
    assert LastPacket.applies(scene)
    assert not LastPacket.applies(replace(scene, moving=("P (kW)",)))
