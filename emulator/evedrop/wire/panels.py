"""The views of a wire and their contents: lanes, rates, delays, the graph of sides, a table and events.

The graph has a box for each side, and on the way from one to another a box for each link with its losses.

Source: docs/wire/results.md, the view.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from evedrop.model.process import Floats
from evedrop.show.view.column import ELAPSED, laid_out
from evedrop.show.view.event_log import EventLog, LogLine
from evedrop.show.view.palette import TRUTH, dim, series
from evedrop.show.view.panels.curves import time_series
from evedrop.show.view.panels.fates import LETTER, LINE, DrawnGraph, StateLanes
from evedrop.wire.plan import WirePlan
from evedrop.wire.time_steps import (
    DELIVERED,
    LANE,
    Counts,
    CutWatcher,
    LaneState,
    Notice,
    NoticeWatcher,
    WireSteps,
    legend,
    loss_state_of,
    quantile,
    state_of,
    why,
)

_LANES, _RATES, _DELAYS, _TABLE, _EVENTS = "links", "rates", "delays", "table", "events"
_WHOLE = "–"
_ROOM = 0.24  # of the window, to the right of the present, kept free for the legend
_LANES_OF_A_SCREEN = 17.0  # lanes that would fill the usual window from top to bottom
_MOST_IN_LEGEND = 6  # links


@dataclass(frozen=True)
class Pace:
    """How finely a view shows time. A lane of more than some 130 steps would turn grey, because they are too narrow."""

    step: float = 0.2
    """Seconds of a step."""
    window: float = 24.0
    """Seconds of the time axes."""
    whole: bool = False
    """Whether the window is all that there is."""

    @classmethod
    def of_length(cls, seconds: float) -> Pace:
        """For the whole of a wire that has ended, in at most 130 steps of a multiple of 0.1 s."""
        step = 0.1 * max(1.0, float(np.ceil(seconds / 13.0 - 1e-9)))
        return cls(step, max(seconds, 10.0), True)

    @property
    def steps_per_rate(self) -> int:
        """The number of steps over which rates and delays are measured: 0.6 seconds, or one step."""
        return max(1, round(0.6 / self.step))


@final
class WirePanels:
    """The panels of one recording."""

    def __init__(self, plan: WirePlan, pace: Pace) -> None:
        self._plan, self._pace = plan, pace
        self._names = [link.name for link in plan.links]
        digits = len(str(len(self._names)))
        self._lanes = StateLanes(_LANES, [(name, LANE) for name in self._names], first=1)
        self._cut_path = f"{_LANES}/{'0' * digits}_cut"
        self._graph = WireGraph(plan)
        self._watcher = NoticeWatcher(self._names, pace.step)
        self._cuts = CutWatcher(plan.links)
        self._cut_word = ""
        self._cut_words: dict[str, str] = {}
        self._next = 0
        self._last_counts: Counts | None = None
        self._last_delays: Counts | None = None
        self._total: Counts | None = None
        self._log = EventLog()
        self._recent: deque[Counts] = deque(maxlen=max(1, round(pace.window / pace.step)))

    def layout(self) -> rrb.Blueprint:
        """All views on two sides."""
        pace = self._pace
        axis = rrb.TimeAxis(
            view_range=rrb.TimeRange(
                start=rrb.TimeRangeBoundary.cursor_relative(seconds=-pace.window),
                end=rrb.TimeRangeBoundary.cursor_relative(seconds=_ROOM * pace.window),
            ),
            zoom_lock=True,
        )
        past = "since the start" if pace.whole else f"in the last {pace.window:g} s"
        links = len(self._names)
        lanes = min(0.5, (links + 2.6) / _LANES_OF_A_SCREEN)
        left = rrb.Vertical(
            rrb.StateTimelineView(name=f"Links   {legend(self._plan)}", origin=_LANES, time_view=axis),
            _curves(
                "Messages per second   dim: heard, bright: delivered", _RATES, axis, named=0 < links <= _MOST_IN_LEGEND
            ),
            _curves("Delay of delivered messages (ms)   dim: 99 %, bright: median", _DELAYS, axis, named=False),
            row_shares=[2.0 * lanes / (1.0 - lanes), 1.1, 0.9],
        )
        right = rrb.Vertical(
            self._graph.view(f"Losses {past}   coloured as the lanes"),
            rrb.TextDocumentView(name="What became of the messages since the start", origin=_TABLE),
            rrb.TextDocumentView(name="Events", origin=_EVENTS),
            row_shares=[1.1, 0.4 + 0.13 * min(links, 10), 1.0],
        )
        return laid_out(rrb.Horizontal(left, right, column_shares=[1.25, 1.0], name="Wire"), ELAPSED)

    def style(self, to: rr.RecordingStream) -> None:
        """Record names and colours, once."""
        for path, lane in self._lanes.styles().items():
            to.log(path, lane, static=True, strict=True)
        bright = series(len(self._names))
        colours = [*bright, *(dim(shade) for shade in bright)]
        widths = [2.0] * len(bright) + [1.2] * len(bright)
        for path, first in ((_RATES, "heard"), (_DELAYS, "99 %")):
            names = [*self._names, *(f"{name} {first}" for name in self._names)]
            to.log(path, rr.SeriesLines(names=names, colors=colours, widths=widths), static=True, strict=True)
        self._graph.style(to)

    def notes(self, notices: Sequence[Notice], to: rr.RecordingStream) -> None:
        """Record lines of the events."""
        times = [round(notice.seconds, 1) for notice in notices]
        at, texts = self._log.add(
            [LogLine(time, f"{time:g} s", *notice[1:]) for time, notice in zip(times, notices, strict=True)]
        )
        if at:
            documents = rr.TextDocument.columns(text=texts, media_type=["text/plain"] * len(texts))
            _send(to, _EVENTS, at, documents)

    def send(self, steps: WireSteps, to: rr.RecordingStream) -> None:
        """Record the next steps."""
        if self._total is None or steps.first != self._next:
            self._reset(steps)
        begins = np.asarray(steps.numbers * self._pace.step, np.float64)
        ends = begins + np.float64(self._pace.step)
        self._next = steps.first + len(begins)
        self._send_rates(steps, ends, to)
        self._send_lanes(steps.counts, begins, to)
        self._send_graph(steps.counts, ends, to)
        self.notes(self._watcher.watch(steps), to)

    def end(self, to: rr.RecordingStream) -> None:
        """Record that nothing follows: otherwise the last state of a lane would continue."""
        last = [(path, LaneState.QUIET.word) for path in self._lanes.paths]
        for path, word in (*last, (self._cut_path, _WHOLE)):
            _send(to, path, [self._next * self._pace.step], rr.StateChange.columns(state=[word]))

    def _reset(self, steps: WireSteps) -> None:
        """Forget the steps before these: at the beginning they are not known, and after a silence they had no messages."""
        before = 0 if self._total is None else self._pace.steps_per_rate - 1
        self._last_counts = np.zeros((before, *steps.counts.shape[1:]), np.int64)
        self._last_delays = np.zeros((before, *steps.delays.shape[1:]), np.int64)
        if self._total is None:
            self._total = np.zeros(steps.counts.shape[1:], np.int64)
        else:  # the graph forgets values older than its window
            silent = np.zeros(steps.counts.shape[1:], np.int64)
            self._recent.extend(silent for _ in range(min(steps.first - self._next, self._recent.maxlen or 0)))

    def _send_rates(self, steps: WireSteps, ends: Floats, to: rr.RecordingStream) -> None:
        if not self._names:
            return
        over = self._pace.steps_per_rate
        counts, self._last_counts = _sliding(self._last_counts, steps.counts, over)
        delays, self._last_delays = _sliding(self._last_delays, steps.delays, over)
        if not len(counts):
            return
        seconds = over * self._pace.step
        ends = ends[-len(counts) :]
        rates = np.maximum(np.concatenate([counts[:, :-1, DELIVERED], counts[:, :-1].sum(2)], 1), 0) / seconds
        _send_series(to, _RATES, ends, rates)
        quantiles = [quantile(delays[:, :-1], steps.middles[:-1], fraction) for fraction in (0.5, 0.99)]
        _send_series(to, _DELAYS, ends, 1e3 * np.concatenate(quantiles, 1))

    def _send_lanes(self, counts: Counts, begins: Floats, to: rr.RecordingStream) -> None:
        self._send_cuts(counts, begins, to)
        states = list(LaneState)
        codes = (np.array([states.index(state_of(step)) for step in counts[:, i]]) for i in range(len(self._names)))
        for path, at, words in self._lanes.changes(codes):
            _send(to, path, begins[at], words)

    def _send_cuts(self, counts: Counts, begins: Floats, to: rr.RecordingStream) -> None:
        for begin, step in zip(begins, counts, strict=True):
            self._cuts.watch(step)
            word = ", ".join(self._cuts.cut()) or _WHOLE
            if word != self._cut_word:
                self._cut_word = word
                self._cut_words[word] = " " if word == _WHOLE else word
                colours = [
                    LaneState.QUIET.colour if step == _WHOLE else LaneState.CUT.colour for step in self._cut_words
                ]
                labels = [*self._cut_words.values()]
                shown = rr.StateConfiguration(values=[*self._cut_words], labels=labels, colors=colours)
                to.log(self._cut_path, shown, static=True, strict=True)
                _send(to, self._cut_path, [begin], rr.StateChange.columns(state=[word]))

    def _send_graph(self, counts: Counts, ends: Floats, to: rr.RecordingStream) -> None:
        assert self._total is not None  # noqa: S101 - send makes it
        recent, texts = [], []
        for at, step in enumerate(counts, start=1):
            self._recent.append(step)
            self._total = self._total + step
            if self._pace.whole or at == len(counts):  # nobody sees those in between while they come
                recent.append(self._total if self._pace.whole else np.sum(self._recent, 0))
                texts.append(self._table(self._total))
        ends = ends[-len(texts) :]
        _send(to, GRAPH, ends, self._graph.columns(recent))
        markdown = ["text/markdown"] * len(texts)
        _send(to, _TABLE, ends, rr.TextDocument.columns(text=texts, media_type=markdown))

    def _table(self, total: Counts) -> str:
        lines = ["| link | way | heard | lost | why |", "|---|---|---:|---:|---|"]
        for link, counts in zip(self._plan.links, total, strict=False):
            way = f"{link.source} → {link.target}"
            lines.append(
                f"| {link.name} | {way} | {counts.sum():,} | {loss_of(counts).removesuffix(' lost')} | {why(counts)} |"
            )
        if total[-1].any():
            lines.append(f"| no link | | {total[-1].sum():,} | | {why(total[-1])} |")
        return "\n".join(lines)


def _curves(title: str, path: str, axis: rrb.TimeAxis, *, named: bool) -> rrb.TimeSeriesView:
    corner = rrb.PlotLegend(rrb.Corner2D.RightTop, visible=named)
    return time_series(title, axis, origin=path, plot_legend=corner)


def _sliding(before: Counts | None, counts: Counts, over: int) -> tuple[Counts, Counts]:
    """Sums of `over` consecutive steps that end with each of the new ones, and the steps that the next call needs.

    A step that has fewer than `over` - 1 known steps before it has no sum.
    """
    assert before is not None  # noqa: S101 - send makes it
    joined = np.concatenate([before, counts])
    sums = np.zeros((len(joined) + 1, *joined.shape[1:]), np.int64)
    np.cumsum(joined, axis=0, out=sums[1:])
    return sums[over:] - sums[: max(0, len(sums) - over)], joined[max(0, len(joined) - over + 1) :]


def _send_series(to: rr.RecordingStream, path: str, seconds: Floats, values: Floats) -> None:
    """Values at c times, (c, curves), as curves of one entity."""
    columns = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))
    _send(to, path, seconds, columns)


def _send(to: rr.RecordingStream, path: str, seconds: Iterable[float], columns: rr.ComponentColumnList) -> None:
    at = np.round(np.asarray(seconds) * 1e6).astype("timedelta64[us]")
    to.send_columns(path, indexes=[rr.TimeColumn(ELAPSED, duration=at)], columns=columns, strict=True)


GRAPH = "graph"
"""The graph's path in the recording."""
_LONGEST = ": 12.3 % lost"


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
            colours += [state.colour for state in states]
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
