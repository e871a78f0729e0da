"""What Evedrop shows in a notebook: a progress bar, and tables in HTML. Needs no notebook to be imported."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterable, Iterator
from importlib import import_module

from evedrop.scenario.arguments import refuse_unless
from evedrop.scenario.progress_events import OnEvent, ProgressEvent, RunProgress, silent
from evedrop.show.report.text_table import TextTable

_TELL_SECONDS = 0.2


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


def bar_text(done: int, total: int, label: str) -> str:
    """A progress bar in HTML."""
    from evedrop.show.report.page import made, printable

    return printable(made("progress", min(1.0, done / total) if total else 0.0, label))


def table_text(title: str, table: TextTable, notes: Iterable[str] = (), outcome: str = "") -> str:
    """A table in HTML, as the page of a report has it, with notes below it; outcome: a heading above it."""
    from evedrop.show.report.page import made, printable

    above = [made("heading", outcome)] if outcome else []
    return printable(made("block", *above, made("table", table, title), made("sentences", list(notes))))
