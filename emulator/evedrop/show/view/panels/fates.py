"""The graph of sensor, router and receivers: the fate of the last packet on every link, and what each receiver knows."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import rerun.blueprint as rrb
from rerun import AsComponents

from evedrop.model import receiver
from evedrop.score.track import Track
from evedrop.show.view import lanes
from evedrop.show.view.column import Column
from evedrop.show.view.drawn_graph import LETTER, LINE, DrawnGraph, Place
from evedrop.show.view.knowledge import ErrorDistance, knowledge
from evedrop.show.view.palette import DROPPED_TEXT, IN_TRACK_TEXT, MISLED, STATE, TRUTH, TRUTH_CURVE, Colour
from evedrop.show.view.panels.heights import crowded, lanes_height
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.panels.state_plane import frames
from evedrop.show.view.scene import Scene, SceneSlots, Shown

_PATH = "graph"
_SENSOR, _ROUTER = "the sensor", "the router"
_LINKS, _RECEIVERS = 150.0, 320.0  # where their columns are, right of sensor and router
FATES = {
    receiver.STATE: STATE,
    receiver.INNOVATION: STATE,
    receiver.MISLED: MISLED,
    receiver.DISCARDED: TRUTH_CURVE,
    receiver.DROPPED: DROPPED_TEXT,
    receiver.SILENT: TRUTH_CURVE,
}
"""The colour of each word of a lane."""
KNOWN = {Track.IN_TRACK: IN_TRACK_TEXT, Track.DRIFTING: MISLED, Track.FOOLED: DROPPED_TEXT}
"""The colour of what a receiver knows."""


@final
class LastPacket(ViewPanel):
    """The nodes of a run, drawn at the view's frames. Not for a closed loop, whose view has other panels."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._distance = ErrorDistance(scene)
        rows = range(len(scene.receivers))
        middle = LINE * (len(rows) - 1) / 2
        nodes: dict[str, Place] = {_SENSOR: (0.0, middle - LINE / 2), _ROUTER: (0.0, middle + LINE / 2)}
        nodes |= {f"link {i}": (_LINKS, LINE * i) for i in rows}
        nodes |= {f"receiver {i}": (_RECEIVERS, LINE * i) for i in rows}
        edges = [(_SENSOR, _ROUTER)]
        for i in rows:
            edges += [(_ROUTER, f"link {i}"), (f"link {i}", f"receiver {i}")]
        self._drawn = DrawnGraph(_PATH, nodes, tuple(edges))

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Not for a closed loop."""
        return not scene.moving

    def views(self) -> Iterator[PlacedView]:
        """One view, right of the strip; with many receivers, packets have this place, and the letters would be too small."""
        if crowded(self.scene):
            return
        longest = max(len(shown.name) for shown in self.scene.receivers) + len(": drifting, 0.32 m off")
        view: rrb.View = self._drawn.view("The last packet, and what each knows", (LETTER * longest / 2, LINE / 2))
        yield PlacedView(view, "top", 0.8, lanes_height(len(self.scene.receivers)))

    def styles(self) -> dict[str, AsComponents]:
        """The edges, and where the nodes are."""
        return {_PATH: self._drawn.style()}

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Labels and colours of all nodes at the frames."""
        at = frames(self.scene, slots.first, slots.count)
        if not len(at):
            return
        sent = [lanes.SENT.words[code] for code in lanes.sent(slots)[at].tolist()]
        links = [self._fates(shown, slots, at.tolist()) for shown in self.scene.receivers]
        words = [self._known(shown, slots, at.tolist()) for shown in self.scene.receivers]
        labels, colours = [], []
        for k, word in enumerate(sent):
            nodes = [
                (f"sensor: {word}", TRUTH),
                ("router", TRUTH),
                *(column[k] for column in links),
                *(column[k] for column in words),
            ]
            labels += [label for label, _ in nodes]
            colours += [colour for _, colour in nodes]
        yield Column(_PATH, slots.numbers[at], self._drawn.columns(labels, colours))

    @staticmethod
    def _fates(shown: Shown, slots: SceneSlots, at: list[int]) -> list[tuple[str, Colour]]:
        words, codes = lanes.lane_of(shown).words, lanes.received(shown, slots)[at]
        return [(words[code], FATES[words[code]]) for code in codes.tolist()]

    def _known(self, shown: Shown, slots: SceneSlots, at: list[int]) -> list[tuple[str, Colour]]:
        peer = slots.peers[shown.name]
        distances = self._distance.of(slots.x[at], peer.x_hat[at]).tolist()
        tracks = [Track(code) for code in knowledge(self.scene, slots.x, peer)[at].tolist()]
        return [
            (f"{shown.name}: {track.word}, {self._distance.text(distance)} off", KNOWN[track])
            for track, distance in zip(tracks, distances, strict=True)
        ]
