"""What people see of a run in the terminal: a progress line, and a closing table with a sentence on secrecy."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

News = Mapping[str, Any]


class ProgressLine:
    """Shows the observer's or the simulation's news on standard error. Final; a context manager."""

    def __init__(self, total: int, unit: str, quiet: bool = False) -> None:
        self.console = Console(stderr=True, highlight=False)
        self._quiet = quiet
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn(f"{unit} · {{task.fields[rate]}}"),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.fields[errors]}"),
            console=self.console,
            transient=True,
            disable=quiet or not self.console.is_terminal,
        )
        self._task: TaskID = self._progress.add_task("starting", total=total, rate="", errors="")

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def tell(self, news: News) -> None:
        """Take one piece of news."""
        kind = news["event"]
        if kind == "view" and not self._quiet:
            self.console.print(f"live view: {news['address']}", soft_wrap=True)
        elif kind == "started":
            self._progress.update(self._task, description="running")
        elif kind == "progress":
            self._progress.update(
                self._task,
                description="running",
                completed=news["done"],
                rate=f"{news['rate']:,.0f} {news['rate_unit']}",
                errors="  ".join(f"{name} {error:.2g}" for name, error in news.get("squared_errors", {}).items()),
            )
        elif kind == "ended" and news.get("view"):
            self.console.print(f"the view stopped early: {news['view']}")


def closing_table(summary: News) -> Table:
    """Per receiver: what it received, its error, and what it believed of it."""
    trials = f"{summary['trials']} trials" if summary["trials"] > 1 else "1 trial"
    rate = f"{summary['slots_per_second']:,.0f} slots/s"
    title = f"{summary['scenario']} · {summary['slots']} slots · {trials} · {rate}"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    table.add_column("receiver", no_wrap=True)
    for head in ("received", "used", "mean |x−x̂|²", "believed tr P", "expected tr P"):
        table.add_column(head, justify="right", no_wrap=True)
    table.add_column("digest", no_wrap=True)
    for name, peer in summary["peers"].items():
        table.add_row(
            name,
            f"{float(peer['received_fraction']):.4f}",
            f"{float(peer['used_fraction']):.4f}",
            f"{float(peer['mean_squared_error']):.4g}",
            f"{float(peer['mean_trace_covariance']):.4g}",
            f"{float(peer['expected_trace_covariance']):.4g}",
            (peer["digest"] or "–")[:12],
        )
    return table


def print_summary(summary: News, folder: str) -> None:
    """The closing report on standard output."""
    console = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else 100)
    if summary["ended"] != "complete":
        console.print(f"{summary['ended'].splitlines()[0]}; the results so far:")
    console.print(closing_table(summary))
    for verdict in summary["secrecy"].values():
        console.print(verdict["sentence"])
    for expectation in summary["expectations"]:
        word = "held" if expectation["held"] else "FAILED"
        console.print(f"expected {expectation['text']}: {word}, found {float(expectation['found']):.4g}")
    console.print(f"results: {folder}")
