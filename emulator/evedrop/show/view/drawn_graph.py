"""A graph whose nodes have fixed places and changing labels, such as that of a run or of a wire.

Rerun draws no labels on edges, so a link is a node between the nodes that it joins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb

from evedrop.show.view.palette import Colour

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

    def style(self) -> rr.AsComponents:
        """The edges, and which nodes are where, to be recorded once at the path."""
        nodes = rr.GraphNodes([*self.nodes], positions=[*self.nodes.values()], radii=[_RADIUS] * len(self.nodes))
        return _Together((nodes, rr.GraphEdges([*self.edges], graph_type="directed")))

    def columns(self, labels: Sequence[str], colours: Sequence[Colour]) -> rr.ComponentColumnList:
        """Labels and colours of all nodes at some times: those of the first time, then those of the second, and so on."""
        lengths = [len(self.nodes)] * (len(labels) // len(self.nodes))
        return rr.GraphNodes.columns(labels=labels, colors=colours).partition(lengths)


@dataclass(frozen=True)
class _Together:
    """Several of Rerun's archetypes as one."""

    parts: tuple[rr.AsComponents, ...]

    def as_component_batches(self) -> list[rr.DescribedComponentBatch]:
        """The components of all."""
        return [batch for part in self.parts for batch in part.as_component_batches()]
