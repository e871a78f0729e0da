"""The progress line of runs and studies, on standard error."""

from __future__ import annotations

import sys
from pathlib import Path
from types import TracebackType
from typing import Self, final

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from evedrop.kernels.choice import fallback_warning
from evedrop.news import ConnectionOutage, FolderMoved, Held, News, RunEnded, RunProgress, Started, ViewOpened

_BAR_WIDTH = 120  # the least width of a terminal, in columns, that has room for a bar
_WHOLE_WIDTH = 70  # the least width that has room for more than what is done and the time left


@final
class _TimeLeft(TimeRemainingColumn):
    """The time left; nothing while the total is unknown."""

    def render(self, task: Task) -> Text:
        time = super().render(task)
        return time if task.total is None else time + " left"


@final
class ProgressLine:
    """Shows the news of a run on standard error; a context manager.

    total: progress at the end, counted in `unit`s; None if the news will tell it.
    """

    def __init__(self, total: int | None, unit: str, quiet: bool = False) -> None:
        self.console = Console(file=sys.stderr, highlight=False, markup=False)
        self._quiet = quiet
        self._total = total
        self.moved: Path | None = None
        """The results folder, if it was renamed."""
        whole = self.console.width >= _WHOLE_WIDTH
        self._progress = Progress(
            SpinnerColumn(),
            *([TextColumn("{task.description}")] if whole else []),
            *([BarColumn(bar_width=24)] if self.console.width >= _BAR_WIDTH else []),
            MofNCompleteColumn(),
            TextColumn(f"{unit} · {{task.fields[rate]}}" if whole else unit),
            _TimeLeft(compact=True),
            *([TextColumn("{task.fields[errors]}")] if whole else []),
            console=self.console,
            transient=True,
            disable=quiet or not self.console.is_terminal,
        )
        self._task: TaskID = self._progress.add_task("starting", total=total, rate="", errors="")

    def __enter__(self) -> Self:
        if (warning := fallback_warning()) is not None:
            self.console.print(f"warning: {warning}", soft_wrap=True)
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def tell(self, news: News) -> None:
        """Show one item of news."""
        match news:
            case Started():
                self._progress.update(self._task, description="running")
            case Held():
                self._progress.update(
                    self._task, description=f"held before slot {news.before}", completed=news.before, rate=""
                )
            case RunProgress():
                self._progress.update(
                    self._task,
                    description="running",
                    total=self._total if news.total is None else news.total,
                    completed=news.done,
                    rate=f"{news.rate:,.0f} {news.rate_unit}",
                    errors="  ".join(f"{name} {error:.2g}" for name, error in news.squared_errors.items()),
                )
            case ViewOpened() if not self._quiet:
                if news.address:
                    self._print(f"live view, open to anybody who has this address: {news.address}")
                if news.warning:
                    self._print(f"warning: {news.warning}")
            case ConnectionOutage() if not self._quiet:
                self._print(outage_line(news))
            case FolderMoved():
                self.moved = Path(news.folder)
                self._print(f"the results folder was renamed while the run went on; it is {self.moved}")
            case RunEnded() if news.view:
                self._print(f"the view stopped early: {news.view}")

    def _print(self, line: str) -> None:
        self.console.print(line, soft_wrap=True)


def outage_line(outage: ConnectionOutage) -> str:
    """An outage as a sentence."""
    went = "the run did not go on" if outage.until is None else f"the run went on after {outage.seconds:.1f} s"
    where = "" if outage.shard is None else f" of shard {outage.shard}"
    return f"{outage.process}{where} cut off at slot {outage.slot}; {went}"
