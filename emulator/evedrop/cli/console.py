"""The console on which tables are drawn, and the progress line: styles reach the terminal, control characters in texts do not."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self, final

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TaskID,
    TimeRemainingColumn,
)
from rich.segment import Segment
from rich.table import Column
from rich.text import Text

from evedrop.model.kernels.choice import fallback_warning
from evedrop.scenario.progress_events import (
    ConnectionOutage,
    FolderMoved,
    Held,
    ProgressEvent,
    RunEnded,
    RunProgress,
    Started,
    ViewOpened,
)
from evedrop.system.output import columns_of, escaped, takes_styles, wrapped


class StyledConsole(Console):
    """A console that escapes control characters in all text, and writes its own styles past the escaping of `Output`."""

    def __init__(self, file: Any, **named: Any) -> None:
        """Draw on a stream; named: as for Rich's own console."""
        super().__init__(file=getattr(file, "styled", file), **named)
        if not takes_styles(file):  # Rich takes a terminal without TERM for one that knows colours
            self._color_system = None

    @property
    def is_dumb_terminal(self) -> bool:
        """Whether the terminal knows no styles and no movement of the cursor, as without TERM."""
        return (self.is_terminal and not os.environ.get("TERM")) or super().is_dumb_terminal

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """The pieces of text of what is drawn; Rich measures and cuts them afterwards."""
        return _escaped(super().render(renderable, options))


def _escaped(segments: Iterable[Segment]) -> Iterator[Segment]:
    for segment in segments:
        yield segment if segment.control else Segment(escaped(segment.text), segment.style)


_BAR_FROM = 120  # the least width of a terminal, in columns, that has room for a bar
_BAR_WIDTH = 24
_SPINNER_WIDTH = 1


@final
class _Facts(ProgressColumn):
    """What is done, the time left, how fast, and the errors, in one line; what does not fit is left out, the errors first."""

    def __init__(self, unit: str, room: Callable[[], int]) -> None:
        """room: gives the columns that the text may have."""
        super().__init__(Column(no_wrap=True))
        self._unit = unit
        self._room = room
        self._done = MofNCompleteColumn()
        self._left = TimeRemainingColumn(compact=True)

    def render(self, task: Task) -> Text:
        room = self._room()
        state = Text(f"{task.description} ")
        done = self._done.render(task) + Text(f" {self._unit}")
        bare = self._done.render(task)
        rate = Text(f" · {task.fields['rate']}" if task.fields["rate"] else "")
        # While a run is held, or no total is known, any time left would be a guess.
        left = Text(" ") + self._left.render(task) + Text(" left") if rate and task.total is not None else Text()
        shortened: list[tuple[Text, ...]] = [(state, done, left, rate), (done, left, rate), (done, left), (bare, left)]
        if not left:  # the state says why
            shortened = [(state, done, rate), (state, done), (state, bare)]
        line = next((fits for parts in shortened if (fits := Text.assemble(*parts)).cell_len <= room), bare)
        return line + _that_fit(task.fields["errors"], room - line.cell_len)


def _that_fit(errors: Mapping[str, float], room: int) -> Text:
    """The errors of the first receivers, as many as fit into this number of columns, and `…` if these are not all."""
    text = ""  # which has room for the mark behind it
    for i, (name, error) in enumerate(errors.items()):
        longer = f"{text}  {name} {error if error >= _DUST else 0:.2g}"
        if cell_len(longer if i == len(errors) - 1 else longer + _MORE) > room:
            return Text(text and text + _MORE)
        text = longer
    return Text(text)


_MORE = "  …"
_DUST = 1e-12  # a smaller error comes from rounding


@final
class ProgressLine:
    """Shows the events of a run on standard error; a context manager.

    total: progress at the end, counted in `unit`s; None if an event will tell it.
    """

    def __init__(self, total: int | None, unit: str, quiet: bool = False) -> None:
        self.console = StyledConsole(sys.stderr, highlight=False, markup=False)
        self._quiet = quiet
        self._total = total
        self.moved: Path | None = None
        """The results folder, if it was renamed."""
        bar = self.console.width >= _BAR_FROM
        around = _SPINNER_WIDTH + 1 + (_BAR_WIDTH + 1 if bar else 0)
        self._progress = Progress(
            SpinnerColumn(),
            *([BarColumn(bar_width=_BAR_WIDTH)] if bar else []),
            _Facts(unit, lambda: self.console.width - around),
            console=self.console,
            transient=True,
            disable=quiet or not self.console.is_terminal,
        )
        self._task: TaskID = self._progress.add_task("starting", total=total, rate="", errors={})

    def __enter__(self) -> Self:
        if (warning := fallback_warning()) is not None:
            self._print(f"warning: {warning}", "yellow")
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def on_event(self, event: ProgressEvent) -> None:
        """Show one event."""
        match event:
            case Started():
                self._progress.update(self._task, description="running")
            case Held():
                self._progress.update(
                    self._task, description=f"held before slot {event.before}", completed=event.before, rate=""
                )
            case RunProgress():
                self._progress.update(
                    self._task,
                    description="running",
                    total=self._total if event.total is None else event.total,
                    completed=event.done,
                    rate=f"{event.rate:,.0f} {event.rate_unit}",
                    errors=event.squared_errors,
                )
            case ViewOpened() if not self._quiet:
                if event.address:
                    self._print(f"live view, open to anybody who has this address:\n{event.address}")
                if event.warning:
                    self._print(f"warning: {event.warning}", "yellow")
            case ConnectionOutage() if not self._quiet:
                self._print(outage_line(event), "yellow")
            case FolderMoved():
                self.moved = Path(event.folder)
                self._print(f"the results folder was renamed while the run went on; it is {self.moved}")
            case RunEnded() if event.view:
                self._print(f"the view stopped early: {event.view}", "yellow")

    def _print(self, line: str, style: str = "") -> None:
        self.console.print(wrapped(line, columns_of(sys.stderr)), style=style, soft_wrap=True)


def outage_line(outage: ConnectionOutage) -> str:
    """An outage as a sentence."""
    went = "the run did not go on" if outage.until is None else f"the run went on after {outage.seconds:.1f} s"
    where = "" if outage.shard is None else f" of shard {outage.shard}"
    return f"{outage.process}{where} cut off at slot {outage.slot}; {went}"
