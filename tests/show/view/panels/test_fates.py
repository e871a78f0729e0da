"""The graph of a run: the fate of the last packet on every link, and what each receiver knows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evedrop.model.process import Trajectory
from evedrop.model.receiver import Action
from evedrop.model.schemes import SCHEMES
from evedrop.model.streams import Batch
from evedrop.score.synchronisation import Synchronisation
from evedrop.show.view import lanes
from evedrop.show.view.lanes import knowledge
from evedrop.show.view.palette import (
    ALARM,
    MISLED,
    STEEL,
    TRUTH,
    Colour,
    letters,
)
from evedrop.show.view.panels.fates import FATES, LastPacket, Packets
from evedrop.show.view.recording import ViewRecording
from tests.builders import stream_keys
from tests.show.view.read_back import rows
from tests.show.view.simulated_run import Simulated, orbit

COLOURS = {
    "state": TRUTH,
    "innovation": TRUTH,
    "misled": MISLED,
    **dict.fromkeys(("dropped", "discarded", "silent"), STEEL),
}
"""Fate → its colour, which has almost no hue."""


def coloured(rgba: int) -> Colour:
    """A colour as it is in a recording, in bytes of red, green, blue and opacity."""
    red, green, blue, _ = rgba.to_bytes(4)
    return red, green, blue


def test_the_graph_tells_fates_and_errors(simulated: Callable[..., Simulated], tmp_path: Path) -> None:
    """In every frame: what was sent, what became of it on each link, and how far off each receiver is."""
    run = simulated(60)
    recording = ViewRecording(tmp_path / "r.rrd", run.scene)
    for slots in run.chunks(7):
        recording.add(slots)
    assert recording.close()
    labels = rows(tmp_path / "r.rrd", "graph", "GraphNodes:labels")
    colours = rows(tmp_path / "r.rrd", "graph", "GraphNodes:colors")
    assert sorted(labels) == list(range(60))
    receivers, nothing = run.scene.receivers, 1e-3 * np.sqrt(run.scene.noise)
    for k, shown in labels.items():
        assert shown[:2] == [f"sensor: {'innovation' if run.slots.nu[k] else 'state'}", "router"]
        assert [coloured(code) for code in colours[k][:2]] == [letters(TRUTH)] * 2
        for i, receiver in enumerate(receivers):
            peer = run.slots.peers[receiver.name]
            word = lanes.lane_of(receiver, run.scene).words[int(lanes.received(receiver, run.slots)[k])]
            assert shown[2 + i] == word
            status = Synchronisation(knowledge(run.scene, run.slots.x, peer.x_hat, peer.P)[k])
            name, _, rest = shown[2 + len(receivers) + i].partition(": ")
            assert name == receiver.name
            inks = [coloured(colours[k][at + i]) for at in (2, 2 + len(receivers))]
            own = run.scene.colours[receiver.name]
            spied = receiver.role == "eavesdropper" and status is Synchronisation.SYNCHRONISED
            assert inks == [letters(COLOURS[word]), letters(ALARM if spied else own)]
            distance = float(rest.removesuffix(" off").replace(",", ""))
            assert np.isclose(distance, np.linalg.norm(run.slots.x[k] - peer.x_hat[k]), rtol=0.05, atol=nothing)


def test_every_fate_has_a_colour() -> None:
    """The graph can show everything that a lane shows."""
    assert [COLOURS[word] for word in lanes.EAVESDROPPER.words] == list(FATES)


@pytest.mark.parametrize("name", [*SCHEMES.names, "mine:Masked"])
def test_words_are_those_of_the_scheme(name: str, simulated: Callable[..., Simulated]) -> None:
    """Sensor, links and legend agree; only a scheme that sends innovations, or may be silent, has words for them."""
    scene = simulated(20).scene
    scene = replace(scene, receivers=(replace(scene.receivers[0], strategy=name), *scene.receivers[1:]))
    listed = dict(lanes.legend(scene))
    sent, ours, theirs = lanes.sent_lane(scene), *(lanes.lane_of(shown, scene) for shown in scene.receivers[:2])
    words = ("state", "innovation") if name == "mine:Masked" else SCHEMES[name].sent_words
    assert sent.words[: len(words)] == words
    assert listed[words[0]] == sent.colours[0] == ours.colours[Action.STATE]
    assert ("silence" in listed) == (name in {"scheduled", "withholding", "mine:Masked"})
    told = " ".join(
        [*listed, *ours.words, *theirs.words, *(str(placed.view.name) for placed in Packets(scene).views())]
    )
    assert ("innovation" in told) == ("innovation" in words)
    used = ours.words[Action.INNOVATION], ours.colours[Action.INNOVATION]
    if "innovation" in words:
        assert used == ("innovation", listed["innovation decoded"])
    else:
        assert used == (words[0], listed[words[0]])
        assert (theirs.words[Action.INNOVATION], theirs.colours[Action.INNOVATION]) == ("read", listed["read"])
    alone = replace(scene, receivers=scene.receivers[:1])
    assert not {"read", "misled by innovation", "misled by noise"} & dict(lanes.legend(alone)).keys()


@pytest.mark.parametrize("name", [name for name in SCHEMES.names if len(SCHEMES[name].sent_words) == 1])
def test_a_scheme_with_one_word_sends_one_type(name: str) -> None:
    """No packet has ν = 1."""
    n, slots = 2, 60
    process = orbit(n)
    scheme = SCHEMES[name](process, **SCHEMES[name].parameters)
    batch = Batch(slots, 3)
    streams = ("process", *SCHEMES[name].secret_streams)
    keys = stream_keys(5, streams)
    encoder, trajectory = scheme.encoder(keys, batch), Trajectory(process, keys["process"], batch)
    for k in range(slots):
        assert not encoder.encode(k, trajectory.advance(), trajectory.predicted).nu.any()


def test_a_closed_loop_has_no_graph(simulated: Callable[..., Simulated]) -> None:
    """The view of a closed loop has panels of the plant instead."""
    scene = simulated(20).scene
    assert LastPacket.applies(scene)
    assert not LastPacket.applies(replace(scene, moving=("P (kW)",)))


def test_with_many_receivers_the_lanes_of_packets_have_its_place(simulated: Callable[..., Simulated]) -> None:
    """Docs/view.md: with more than four receivers; the letters of the graph would be too small."""
    scene = simulated(20, copies=2).scene
    for count in (1, 4, 5, 7):
        some = replace(scene, receivers=scene.receivers[:count])
        strip, packets = Packets(some).views()
        assert strip.side == "strip"
        drawn = [*LastPacket(some).views()]
        assert (len(drawn), packets.side) == ((1, "left") if count <= 4 else (0, "top"))
