"""The closing table of a wire, and the sentences below it.

Source: docs/wire.md, the summary.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator, Mapping
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from evedrop.score.summary import Judged

_MARKS = {True: "yes", False: "NO", None: "–"}


def wire_table(summary: Mapping[str, Any]) -> Table:
    """The table of the links. summary: the entries of summary.json."""
    title = f"wire · seed {summary['seed']} · {summary['heard']:,} messages · {summary['seconds']:,.1f} s"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    table.add_column("link", no_wrap=True)
    for heading in ("heard", "delivered", "lost", "dropped", "rate", "model", "within", "delay", "gap"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, link in summary["links"].items():
        median = link["delays"].get("0.5")
        table.add_row(
            name,
            f"{link['heard']:,}",
            f"{link['delivered']:,}",
            f"{sum(link['lost_by'].values()):,}",
            f"{sum(link['dropped_by'].values()):,}",
            "–" if link["rate"] is None else f"{link['rate']:.4f}",
            "–" if link["expected_rate"] is None else f"{link['expected_rate']:.4f}",
            _MARKS[link["within_bounds"]],
            "–" if median is None else f"{1000 * median:.3g} ms",
            f"{link['gap_messages']:,}",
        )
    return table


def closing_lines(summary: Mapping[str, Any]) -> list[str]:
    """The closing table as text, and the sentences."""
    text = io.StringIO()
    Console(file=text, width=max(100, shutil.get_terminal_size().columns)).print(wire_table(summary))
    return [*(line.rstrip() for line in text.getvalue().splitlines()), *wire_sentences(summary)]


def wire_sentences(summary: Mapping[str, Any]) -> Iterator[str]:
    """What the table does not say: why messages did not arrive, and which expectations were met."""
    for name, link in summary["links"].items():
        lost = _counted(link["lost_by"])
        dropped = _counted(link["dropped_by"])
        if lost:
            yield f"{name} lost {lost}"
        if dropped:
            yield f"{name}: the wire itself, or Zenoh, dropped {dropped}"
    if summary["unlinked"]:
        yield f"no link of the file takes {_messages(summary['unlinked'])}; add a link, or let programs not publish them"
    yield from (Judged(**one).sentence for one in summary["expectations"] if one["held"] is not False)


def wire_failures(summary: Mapping[str, Any]) -> Iterator[str]:
    """What went wrong: links outside their bounds, messages that are unaccounted for, and expectations that failed."""
    for name, link in summary["links"].items():
        if link["within_bounds"] is False:
            low, high = link["bounds"]
            yield (
                f"{name} is outside the 99 % bounds of its model: it let {link['rate']:.4f} of the messages through, where "
                f"{low:.4f} to {high:.4f} were expected"
            )
    if summary["unaccounted"]:
        yield f"unaccounted for: {_messages(summary['unaccounted'])}; this is a fault of Evedrop"
    if summary["journal"]["missing"]:
        yield f"the journal lacks {_messages(summary['journal']['missing'])}, because the disk was full"
    elif summary["journal"]["incomplete_since"] is not None:
        yield "the disk was full for some time: the journal has all messages, but perhaps not all changes and events"
    yield from (Judged(**one).sentence for one in summary["expectations"] if one["held"] is False)


def _counted(reasons: Mapping[str, int]) -> str:
    return ", ".join(f"{count:,} by {reason.replace('_', ' ')}" for reason, count in reasons.items())


def _messages(count: int) -> str:
    return "1 message" if count == 1 else f"{count:,} messages"
