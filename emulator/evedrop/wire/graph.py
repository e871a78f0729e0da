"""The graph of a wire's sides: a box for each side, and on the way from one to another a box for each link with its losses.

Source: docs/wire.md, the view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import final

import rerun as rr
import rerun.blueprint as rrb

from evedrop.show.view.drawn_graph import LETTER, LINE, DrawnGraph
from evedrop.show.view.palette import DROPPED_TEXT, TRUTH, TRUTH_CURVE
from evedrop.wire.lane_states import LaneState, loss_state_of
from evedrop.wire.plan import WirePlan
from evedrop.wire.step_counts import DELIVERED, Counts

GRAPH = "graph"
"""The graph's path in the recording."""
_LONGEST = ": 12.3 % lost"
_TEXTS = {LaneState.QUIET: TRUTH_CURVE, LaneState.MOST: DROPPED_TEXT}  # for states whose lane is too dark for letters


@final
class WireGraph:
    """The nodes and edges of one wire; their places are fixed."""

    def __init__(self, plan: WirePlan) -> None:
        self._links = plan.links
        self._sides = tuple(plan.sides)
        ids = [*(f"side {name}" for name in self._sides), *(f"link {link.name}" for link in plan.links)]
        edges: list[tuple[str, str]] = []
        for link in self._links:
            edges += [(f"side {link.source}", f"link {link.name}"), (f"link {link.name}", f"side {link.target}")]
        self._drawn = DrawnGraph(GRAPH, dict(zip(ids, _places(plan), strict=True)), tuple(edges))

    def view(self, title: str) -> rrb.GraphView:
        """The view of the graph."""
        margin = LETTER * (4 + max(len(name) for name in self._sides)) / 2
        return self._drawn.view(title, (margin, LINE / 2))

    def style(self, to: rr.RecordingStream) -> None:
        """Record the edges, and which nodes are where."""
        to.log(GRAPH, self._drawn.style(), static=True, strict=True)

    def columns(self, recent: Sequence[Counts]) -> rr.ComponentColumnList:
        """Labels and colours of the nodes at c times.

        recent: what became of messages in the recent past, c times (links or more, outcomes).
        """
        labels, colours = [], []
        for counts in recent:
            labels += [*self._sides, *(f"{link.name}: {loss_of(counts[at])}" for at, link in enumerate(self._links))]
            colours += [TRUTH] * len(self._sides)
            states = [loss_state_of(counts[at]) for at in range(len(self._links))]
            colours += [_TEXTS.get(state, state.colour) for state in states]
        return self._drawn.columns(labels, colours)


def loss_of(counts: Counts) -> str:
    """The fraction of messages that were not delivered, as a text; counts: (outcomes,)."""
    heard = int(counts.sum())
    if not heard:
        return "silent"
    lost = 1.0 - int(counts[DELIVERED]) / heard
    digits = 0 if lost in {0.0, 1.0} or 0.0995 <= lost < 0.99 else 1 if lost >= 0.00095 else 3
    return f"{100.0 * lost:.{digits}f} % lost"


def _places(plan: WirePlan) -> list[tuple[float, float]]:
    """The places of all sides, on an ellipse around the origin, then of all links, between their sides."""
    sides = [*plan.sides]
    turns = [2.0 * math.pi * i / len(sides) for i in range(len(sides))]
    across, down = [-math.cos(turn) for turn in turns], [-math.sin(turn) for turn in turns]
    pairs = [frozenset((link.source, link.target)) for link in plan.links]
    label = max([len(link.name) for link in plan.links], default=0) + len(_LONGEST) + max(len(name) for name in sides)
    width = LETTER * label / 2 + 60.0
    height = LINE * max(1.6, *(0.6 * pairs.count(pair) for pair in pairs)) if pairs else LINE
    xs, ys = _spread(across, width), _spread(down, height if len(sides) > 2 else 0.0)
    at = dict(zip(sides, zip(xs, ys, strict=True), strict=True))
    places = [*at.values()]
    for i, link in enumerate(plan.links):
        rank, of = pairs[:i].count(pairs[i]), pairs.count(pairs[i])
        (x0, y0), (x1, y1) = at[link.source], at[link.target]
        places.append(((x0 + x1) / 2, (y0 + y1) / 2 + LINE * (rank - (of - 1) / 2)))
    return places


def _spread(values: list[float], reach: float) -> list[float]:
    """The values, moved and scaled so that they go from -reach to reach."""
    low, high = min(values), max(values)
    return [reach * (2.0 * (value - low) / (high - low) - 1.0) if high - low > 1e-9 else 0.0 for value in values]
