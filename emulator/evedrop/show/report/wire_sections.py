"""The sections of the report of a wire. To add one, write a function and add it to `WIRE_SECTIONS`."""

from __future__ import annotations

import shlex
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from evedrop.errors import UsageError
from evedrop.results.wire_summary import WIRE_FILE, WIRE_SUMMARY_FILE, WireSummary
from evedrop.show.report.page import facts_table, made
from evedrop.show.report.text_table import TextTable
from evedrop.show.report.wire import reasons_table, unlinked_sentence, wire_faults, wire_outcome, wire_table, wire_title
from evedrop.system.files import Unreadable, text_of

_MOST_BYTES = 2**24
_MOST_EVENTS = 500
_MOST_WORDS = 120  # characters about a loss model


@dataclass(frozen=True)
class WireSource:
    """The folder of a wire, read."""

    folder: Path
    summary: WireSummary
    """That of summary.json, or what would be in it."""
    title: str
    about: str
    """What the wire did, in a line."""
    outcome: tuple[str, bool | None]
    """In a sentence, and whether it is good."""
    models: Mapping[str, str]
    """Link → its loss model in words; empty if wire.toml cannot be read. Nothing else of this file is kept: it has passwords."""
    events: Sequence[tuple[str, str]]
    """When, and what."""

    @classmethod
    def read(cls, folder: Path) -> WireSource:
        """Read a folder. Raises UsageError if it is not that of a wire that ended."""
        path = folder / WIRE_SUMMARY_FILE
        if not path.exists():
            raise UsageError(
                f"{folder} has no {path.name}: the wire runs or was killed; to make its report: evedrop report {folder}"
            )
        return cls.of(folder, WireSummary.read(path))

    @classmethod
    def of(cls, folder: Path, summary: WireSummary) -> WireSource:
        """A folder whose summary is known."""
        sides = [*dict.fromkeys(side for link in summary.links.values() for side in (link.source, link.target))]
        title = f"Wire of {', '.join(sides[:-1])} and {sides[-1]}" if sides else "Wire without links"
        events = [(f"{entry.seconds:,.1f} s", entry.event) for entry in summary.events]
        try:
            tables = tomllib.loads(text_of(folder / WIRE_FILE, _MOST_BYTES))
            models = {entry["name"]: _model(entry["loss"]) for entry in tables["link"]}
        except (OSError, Unreadable, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            models = {}
        return cls(folder, summary, title, wire_title(summary), wire_outcome(summary), models, events)


def _model(loss: Mapping[str, Any]) -> str:
    """A loss model with its parameters, such as "bernoulli: quality = 0.6"; a long recording is cut off."""
    words = ", ".join(f"{key} = {value}" for key, value in loss.items() if key != "model")
    text = f"{loss['model']}: {words}" if words else str(loss["model"])
    return text if len(text) <= _MOST_WORDS else f"{text[:_MOST_WORDS]}…"


def _expectations(of: WireSource) -> Iterator[Markup]:
    """The expectations of the wire file, with their outcomes."""
    yield made("expectations", of.summary.expectations)


def _links(of: WireSource) -> Iterator[Markup]:
    """What became of the messages of each link, against its models."""
    yield made("sentences", [*wire_faults(of.summary), *unlinked_sentence(of.summary)])
    yield made(
        "table",
        wire_table(of.summary),
        "Messages; the fraction that the models let through, and what they predict; whether it is within their bounds of 99 %; "
        "the median delay; the most messages in a row that did not arrive",
    )
    table = TextTable.headed(["link", "from", "to", "keys"], ["99 % bounds"], ["loss model"])
    for name, link in of.summary.links.items():
        bounds = "–" if link.bounds is None else "{:.4f} to {:.4f}".format(*link.bounds)
        table.add(name, link.source, link.target, link.keys, bounds, of.models.get(name, "–"))
    yield made(
        "table", table, "The links as the file gives them, and the bounds of 99 % for the messages that they took"
    )


def _losses(of: WireSource) -> Iterator[Markup]:
    """Why messages did not arrive."""
    table = reasons_table(of.summary)
    if table.rows:
        yield made("table", table, "Messages that did not arrive")


def _events(of: WireSource) -> Iterator[Markup]:
    """Cuts, partitions and changes, of the file and of operators."""
    table = TextTable.headed([], ["at"], ["event"])
    for event in of.events[:_MOST_EVENTS]:
        table.add(*event)
    if table.rows:
        more = f"; the first {_MOST_EVENTS} of {len(of.events):,}" if len(of.events) > _MOST_EVENTS else ""
        yield made("table", table, f"Cuts, partitions and changes, in seconds since the start{more}")


def _repeat(of: WireSource) -> Iterator[Markup]:
    """How to start the wire again, and with which versions it was made."""
    where = of.folder.absolute()
    yield made("paragraph", "A wire whose messages have the same fates, and a look at this one:")
    commands = [["evedrop", "wire", str(where / WIRE_FILE)], ["evedrop", "view", str(where)]]
    yield made("code", "\n".join(map(shlex.join, commands)))
    facts = {
        "seed": of.summary.seed,
        "start": f"{of.summary.start:,} in this folder",
        "time": f"{of.summary.seconds:,.1f} s",
        **of.summary.made_with,
    }
    yield facts_table(facts, "Seed and versions")


WIRE_SECTIONS: Mapping[str, Callable[[WireSource], Iterator[Markup]]] = {
    "Expectations": _expectations,
    "Links": _links,
    "Losses by reason": _losses,
    "Events": _events,
    "Repeat it": _repeat,
}
"""Title → the function that makes the contents, in the order of the page."""
