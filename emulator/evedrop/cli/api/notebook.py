"""What Evedrop shows in a notebook: a progress bar, tables in HTML, and the view. Needs no notebook to be imported."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterable, Iterator
from importlib import import_module
from pathlib import Path
from typing import final

from evedrop.scenario.arguments import refuse_unless
from evedrop.scenario.progress_events import OnEvent, ProgressEvent, RunProgress, ViewOpened, silent
from evedrop.show.report.text_table import TextTable
from evedrop.show.view.viewer import NOTEBOOK, Viewer, open_run

_TELL_SECONDS = 0.2
_SHARED = "the view is open to anybody who has this address:"


def in_notebook() -> bool:
    """Whether this program is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


@contextlib.contextmanager
def progress(on_event: OnEvent | None, total: int) -> Iterator[OnEvent]:
    """The function that takes the events of a call: `on_event` if one is given, else a progress bar in a notebook.

    total: the progress at the end, unless an event gives it. The bar vanishes at the end.
    """
    refuse_unless(on_event is None or callable(on_event), "on_event", on_event, "a function that takes an event")
    if on_event is not None or not in_notebook():
        yield on_event or silent
        return
    shown = import_module("IPython.display")
    handle = shown.display(shown.HTML(bar_text(0, total, "starting")), display_id=True)
    due = time.monotonic()

    def take(event: ProgressEvent) -> None:
        nonlocal due
        if isinstance(event, RunProgress) and time.monotonic() >= due:
            due = time.monotonic() + _TELL_SECONDS
            rate = f"{event.rate:,.0f} {event.rate_unit}"
            handle.update(shown.HTML(bar_text(event.done, event.total or total, rate)))

    try:
        yield take
    finally:
        handle.update(shown.HTML(""))


def view_in(mode: str) -> str:
    """The way to view a live run: in a notebook, "auto" and "web" are "notebook". Raises UsageError for "notebook" elsewhere."""
    inside = in_notebook()
    refuse_unless(mode != NOTEBOOK or inside, "view", mode, '"web" in a program that is not a notebook')
    return NOTEBOOK if inside and mode in {"auto", "web"} else mode


def shown_when_open(mode: str, emit: OnEvent) -> OnEvent:
    """The function `emit`, but the view is shown when it opens: in the cell of a notebook, or by its printed address."""

    def take(event: ProgressEvent) -> None:
        if isinstance(event, ViewOpened) and event.address is not None:
            if mode == NOTEBOOK:
                shown = import_module("IPython.display")
                shown.display(shown.HTML(view_text(event.address)))
            elif emit is silent:
                print(_SHARED, event.address, sep="\n", flush=True)
        emit(event)

    return take


@final
class OpenView:
    """A view of results, at an address for browsers of this machine; a notebook shows it in the cell.

    It is open until `close`, or until the program or the notebook's kernel ends; no other process is started for it.
    """

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer

    @classmethod
    def of(cls, folder: Path, recording: Path) -> OpenView:
        """The view of a results folder whose recording will not grow, and may be removed. Raises UsageError as `open_run`."""
        viewer = open_run(folder, NOTEBOOK, recording=recording)
        viewer.complete()
        return cls(viewer)

    @property
    def address(self) -> str:
        """The address to open in a browser of this machine. Anybody who has it sees the truth."""
        return str(self._viewer.address)

    def close(self) -> None:
        """Accept no more browsers. Harmless if it is closed."""
        self._viewer.stop()

    def __repr__(self) -> str:
        return f"{_SHARED}\n{self.address}" if self._viewer.alive() else "a closed view"

    def _repr_html_(self) -> str:
        return view_text(self.address) if self._viewer.alive() else "a closed view"


def view_text(address: str) -> str:
    """The view at an address in HTML: in a frame, with a link to it."""
    from evedrop.show.report.page import made, printable

    return printable(made("view", address))


def bar_text(done: int, total: int, label: str) -> str:
    """A progress bar in HTML."""
    from evedrop.show.report.page import made, printable

    return printable(made("progress", min(1.0, done / total) if total else 0.0, label))


def table_text(title: str, table: TextTable, notes: Iterable[str] = (), outcome: str = "") -> str:
    """A table in HTML, as the page of a report has it, with notes below it; outcome: a heading above it."""
    from evedrop.show.report.page import made, printable

    above = [made("heading", outcome)] if outcome else []
    return printable(made("block", *above, made("table", table, title), made("sentences", list(notes))))
