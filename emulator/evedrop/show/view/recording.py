"""The recording of a run: a file with the values of its panels, written so that it delays the run by a few seconds at most.

Rerun may block when a disk is slow or full. So the run only appends to a list, and a thread turns slots into columns and writes
the file. Viewers read the file as it grows; the run does not know of them. A package's panel may be broken. It is then left out,
with one warning, and harms neither the run nor the other panels.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Generic, TypeVar, final

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.api import create_in_memory_blueprint

from evedrop.errors import NotRegistered
from evedrop.model.registry import CLASS_ERRORS, place_of
from evedrop.results.folder import private_file
from evedrop.scenario.words import listed
from evedrop.score.verdict import Verdict
from evedrop.show.view.column import Column, laid_out
from evedrop.show.view.events import Event, introduction
from evedrop.show.view.panels import PANELS
from evedrop.show.view.panels.curves import times_of
from evedrop.show.view.panels.panel import COLUMNS, ROWS_ABOVE, ROWS_BELOW, SCENE, PlacedView, Side, ViewPanel
from evedrop.show.view.scene import Scene, SceneSlots
from evedrop.show.view.staged import StagedChunks, chunk_sizes
from evedrop.system.output import warn
from evedrop.system.threads import ThreadEvent
from evedrop.system.world import world

T = TypeVar("T")

_WIDTHS = (1.2, 1.0, 1.0)  # of the columns, from the left; packets are on the left, and need four pixels for each slot
_LEAST_REST = 0.3  # of the height, for the columns, however many receivers there are
_LEAST_ROW = 0.05


@final
class PanelSet:
    """The panels that apply to a scene; those of packages come last. warn: called with a line for each one left out."""

    def __init__(self, scene: Scene, warn: Callable[[str], None]) -> None:
        self._scene, self._warn = scene, warn
        self._panels: dict[str, ViewPanel] = {}
        for name in (*PANELS, *filter(PANELS.foreign, PANELS.names)):
            for panel in self._tried(name, partial(self._made, name)):
                self._panels[name] = panel

    def _made(self, name: str) -> list[ViewPanel]:
        panel = PANELS[name]
        return [panel(self._scene)] if panel.applies(self._scene) else []

    def layout(self) -> rrb.Blueprint:
        """The views of all panels: rows over the whole width, and columns between them."""
        placed = [
            view
            for name, panel in [*self._panels.items()]
            for view in self._tried(name, partial(_views, panel, _drawable if PANELS.foreign(name) else _placed))
        ]
        return laid_out(_tabbed(placed), times_of(self._scene).line)

    def send_styles(self, to: rr.RecordingStream) -> None:
        """Record every panel's styles."""
        self._each(lambda panel: _style(panel.styles(), to))

    def send(self, columns: Callable[[ViewPanel], Iterable[Column]], put: Callable[[Column], None]) -> None:
        """Record what each panel answers; put: is called with each column."""
        self._each(lambda panel: _send(columns(panel), put))

    def _each(self, ask: Callable[[ViewPanel], Sequence[T]]) -> list[T]:
        return [answer for name, panel in [*self._panels.items()] for answer in self._tried(name, partial(ask, panel))]

    def _tried(self, name: str, ask: Callable[[], Sequence[T]]) -> Sequence[T]:
        """A panel's answer; empty if it fails: a package's panel is then left out from now on, and a built-in one raises."""
        try:
            return ask()
        except CLASS_ERRORS as error:
            if not PANELS.foreign(name):
                raise
            self._panels.pop(name, None)
            why = error.why if isinstance(error, NotRegistered) else f": {place_of(error)}"
            self._warn(f"the view lacks the panel {name}{why}")
            return ()


def _tabbed(placed: Sequence[PlacedView]) -> rrb.Container:
    """The verdict above two tabs, the scene and the numbers; only the numbers where no panel has a place in the scene."""
    above = [view for view in placed if view.side == "verdict"]
    tabs: list[rrb.Container] = [_arranged([view for view in placed if view.side not in {"verdict", *SCENE}])]
    if any(view.side == "worlds" for view in placed):
        tabs.insert(0, _scene([view for view in placed if view.side in SCENE]))
    body = tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs, active_tab=0)
    if not above:
        return body
    height = max(view.height for view in above)
    return rrb.Vertical(*(view.view for view in above), body, row_shares=[*(height for _ in above), 1.0 - height])


def _scene(placed: Sequence[PlacedView]) -> rrb.Container:
    """What happens, beside it a grid with the world as each listener believes it, and below both a strip over time."""
    truth, worlds, strip = ([view for view in placed if view.side == side] for side in SCENE)
    shown = _rows(worlds[:MOST_WORLDS])
    grid = rrb.Vertical(*(rrb.Horizontal(*(view.view for view in row)) for row in shown))
    above = rrb.Horizontal(*(view.view for view in truth), grid, column_shares=[*(1.0 for _ in truth), _GRID])
    if not strip:
        return rrb.Vertical(above, name=SCENE_TAB)
    height = max(view.height for view in strip)
    return rrb.Vertical(above, _row(strip), row_shares=[1.0 - height, height], name=SCENE_TAB)


def _rows(worlds: Sequence[PlacedView]) -> list[Sequence[PlacedView]]:
    """The rows of a grid without empty cells, which are about square: rows differ by one cell at most."""
    count = math.ceil(len(worlds) / math.ceil(math.sqrt(len(worlds))))
    bounds = [-(-i * len(worlds) // count) for i in range(count + 1)]
    return [worlds[first:last] for first, last in pairwise(bounds)]


SCENE_TAB, NUMBERS_TAB = "Scene", "Numbers"
MOST_WORLDS = 9
"""Receivers that have a world in the scene; the numbers show all."""
_GRID = 1.25  # times as wide as what happens


def _arranged(placed: Sequence[PlacedView]) -> rrb.Container:
    """The tab with numbers: rows above, columns, and rows below; rows have the height that they need, and columns the rest."""
    sides = {side: [view for view in placed if view.side == side] for side in (*ROWS_ABOVE, *COLUMNS, *ROWS_BELOW)}
    columns = [
        (rrb.Vertical(*(view.view for view in sides[side]), row_shares=[view.share for view in sides[side]]), width)
        for side, width in zip(COLUMNS, _WIDTHS, strict=True)
        if sides[side]
    ]
    heights = {side: max((view.height for view in sides[side]), default=0.0) for side in (*ROWS_ABOVE, *ROWS_BELOW)}
    rest = max(_LEAST_REST, 1.0 - sum(heights.values()))
    middle = rrb.Horizontal(*(view for view, _ in columns), column_shares=[width for _, width in columns])

    def rows_of(chosen: Sequence[Side]) -> list[tuple[rrb.Container, float]]:
        return [(_row(sides[side]), max(heights[side], _LEAST_ROW)) for side in chosen if sides[side]]

    rows = [*rows_of(ROWS_ABOVE), (middle, rest), *rows_of(ROWS_BELOW)]
    return rrb.Vertical(*(row for row, _ in rows), row_shares=[share for _, share in rows], name=NUMBERS_TAB)


def _row(views: Sequence[PlacedView]) -> rrb.Container:
    return rrb.Horizontal(*(view.view for view in views), column_shares=[view.share for view in views])


def _views(panel: ViewPanel, check: Callable[[PlacedView], PlacedView]) -> list[PlacedView]:
    return [check(view) for view in panel.views()]


def _placed(view: PlacedView) -> PlacedView:
    """The same view, if a layout can contain it. Raises an error otherwise."""
    sides = ("verdict", *ROWS_ABOVE, *COLUMNS, *ROWS_BELOW, *SCENE)
    if (
        not isinstance(view, PlacedView)
        or view.side not in sides
        or not view.share > 0.0
        or not 0.0 <= view.height < 1.0
    ):
        raise TypeError(
            f"views() gave {view!r}; expected a PlacedView, {listed(sides)}, with a share above 0 and a height below 1"
        )
    return view


def _drawable(view: PlacedView) -> PlacedView:
    """The same, and Rerun can draw it. Rerun keeps some threads for each view that is tried like this."""
    create_in_memory_blueprint(
        application_id="view", blueprint=rrb.Blueprint(_placed(view).view)
    ).storage.drain_as_bytes()
    return view


def _style(
    styles: Mapping[str, rr.AsComponents | Iterable[rr.DescribedComponentBatch]], to: rr.RecordingStream
) -> tuple[()]:
    for path, style in styles.items():
        to.log(path, style, static=True, strict=True)
    return ()


def _send(columns: Iterable[Column], put: Callable[[Column], None]) -> tuple[()]:
    for column in columns:
        put(column)
    return ()


_APPLICATION = "evedrop"
_PERIOD = 0.1  # seconds between batches at most
_MOST_SLOTS = 16_384  # in a batch
_MOST_WAITING = 50_000  # slots that the file may be behind before the run waits for it
_REPLAY_SECONDS = 60.0  # for the file of a run that is over, which nobody waits for in real time
_PACED_PERIOD, _FAST_PERIOD = 0.2, 0.4  # of a run in real time, and as fast as possible: each chunk costs time
FILE_TIMEOUT = 5.0
"""Seconds that a run waits for the file before it continues without one.

Public, because the tests of whole runs, which begin recordings deep inside, allow a busy machine more.
"""

Chunk = TypeVar("Chunk")
Note = TypeVar("Note")


class RecordingThread(ABC, Generic[Chunk, Note]):
    """A thread that writes a recording to `path`. Neither disk nor panels can make any method raise: see `failure`.

    A subclass says what is recorded. The constructor calls `_layout`, the thread `_style` and then `_send`.
    """

    def __init__(
        self, path: Path, name: str, notes: Sequence[Note], patience: float | None = None, period: float = _PERIOD
    ) -> None:
        """name: identifies the recording: recordings of the same name are shown as one. notes: the first lines.

        patience: how long the file may take to begin, for a batch, and to end, in seconds; by default `FILE_TIMEOUT`.
        period: seconds between two calls of `_send`, at most.
        """
        self._name, self._period = name, period
        self._patience = FILE_TIMEOUT if patience is None else patience
        self.failure: str | None = None
        """Why there is no recording on disk, or an incomplete one."""
        self._waiting: list[Chunk] = []
        self._waiting_size = 0
        self._notes = list(notes)
        self._closing = False
        self._last = False
        """Whether the present call of `_send` is the last one."""
        self._changed = world().condition()
        self._file = self._stream()
        begun = world().event()
        self._writer = world().thread(self._record, path, begun, name="recording")
        try:
            self._blueprint = self._layout()
        except Exception as error:
            self._give_up(str(error))
            begun.set()
        self._writer.start()
        if not begun.wait(self._patience):
            self._give_up("the file could not be written")

    @abstractmethod
    def _layout(self) -> rrb.Blueprint:
        """The views."""

    @abstractmethod
    def _style(self, to: rr.RecordingStream) -> None:
        """Record names, colours and other styles, once."""

    @abstractmethod
    def _send(self, chunks: list[Chunk], notes: list[Note], to: rr.RecordingStream) -> bool:
        """Record what came since the last call; returns whether anything was recorded."""

    def _stream(self, *, send_properties: bool = True) -> rr.RecordingStream:
        """A stream of the recording; send_properties: whether it tells when the recording began."""
        return rr.RecordingStream(_APPLICATION, recording_id=self._name, send_properties=send_properties)

    def _begin(self, path: Path) -> None:
        """Begin the file, with layout and styles."""
        self._file.save(private_file(path), default_blueprint=self._blueprint)
        self._style(self._file)
        # Otherwise slots may overtake the styles, and a viewer shows the first of them in Rerun's own colours.
        self._file.flush(timeout_sec=self._patience)

    def _finish(self) -> None:
        """Finish the file."""
        self._file.disconnect()

    def _append(self, chunk: Chunk, size: int, most: int, patience: float) -> None:
        """Append to the list. With more than `most` in it, wait, and after `patience` seconds do without a recording."""
        with self._changed:
            if self._waiting_size > most:
                in_time = self._changed.wait_for(lambda: self._waiting_size <= most, patience)
                if not in_time:
                    self._give_up("the disk did not keep up with the run")
            if self.failure is None:
                self._waiting.append(chunk)
                self._waiting_size += size
                if self._waiting_size >= _MOST_SLOTS:  # otherwise the thread need not look
                    self._changed.notify_all()

    def close(self) -> bool:
        """Finish the file, within a time limit.

        True if the interpreter can now exit normally. Otherwise Rerun hangs, and only os._exit ends the process.
        """
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._writer.join(self._patience)
        if self._writer.is_alive():
            self._give_up("the disk did not keep up with the run")
        return self.failure is None

    def _give_up(self, why: str) -> None:
        if self.failure is None:
            self.failure = f"the recording is incomplete: {why}; free some space, or choose another folder"

    def _record(self, path: Path, begun: ThreadEvent) -> None:
        """Begin the file and write it to its end. Rerun never returns from a file that cannot even be begun."""
        if self.failure is None:
            try:
                self._begin(path)
            except Exception as error:
                self._give_up(str(error))
        begun.set()
        self._write()

    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._waiting_size >= _MOST_SLOTS, self._period)
                chunks, self._waiting, self._waiting_size = self._waiting, [], 0
                notes, self._notes = self._notes, []
                self._last = self._closing
                self._changed.notify_all()
            try:
                self._put(chunks, notes)
            except Exception as error:  # if the thread died, the run would wait for it
                self._give_up(repr(error))
            if self._last:
                break
        if self.failure is None:
            try:
                self._finish()
            except Exception as error:  # such as a full disk
                self._give_up(str(error))

    def _put(self, chunks: list[Chunk], notes: list[Note]) -> None:
        if self.failure is not None or not self._send(chunks, notes, self._file):
            return
        try:
            # When Rerun cannot write a file any more, the only sign is that it never finishes.
            self._file.flush(timeout_sec=self._patience)
        except RuntimeError:
            self._give_up("the file could not be written")


@final
class ViewRecording(RecordingThread[SceneSlots, Event]):
    """Writes the recording of one run."""

    def __init__(self, path: Path, scene: Scene, warn: Callable[[str], None] = warn, *, live: bool = False) -> None:
        """warn: tells the user about a panel that is left out; called from any thread.

        live: whether viewers are to follow a run in real time, by files beside the recording; see `live_files`.
        """
        self._scene, self._warn, self._recorded = scene, warn, 0
        self._verdict: Verdict | None = None
        self._staged: StagedChunks | None = None
        period = _PACED_PERIOD if scene.pace > 0 else _FAST_PERIOD
        self._sizes = chunk_sizes(scene.pace, period) if live else []
        super().__init__(path, scene.run, introduction(scene), None if live else _REPLAY_SECONDS, period)

    def add(self, slots: SceneSlots) -> None:
        """Record the next slots. Waits only for a disk that is thousands of slots behind, and for a few seconds at most."""
        if slots.count:
            self._append(slots, slots.count, _MOST_WAITING, self._patience)

    def conclude(self, verdict: Verdict | None) -> None:
        """Show the verdict on the run after its last slot; without one, that on its slots so far remains."""
        self._verdict = verdict

    def note(self, k: int, level: str, text: str) -> None:
        """Add a line to the events: level is INFO, WARN or ERROR."""
        with self._changed:
            self._notes.append(Event(k, level, text))

    def _layout(self) -> rrb.Blueprint:
        self._panels = PanelSet(self._scene, self._warn)
        return self._panels.layout()

    def _style(self, to: rr.RecordingStream) -> None:
        self._panels.send_styles(to)

    def _begin(self, path: Path) -> None:
        if not self._sizes:
            super()._begin(path)
            return
        times = times_of(self._scene)
        staged = StagedChunks(path, self._file, self._sizes, lambda: self._stream(send_properties=False), times)
        super()._begin(path)
        staged.begin(self._patience)
        self._staged = staged

    def _send(self, chunks: list[SceneSlots], notes: list[Event], to: rr.RecordingStream) -> bool:
        put = self._staged.put if self._staged is not None else partial(Column.send, to=to, times=times_of(self._scene))
        if chunks:
            slots = SceneSlots.joined(chunks)
            self._recorded = slots.first + slots.count
            self._panels.send(lambda panel: panel.columns(slots), put)
        verdict, last = self._verdict, self._recorded - 1
        if self._last and verdict is not None and self._recorded:
            self._panels.send(lambda panel: panel.conclusion(last, verdict), put)
        if notes:
            self._panels.send(lambda panel: panel.notes(notes), put)
        if self._staged is not None and (chunks or notes or self._last):
            self._staged.pass_on(self._recorded, self._patience, self._last)
        return bool(chunks or notes or (self._last and self._verdict is not None))

    def _finish(self) -> None:
        super()._finish()
        if self._staged is not None:
            self._staged.close()
