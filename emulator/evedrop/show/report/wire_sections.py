"""The sections of the report of a wire. To add one, write a function and add it to `WIRE_SECTIONS`."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
from markupsafe import Markup

from evedrop.model.metrics.text import percent_text
from evedrop.results.wire_summary import WIRE_FILE, WIRE_SUMMARY_FILE, WireSummary
from evedrop.scenario.words import toml_text
from evedrop.show.report.chart import Curve, LogChart
from evedrop.show.report.page import facts_table, made
from evedrop.show.report.run_sections import lane_picture
from evedrop.show.report.text_table import TextTable
from evedrop.show.report.travel import OF_PAGE, circumstances, download
from evedrop.show.report.wire import reasons_table, unlinked_sentence, wire_faults, wire_outcome, wire_table, wire_title
from evedrop.show.report.wire_over_time import LANE, WireOverTime
from evedrop.show.view.palette import hexadecimal, on_paper, series
from evedrop.system.files import Unreadable, text_of

_MOST_BYTES = 2**24
_OF_ANY_MACHINE = ("keys", "peers")  # of the entries of a side
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
    """Link → its loss model in words; empty if wire.toml cannot be read."""
    travelling: str
    """The wire file without what is only this machine's: addresses, users with their passwords, certificates. Empty as above."""
    events: Sequence[tuple[str, str]]
    """When, and what."""
    journal: Callable[[], Iterable[pa.Table]]
    """Gives the rows of this start, a table for each part of the journal. Raises UsageError if they cannot be read."""

    @classmethod
    def of(cls, folder: Path, summary: WireSummary, journal: Callable[[], Iterable[pa.Table]]) -> WireSource:
        """A folder whose summary is known; journal: as above."""
        sides = [*dict.fromkeys(side for link in summary.links.values() for side in (link.source, link.target))]
        title = f"Wire of {', '.join(sides[:-1])} and {sides[-1]}" if sides else "Wire without links"
        events = [(f"{entry.seconds:,.1f} s", entry.event) for entry in summary.events]
        try:
            tables = tomllib.loads(text_of(folder / WIRE_FILE, _MOST_BYTES))
            models = {entry["name"]: _model(entry["loss"]) for entry in tables["link"]}
            anywhere = {
                name: {key: side[key] for key in _OF_ANY_MACHINE if key in side}
                for name, side in tables["side"].items()
            }
            travelling = toml_text({**tables, "side": anywhere})
        except (OSError, Unreadable, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            models, travelling = {}, ""
        about, outcome = wire_title(summary), wire_outcome(summary)
        return cls(folder, summary, title, about, outcome, models, travelling, events, journal)


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


def _over_time(of: WireSource) -> Iterator[Markup]:
    """A lane for each link, the fractions of messages lost, and the delays, over the time since the start."""
    history = WireOverTime.read(of.folder, of.summary, of.journal())
    links = {name: link for name, link in history.links.items() if link.heard.any()}
    if not links:
        return
    yield made("legend", "Lanes:", LANE.legend({int(code) for link in links.values() for code in link.codes}))
    for name, link in links.items():
        yield made("heading", name)
        lost = f"{percent_text(link.lost.sum() / link.heard.sum())} of {int(link.heard.sum()):,} messages were not delivered"
        yield lane_picture(LANE, link.codes, f"{name}, {of.summary.seconds:,.1f} s: {lost}")
    history = history.coarser
    links = {name: history.links[name] for name in links}
    steps = f"in steps of {history.step:.3g} s"
    inks = {name: hexadecimal(on_paper(of_link)) for name, of_link in zip(links, series(len(links)), strict=True)}
    curves = [Curve(name, inks[name], history.seconds, link.loss) for name, link in links.items()]
    ends = (0.0, max(of.summary.seconds, float(history.seconds[-1])))  # labels outside would leave the axes no room
    yield (
        LogChart(
            f"The fraction of the messages of every link that were not delivered, {steps}",
            "seconds since the start", f"Messages that were not delivered, {steps}", curves,
            x_range=ends, y_axis="fraction lost", linear=True,
        ).figure
        or Markup()
    )  # fmt: skip
    curves = [
        Curve(name, inks[name], history.seconds, link.delay(0.5), link.delay(0.05), link.delay(0.95))
        for name, link in links.items()
        if link.delayed
    ]
    delays = LogChart(
        f"The delays of the delivered messages of every link, {steps}",
        "seconds since the start", f"Median delay of delivered messages, {steps}; bands: nine messages of ten", curves,
        x_range=ends, y_axis="delay (s)", linear=True,
    )  # fmt: skip
    yield (delays.figure if curves else None) or Markup()


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
    """The wire file to save, the command that starts it again, and when, where and with which versions it was made."""
    start = of.summary.start
    if of.travelling:
        same = (
            "the same messages have the same fates"
            if start == 1
            else f"its fates are those of start 1, not of start {start}"
        )
        yield made(
            "paragraph",
            f"Save the wire file, and start it in its folder: {same}, apart from changes by hand. Its sides listen on free "
            "ports of this machine: the addresses, users and certificates of this wire do not travel with the page.",
        )
        yield download(WIRE_FILE, of.travelling)
        yield made("code", f"evedrop wire {WIRE_FILE} --out again\nevedrop view again")
    facts = {
        "seed": of.summary.seed,
        "start": f"{start:,} in this folder",
        **circumstances(of.folder / WIRE_SUMMARY_FILE),
        "time": f"{of.summary.seconds:,.1f} s",
        **of.summary.made_with,
    }
    yield facts_table(facts, f"Seed and versions of the wire; {OF_PAGE}")


WIRE_SECTIONS: Mapping[str, Callable[[WireSource], Iterator[Markup]]] = {
    "Expectations": _expectations,
    "Links": _links,
    "Over time": _over_time,
    "Losses by reason": _losses,
    "Events": _events,
    "Repeat it": _repeat,
}
"""Title → the function that makes the contents, in the order of the page."""
