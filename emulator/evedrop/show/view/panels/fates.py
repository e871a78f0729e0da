"""The panels of what became of packets and of what each receiver knows: lanes over time, and a graph of the last packet.

The lanes below each other show a word at every time; only changes are recorded. The graph has the sensor, the router and the
receivers. Its nodes have fixed places and changing labels. Rerun draws no labels on edges, so a link is a node between the nodes
that it joins. The view of a wire has lanes and a graph of the same classes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from evedrop.score.synchronisation import Synchronisation
from evedrop.show.view import lanes
from evedrop.show.view.attacks import LASTING, Attacks, lane_count
from evedrop.show.view.column import Column
from evedrop.show.view.lanes import ErrorDistance, KnowledgeLane, Lane, knowledge
from evedrop.show.view.palette import ALARM, MISLED, STEEL, TRUTH, Colour, letters
from evedrop.show.view.panels.curves import recent_slots
from evedrop.show.view.panels.panel import FIXED_HEIGHT, PlacedView, ViewPanel, crowded, lanes_height
from evedrop.show.view.panels.plane import frames
from evedrop.show.view.scene import Scene, SceneSlots, Shown


@final
class StateLanes:
    """The lanes of one view."""

    def __init__(
        self, origin: str, lanes: Iterable[tuple[str, Lane]], first: int, labels: Sequence[Sequence[str]] | None = None
    ) -> None:
        """origin: the path of the view; lanes: each with its name; first: the number of the first lane.

        labels: what each lane shows for its words; by default nothing, because a slot is too narrow for a word, and a legend
        says what the colours mean.
        """
        given = list(lanes)
        self._lanes = [lane for _, lane in given]
        self._labels = labels or [[" "] * len(lane.words) for lane in self._lanes]
        # The viewer sorts lanes by path, hence the numbers.
        digits = len(str(first + len(given) - 1))
        self.paths = [
            f"{origin}/{rr.escape_entity_path_part(f'{i:0{digits}d}_{name}')}"
            for i, (name, _) in enumerate(given, first)
        ]
        self._last = [-1] * len(given)

    def styles(self) -> dict[str, rr.StateConfiguration]:
        """The words and colours of each lane."""
        return {
            path: rr.StateConfiguration(values=lane.words, labels=labels, colors=lane.colours)
            for path, lane, labels in zip(self.paths, self._lanes, self._labels, strict=True)
        }

    def changes(
        self, codes: Iterable[NDArray[np.integer]]
    ) -> Iterator[tuple[str, NDArray[np.intp], rr.ComponentColumnList]]:
        """The path of each lane that changes in the next c steps, the steps, and the words; codes: of each lane, (c,)."""
        for i, (path, lane, steps) in enumerate(zip(self.paths, self._lanes, codes, strict=True)):
            at = np.flatnonzero(np.diff(steps.astype(np.int64), prepend=self._last[i]))
            self._last[i] = int(steps[-1])
            if len(at):
                yield path, at, states(lane, steps[at])


def states(lane: Lane, codes: Sequence[int] | NDArray[np.integer]) -> rr.ComponentColumnList:
    """The words of codes of a lane, as Rerun's states."""
    words: Any = pa.array(lane.words).take(pa.array(np.asarray(codes)))
    return rr.StateChange.columns(state=words)


_KNOWLEDGE_PATH = "knows"


@final
class WhoKnowsWhat(ViewPanel):
    """A lane for each receiver: its colour is whether it is synchronised, uncertain or overconfident, its words how far off."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._distance = ErrorDistance(scene)
        self._knowledge = [KnowledgeLane(shown, self._distance) for shown in scene.receivers]
        named = [(shown.name, knows.lane) for shown, knows in zip(scene.receivers, self._knowledge, strict=True)]
        self._lanes = StateLanes(_KNOWLEDGE_PATH, named, first=1, labels=[knows.labels for knows in self._knowledge])

    def views(self) -> Iterator[PlacedView]:
        """One view, at the top."""
        title = "Who knows what   how far off · red: eavesdropper follows · light: uncertain · dark: overconfident"
        view = rrb.StateTimelineView(name=title, origin=_KNOWLEDGE_PATH, time_view=recent_slots(self.scene))
        yield PlacedView(view, "top", 1.2, lanes_height(len(self.scene.receivers)))

    def styles(self) -> dict[str, rr.StateConfiguration]:
        """Words and colours."""
        return self._lanes.styles()

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """The lanes' changes."""
        for shown, path, knows in zip(self.scene.receivers, self._lanes.paths, self._knowledge, strict=True):
            peer = slots.peers[shown.name]
            distances = self._distance.of(slots.x, peer.x_hat)
            levels = knowledge(self.scene, slots.x, peer.x_hat, peer.P)
            k, codes = knows.changes(slots.first, levels, distances)
            if len(k):
                yield Column(path, k, states(knows.lane, codes))


_PACKETS_PATH = "packets"


@final
class Packets(ViewPanel):
    """The lanes of sensor and receivers."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        names = ["sent", *(shown.name for shown in scene.receivers)]
        shown_lanes = [lanes.sent_lane(scene), *(lanes.lane_of(shown, scene) for shown in scene.receivers)]
        self._attacks = Attacks(scene)
        named = [*zip(names, shown_lanes, strict=True), *self._attacks.lanes()]
        labels = [lane.words if name == LASTING else [" "] * len(lane.words) for name, lane in named]
        self._lanes = StateLanes(_PACKETS_PATH, named, first=0, labels=labels)

    def views(self) -> Iterator[PlacedView]:
        """One view, as high as the lanes need: above the events, or, with many receivers or a closed loop, at the top."""
        view = rrb.StateTimelineView(name="Packets", origin=_PACKETS_PATH, time_view=recent_slots(self.scene))
        receivers, attacks = len(self.scene.receivers), lane_count(self.scene)
        strip = rrb.StateTimelineView(
            name=f"Packets sent   {self._brightness}{self._attacks.title}",
            origin=_PACKETS_PATH,
            contents=[self._lanes.paths[0], *self._lanes.paths[1 + receivers :]],
            time_view=recent_slots(self.scene),
        )
        yield PlacedView(strip, "strip", 1.5, lanes_height(1 + attacks))
        height = lanes_height(receivers + 1 + attacks)
        if self.scene.moving or crowded(self.scene):
            yield PlacedView(view, "top", height=height)
        else:
            column = 1.0 - FIXED_HEIGHT - lanes_height(receivers)
            yield PlacedView(view, "left", height / (column - height))

    @property
    def _brightness(self) -> str:
        """What the strip's brightness stands for, in the words of the scheme."""
        scheme = lanes.scheme_of(self.scene)
        tones = zip(("bright", "dark"), scheme.sent_words, strict=False)
        silent = ["black: silence"] if scheme.may_be_silent else []
        return ", ".join([*(f"{tone}: {word}" for tone, word in tones), *silent])

    def styles(self) -> dict[str, rr.StateConfiguration]:
        """Colours; the legend says what they mean."""
        return self._lanes.styles()

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """The lanes' changes."""
        lanes_of = [lanes.sent(slots), *(lanes.received(shown, slots) for shown in self.scene.receivers)]
        for path, at, words in self._lanes.changes([*lanes_of, *self._attacks.codes(slots)]):
            yield Column(path, slots.numbers[at], words)


LETTER, LINE = 7.0, 38.0
"""Width of a letter and distance of boxes in Rerun's drawing."""
_RADIUS = 4.0

Place = tuple[float, float]


@dataclass(frozen=True)
class DrawnGraph:
    """The nodes and edges of a graph, at a path of the recording."""

    path: str
    nodes: dict[str, Place]
    """Id → place, in the order of labels and colours."""
    edges: tuple[tuple[str, str], ...]
    """From one id to another."""

    def view(self, title: str, margin: tuple[float, float]) -> rrb.GraphView:
        """The view of the graph; margin: what is shown beyond the outermost nodes, to the sides, and above and below."""
        ranges = []
        for axis, room in enumerate(margin):
            at = [place[axis] for place in self.nodes.values()]
            ranges.append((min(at) - room, max(at) + room))
        bounds = rrb.VisualBounds2D(x_range=ranges[0], y_range=ranges[1])
        return rrb.GraphView(name=title, origin=self.path, visual_bounds=bounds)

    def style(self) -> list[rr.DescribedComponentBatch]:
        """The edges, and which nodes are where, to be recorded once at the path."""
        nodes = rr.GraphNodes([*self.nodes], positions=[*self.nodes.values()], radii=[_RADIUS] * len(self.nodes))
        edges = rr.GraphEdges([*self.edges], graph_type="directed")
        return [*nodes.as_component_batches(), *edges.as_component_batches()]

    def columns(self, labels: Sequence[str], colours: Sequence[Colour]) -> rr.ComponentColumnList:
        """Labels and colours of all nodes at some times: those of the first time, then those of the second, and so on."""
        lengths = [len(self.nodes)] * (len(labels) // len(self.nodes))
        words: Any = pa.array(labels, pa.utf8())
        inks = np.array([letters(colour) for colour in colours], np.uint8)
        return rr.GraphNodes.columns(labels=words, colors=inks).partition(lengths)


_GRAPH_PATH = "graph"
_SENSOR, _ROUTER = "the sensor", "the router"
_LINKS, _RECEIVERS = 150.0, 320.0  # where their columns are, right of sensor and router
FATES: tuple[Colour, ...] = (STEEL, TRUTH, TRUTH, STEEL, STEEL, MISLED)
"""The colour of each code of a lane: bright where the packet was used, sand where it misled, steel where it was not used."""


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
        self._drawn = DrawnGraph(_GRAPH_PATH, nodes, tuple(edges))

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Not for a closed loop."""
        return not scene.moving

    def views(self) -> Iterator[PlacedView]:
        """One view, right of the strip; with many receivers, packets have this place, and the letters would be too small."""
        if crowded(self.scene):
            return
        longest = max(len(shown.name) for shown in self.scene.receivers) + len(": 0.00032 m off")
        view: rrb.View = self._drawn.view("The last packet, and how far off each is", (LETTER * longest / 2, LINE / 2))
        yield PlacedView(view, "top", 0.8, lanes_height(len(self.scene.receivers)))

    def styles(self) -> dict[str, list[rr.DescribedComponentBatch]]:
        """The edges, and where the nodes are."""
        return {_GRAPH_PATH: self._drawn.style()}

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Labels and colours of all nodes at the frames."""
        at = frames(self.scene, slots.first, slots.count)
        if not len(at):
            return
        words = lanes.sent_lane(self.scene).words
        sent = [f"sensor: {words[code]}" for code in lanes.sent(slots)[at].tolist()]
        nodes = [(sent, [TRUTH] * len(at)), (["router"] * len(at), [TRUTH] * len(at))]
        nodes += [self._fates(shown, slots, at) for shown in self.scene.receivers]
        nodes += [self._known(shown, slots, at) for shown in self.scene.receivers]
        labels, colours = (
            [value for frame in zip(*of, strict=True) for value in frame] for of in zip(*nodes, strict=True)
        )
        yield Column(_GRAPH_PATH, slots.numbers[at], self._drawn.columns(labels, colours))

    def _fates(self, shown: Shown, slots: SceneSlots, at: NDArray[np.intp]) -> tuple[list[str], list[Colour]]:
        """The labels and colours of a link at frames."""
        words, codes = lanes.lane_of(shown, self.scene).words, lanes.received(shown, slots)[at].tolist()
        return [words[code] for code in codes], [FATES[code] for code in codes]

    def _known(self, shown: Shown, slots: SceneSlots, at: NDArray[np.intp]) -> tuple[list[str], list[Colour]]:
        """The labels and colours of a receiver at frames."""
        x, x_hat, P = slots.x[at], slots.peers[shown.name].x_hat[at], slots.peers[shown.name].P[at]
        inks = [self._ink(shown, status) for status in Synchronisation]
        distances = self._distance.of(x, x_hat).tolist()
        return (
            [f"{shown.name}: {self._distance.text(distance)} off" for distance in distances],
            [inks[status] for status in knowledge(self.scene, x, x_hat, P).tolist()],
        )

    def _ink(self, shown: Shown, status: Synchronisation) -> Colour:
        """The receiver's own colour, unless it is an eavesdropper that knows the state."""
        spied = shown.role != "legitimate" and status is Synchronisation.SYNCHRONISED
        return ALARM if spied else self.scene.colours[shown.name]
