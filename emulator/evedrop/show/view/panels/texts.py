"""The panels of words: the verdict and the scenario's title, the legend of all panels, and events.

The legend, which says what each colour stands for, does not change. The events are those of the scenario and the
operator, and long stretches without a usable packet.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

from evedrop.score.after_start import BatchMeans, leading_states
from evedrop.score.verdict import Verdict, verdict_so_far
from evedrop.show.view import lanes
from evedrop.show.view.column import TIMELINE, Column
from evedrop.show.view.events import Event, Watcher
from evedrop.show.view.lanes import received
from evedrop.show.view.palette import GROUND, TRUTH, Colour
from evedrop.show.view.panels.panel import LEGEND_HEIGHT, VERDICT_HEIGHT, PlacedView, ViewPanel, lanes_height
from evedrop.show.view.scene import Scene, SceneSlots

_TITLE_PATH = "title"
_VERDICTS = 60  # of a run that is as fast as possible


@final
class VerdictLine(ViewPanel):
    """Whether the state is kept secret, so far and at the end of the run; and the title, and which trials the panels show."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._states = leading_states(scene.units, scene.n)
        self._batches = {shown.name: BatchMeans() for shown in scene.receivers}
        self._every = max(1, round(1.0 / scene.pace) if scene.pace > 0 else scene.slots // _VERDICTS)
        self._next, self._shown = self._every, ""

    def views(self) -> Iterator[PlacedView]:
        """One view without a title bar, above both tabs."""
        yield PlacedView(rrb.TextDocumentView(origin=_TITLE_PATH, titlebar=False), "verdict", height=VERDICT_HEIGHT)

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """The verdict on the slots so far, about once a second, if it has changed."""
        if not self._shown:
            yield from self._so_far(slots.first)
        at = 0
        while at < slots.count:
            stop = min(slots.count, self._next - slots.first)
            self._add(slots, slice(at, stop))
            at = stop
            if slots.first + at == self._next:
                yield from self._so_far(self._next - 1)
                self._next += self._every

    def _add(self, slots: SceneSlots, some: slice) -> None:
        for name, batches in self._batches.items():
            peer = slots.peers[name]
            apart = (slots.x[some] - peer.x_hat[some])[:, : self._states]
            batches.add(peer.squared_error[some], np.sum(apart * apart, axis=1))

    def _so_far(self, k: int) -> Iterator[Column]:
        (_, ours), *theirs = self._batches.items()
        verdict = verdict_so_far(ours, theirs, self.scene.unit, self.scene.noise, self.scene.trials)
        yield from self._text(k, "" if verdict is None else f"{verdict.sentence}, so far")

    def conclusion(self, k: int, verdict: Verdict) -> Iterator[Column]:
        """The verdict on the run."""
        yield from self._text(k, verdict.sentence)

    def _text(self, k: int, sentence: str) -> Iterator[Column]:
        trials = self.scene.trials
        of = "" if trials == 1 else f" · curves: means of {trials:,} trials, everything else: the first of them"
        title = f"**{_plain(self.scene.title)}**{of}"
        text = f"#### {_plain(sentence)}\n\n{title}" if sentence else f"### {title}"
        if text != self._shown:
            self._shown = text
            documents = rr.TextDocument.columns(text=[text], media_type=["text/markdown"])
            yield Column(_TITLE_PATH, np.array([k], np.int64), documents)


def _plain(text: str) -> str:
    """The text with every character of Markdown escaped."""
    return "".join(f"\\{character}" if character in "\\`*_{}[]()<>#+-.!|~$" else character for character in text)


_LEGEND_PATH = "legend"
_WIDE, _HIGH = 60.0, 44.0  # of the drawing, for each letter and line


@final
class Legend(ViewPanel):
    """A line over the whole width: the receivers' colours, then those of packets. Most colours have a word in one place only."""

    def views(self) -> Iterator[PlacedView]:
        """One view without a title bar, whose range shows all words."""
        width = self._places()[-1][0] + self._width(self._entries()[-1][0]) / 2
        bounds = rrb.VisualBounds2D(x_range=(0.0, width), y_range=(-10.0, 30.0))
        view = rrb.Spatial2DView(origin=_LEGEND_PATH, titlebar=False, background=list(GROUND), visual_bounds=bounds)
        yield PlacedView(view, "legend", height=LEGEND_HEIGHT)

    def styles(self) -> dict[str, rr.AsComponents]:
        """Dots in the colours, and the words below them, which do not change."""
        words, colours = zip(*self._entries(), strict=True)
        places, size = self._places(), rr.Radius.ui_points
        return {
            f"{_LEGEND_PATH}/dots": rr.Points2D(places, colors=colours, radii=size(6.0)),
            f"{_LEGEND_PATH}/words": rr.Points2D(
                places, colors=[TRUTH], radii=size(0.0), labels=words, show_labels=True
            ),
        }

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Nothing: the legend is a style."""
        del slots
        yield from ()

    def _entries(self) -> list[tuple[str, Colour]]:
        return [("truth", TRUTH), *self.scene.colours.items(), *lanes.legend()]

    def _places(self) -> list[tuple[float, float]]:
        places, at = [], 0.0
        for word, _ in self._entries():
            places.append((at + self._width(word) / 2, 0.0))
            at += self._width(word)
        return places

    @staticmethod
    def _width(word: str) -> float:
        return 7.0 * len(word) + 26.0


_EVENTS_PATH = "events"
_RUN = "run"


@final
class Events(ViewPanel):
    """A line for each event, with its slot and level."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._watchers = [(shown, Watcher(shown, scene)) for shown in scene.receivers]

    def views(self) -> Iterator[PlacedView]:
        """Two views: beside the strip of the scene, and at the bottom right of the numbers."""
        yield PlacedView(self._view(), "strip", 1.0, lanes_height(1))
        if self.scene.moving:
            yield PlacedView(self._view(), "right", 0.7)
        else:
            yield PlacedView(self._view(), "right", 0.45)

    @staticmethod
    def _view() -> rrb.TextLogView:
        return rrb.TextLogView(
            name="Events",
            origin=_EVENTS_PATH,
            columns=rrb.TextLogColumns(
                timeline_columns=[TimelineColumn(TIMELINE)],
                text_log_columns=[TextLogColumn("LogLevel"), TextLogColumn("Body")],
            ),
            format_options=rrb.TextLogFormat(monospace_body=True),
        )

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """The events that the watcher of each receiver noticed."""
        for shown, watcher in self._watchers:
            yield from _lines(shown.name, watcher.watch(slots.first, received(shown, slots)))

    def notes(self, notes: Sequence[Event]) -> Iterator[Column]:
        """A line for each note."""
        yield from _lines(_RUN, notes)


def _lines(name: str, events: Sequence[Event]) -> Iterator[Column]:
    """Lines about a receiver or the run."""
    if events:
        k = np.array([event.k for event in events], np.int64)
        texts, levels = [event.text for event in events], [event.level for event in events]
        yield Column(f"{_EVENTS_PATH}/{name}", k, rr.TextLog.columns(text=texts, level=levels))
