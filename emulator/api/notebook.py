"""What Evedrop shows in a notebook: a progress bar, and tables in HTML. Needs no notebook to be imported."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator, Sequence
from html import escape
from importlib import import_module
from typing import Any

from evedrop.news import News, RunProgress, Tell, silent

_TELL_SECONDS = 0.2


def in_notebook() -> bool:
    """Whether this program is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


@contextlib.contextmanager
def progress(tell: Tell | None, total: int) -> Iterator[Tell]:
    """The function that takes the news of a call: `tell` if one is given, else a progress bar in a notebook.

    total: the progress at the end, unless the news gives it. The bar vanishes at the end.
    """
    if tell is not None or not in_notebook():
        yield tell or silent
        return
    shown = import_module("IPython.display")
    handle = shown.display(shown.HTML(bar_text(0, total, "starting")), display_id=True)
    due = time.monotonic()

    def take(news: News) -> None:
        nonlocal due
        if isinstance(news, RunProgress) and time.monotonic() >= due:
            due = time.monotonic() + _TELL_SECONDS
            rate = f"{news.rate:,.0f} {news.rate_unit}"
            handle.update(shown.HTML(bar_text(news.done, news.total or total, rate)))

    try:
        yield take
    finally:
        handle.update(shown.HTML(""))


def bar_text(done: int, total: int, beside: str) -> str:
    """A progress bar in HTML."""
    share = min(1.0, done / total) if total else 0.0
    return f'<progress max="1" value="{share:.4f}"></progress> {share:.0%} · {escape(beside)}'


def table_text(title: str, heads: Sequence[str], rows: Sequence[Sequence[Any]], notes: Sequence[str] = ()) -> str:
    """A table in HTML; the first column has names, the others have numbers. Every text is escaped."""
    head = "".join(f"<th>{escape(one)}</th>" for one in heads)
    lines = "".join(
        "<tr>"
        + "".join(f"<{kind}>{escape(str(one))}</{kind}>" for kind, one in zip(_kinds(row), row, strict=True))
        + "</tr>"
        for row in rows
    )
    said = "".join(f"<div>{escape(note)}</div>" for note in notes)
    return f"<div><strong>{escape(title)}</strong></div><table><thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table>{said}"


def _kinds(row: Sequence[Any]) -> Iterator[str]:
    return ("td" if i else "th" for i in range(len(row)))
