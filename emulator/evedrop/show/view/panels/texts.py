"""The panels of words: the verdict and the scenario's title, the legend of all panels, and events.

The legend, which says what each colour stands for, does not change. The events are those of the scenario and the
operator, and long stretches without a usable packet.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from evedrop.model.process import Floats
from evedrop.score.after_start import BatchMeans, leading_states
from evedrop.score.verdict import Verdict, verdict_so_far
from evedrop.show.view import lanes
from evedrop.show.view.column import Column
from evedrop.show.view.event_log import EventLog, LogLine
from evedrop.show.view.events import AckWatcher, Event, Watcher
from evedrop.show.view.lanes import received, squares
from evedrop.show.view.palette import GROUND, LABEL, TRUTH, Colour
from evedrop.show.view.panels.curves import times_of
from evedrop.show.view.panels.panel import LEGEND_HEIGHT, VERDICT_HEIGHT, PlacedView, ViewPanel, lanes_height
from evedrop.show.view.scene import PeerSlots, Scene, SceneSlots

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
        view = rrb.TextDocumentView(name="Verdict", origin=_TITLE_PATH, titlebar=False)
        yield PlacedView(view, "verdict", height=VERDICT_HEIGHT)

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """The verdict on the slots so far, about once a second, if it has changed."""
        so_far = {slots.first: self._so_far()} if not self._shown else {}
        errors, at = self._errors(slots), 0
        while at < slots.count:
            stop = min(slots.count, self._next - slots.first)
            for name, batches in self._batches.items():
                batches.add(*(values[at:stop] for values in errors[name]))
            at = stop
            if slots.first + at == self._next:
                so_far[self._next - 1] = self._so_far()
                self._next += self._every
        yield from self._texts(so_far)

    def _errors(self, slots: SceneSlots) -> dict[str, tuple[Floats, Floats]]:
        """Receiver → its squared errors, and its squared distances, (c,) each: means over all trials.

        Distances are NaN if they count only some states of several trials: the view has the states of one trial alone.
        """
        return {name: (peer.squared_error, self._squares(slots.x, peer)) for name, peer in slots.peers.items()}

    def _squares(self, x: Floats, peer: PeerSlots) -> Floats:
        if self.scene.trials == 1:
            return squares((x - peer.x_hat)[:, : self._states])
        return peer.squared_error if self._states == self.scene.n else np.full(len(x), np.nan)

    def _so_far(self) -> str:
        (_, ours), *theirs = self._batches.items()
        scene = self.scene
        verdict = verdict_so_far(ours, theirs, scene.unit, scene.noise, scene.trials, of_estimate=scene.of_estimate)
        return "" if verdict is None else f"{verdict.sentence}, so far"

    def conclusion(self, k: int, verdict: Verdict) -> Iterator[Column]:
        """The verdict on the run."""
        yield from self._texts({k: verdict.sentence})

    def _texts(self, sentences: Mapping[int, str]) -> Iterator[Column]:
        """The line from some slots on, where it changes; sentences: slot → what is said of secrecy, in order."""
        trials = self.scene.trials
        curves = f"curves of errors and tr P: means of {trials:,} trials"
        of = "" if trials == 1 else f" · {curves}, everything else: the first of them"
        title = f"**{_plain(self.scene.title)}**{of}"
        new = dict[int, str]()
        for k, sentence in sentences.items():
            text = f"#### {_plain(sentence)}\n\n{title}" if sentence else f"### {title}"
            if text != self._shown:
                self._shown = new[k] = text
        if new:
            documents = rr.TextDocument.columns(text=[*new.values()], media_type=["text/markdown"] * len(new))
            yield Column(_TITLE_PATH, np.array([*new], np.int64), documents)


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
                places, colors=[LABEL], radii=size(0.0), labels=words, show_labels=True
            ),
        }

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Nothing: the legend is a style."""
        del slots
        yield from ()

    def _entries(self) -> list[tuple[str, Colour]]:
        return [(self.scene.compared_with, TRUTH), *self.scene.colours.items(), *lanes.legend(self.scene)]

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


@final
class Events(ViewPanel):
    """The last events so far, the newest first, each with its slot; a warning has its level, too."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._acks = AckWatcher(scene)
        self._watchers = [(shown, Watcher(shown, scene)) for shown in scene.receivers]
        self._log = EventLog()
        self._times = times_of(scene)

    def views(self) -> Iterator[PlacedView]:
        """Two views: beside the strip of the scene, and at the bottom right of the numbers."""
        yield PlacedView(self._view(), "strip", 1.0, lanes_height(1))
        yield PlacedView(self._view(), "right", 0.55 if self.scene.moving else 0.45)

    @staticmethod
    def _view() -> rrb.TextDocumentView:
        return rrb.TextDocumentView(name="Events", origin=_EVENTS_PATH)

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """The events that the watchers of receivers and of acknowledgements noticed."""
        events = [
            event for shown, watcher in self._watchers for event in watcher.watch(slots.first, received(shown, slots))
        ]
        if slots.acknowledged is not None:
            events += self._acks.watch(slots.first, slots.acknowledged)
        yield from self._lines(events)

    def notes(self, notes: Sequence[Event]) -> Iterator[Column]:
        """A line for each note."""
        yield from self._lines(notes)

    def _lines(self, events: Sequence[Event]) -> Iterator[Column]:
        """The document with these events, at their slots, and again at the slots of later events."""
        slots, texts = self._log.add(
            [LogLine(event.k, self._times.text(event.k), event.level, event.text) for event in events]
        )
        if slots:
            documents = rr.TextDocument.columns(text=texts, media_type=["text/plain"] * len(texts))
            yield Column(_EVENTS_PATH, np.array(slots, np.int64), documents)
