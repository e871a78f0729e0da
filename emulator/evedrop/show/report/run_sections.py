"""The sections of the report of a run. To add one, write a class and add it to `RUN_SECTIONS`."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from typing import final

from evedrop.model.figures.text import figure_text
from evedrop.score.expectations_held import repeating
from evedrop.score.summary import Judged
from evedrop.score.track import FACTOR, LostSpan, Track
from evedrop.show.report import closing
from evedrop.show.report.chart import Curve, LogChart, legend
from evedrop.show.report.markup import Node, element, paragraphs
from evedrop.show.report.run_source import OUTCOMES, TRACK_COLOURS, RecordedTrial, RunSource
from evedrop.show.report.section import Section
from evedrop.show.report.strip import strip
from evedrop.show.report.tables import facts_table, html_table
from evedrop.show.report.text_table import TextTable
from evedrop.show.view.error_floor import error_floor
from evedrop.show.view.lanes import EAVESDROPPER
from evedrop.show.view.palette import hexadecimal

_MOST_TEXT = 40_000
_MARKS = {True: "✓", False: "✕"}


def marked_sentences(expectations: Sequence[Judged]) -> Iterator[Node]:
    """A list of expectations with a mark each, and the command that repeats a failure; nothing without any."""
    items = []
    for one in expectations:
        again = None if one.replay is None else element("pre", element("code", one.replay))
        mark = element("span", _MARKS[one.held is True], aria_hidden="true", class_="mark")
        items.append(element("li", mark, one.sentence, again))
    if items:
        yield element("ul", *items, class_="marked")


@final
class VerdictsSection(Section[RunSource]):
    """What the run shows about secrecy, in sentences."""

    title = "Verdicts"

    @classmethod
    def nodes(cls, of: RunSource) -> Iterator[Node]:
        """The sentences of the closing report."""
        lines = [*closing.verdicts(of.summary), *closing.doubts(of.summary), *closing.application_lines(of.summary)]
        surprise = closing.surprise(of.summary)
        yield from paragraphs([*lines, *([surprise] if surprise is not None else [])])


@final
class ExpectationsSection(Section[RunSource]):
    """The expectations of the scenario, with their outcomes."""

    title = "Expectations"

    @classmethod
    def nodes(cls, of: RunSource) -> Iterator[Node]:
        """A sentence for each, and the command that repeats a failure."""
        yield from marked_sentences(of.summary.expectations)


@final
class FiguresSection(Section[RunSource]):
    """The figures with their standard errors, theory, and z."""

    title = "Figures"

    @classmethod
    def nodes(cls, of: RunSource) -> Iterator[Node]:
        """The tables of the closing report."""
        yield html_table(
            closing.receivers_table(of.summary),
            "Means over slots and trials ± standard errors. z: the z-score of the error against theory.",
        )
        if of.summary.directions:
            yield html_table(
                closing.directions_table(of.summary.directions), "Errors in the directions of the scenario"
            )
        yield from paragraphs(closing.remarks(of.summary))


@final
class ErrorsSection(Section[RunSource]):
    """The error of every receiver, slot by slot."""

    title = "Errors"

    @classmethod
    def nodes(cls, of: RunSource) -> Iterator[Node]:
        """A chart with bands and theory."""
        curves = [
            Curve(name, of.colour(name), one.slot, one.error, one.low, one.high, one.theory)
            for name, one in of.means.items()
        ]
        if not curves:
            return
        several = of.summary.trials > 1
        bands = "bands: its 95 % interval; " if several else ""
        said = f"Mean squared error over {of.summary.trials:,} trials" if several else "Squared error of the trial"
        chart = LogChart(
            f"{said} in every slot, by receiver, with what theory expects. The table above has its means.",
            "slot",
            f"{said}; {bands}dotted: theory",
            curves,
            x_range=(min(curve.first for curve in of.means.values()), max(curve.last for curve in of.means.values())),
            floor=error_floor(of.noise, of.summary.trials),
        )
        if (node := chart.node) is not None:
            yield node


@final
class LostTrackSection(Section[RunSource]):
    """The spans in which each receiver lost track, in the first recorded trial."""

    title = "Lost track"

    @classmethod
    def nodes(cls, of: RunSource) -> Iterator[Node]:
        """The rule, a table, and the lanes of each receiver."""
        if not of.trial:
            return
        yield element(
            "p",
            f"Trial {of.summary.first_trial}, slot by slot. A receiver is fooled where its squared error is more than "
            f"{FACTOR:g} times what its own covariance tr P expects, and than tr Q, the noise of one step. Otherwise it drifts "
            f"where its squared error or tr P is more than {FACTOR:g} tr Q, and is in track elsewhere.",
        )
        table = TextTable.headed(["receiver"], ["in track", "drifting", "fooled", "spans lost", "longest"])
        for name, one in of.trial.items():
            table.add(
                name,
                *(f"{share:.1%}" for share in one.track.shares),
                f"{one.lost.count:,}",
                f"slots {_where(one.lost.spans[0])}" if one.lost.count else "–",
            )
        yield html_table(table, "Shares of the slots, and spans in which the receiver lost track")
        used = {code for lanes in of.trial.values() for code, share in enumerate(lanes.outcome.shares) if share}
        yield element(
            "p",
            "Upper lanes: ",
            *legend([(code.word, hexadecimal(TRACK_COLOURS[code])) for code in Track]),
            class_="legend",
        )
        packets = [(word, hexadecimal(EAVESDROPPER.colours[i])) for i, word in enumerate(OUTCOMES) if i in used]
        yield element("p", "Lower lanes, packets: ", *legend(packets), class_="legend")
        for name, one in of.trial.items():
            yield from _lanes(name, one)


def _where(span: LostSpan) -> str:
    return f"{span.first:,} to {span.last:,}" if span.slots > 1 else f"{span.first:,}"


def _lanes(name: str, one: RecordedTrial) -> Iterator[Node]:
    """The two lanes of a receiver, and its longest spans."""
    spans = one.lost.spans
    yield element("h3", name)
    label = f"{name}: in track in {one.track.shares[Track.IN_TRACK]:.1%} of the slots 0 to {one.last:,}"
    yield strip(one.track.highest, [TRACK_COLOURS[code] for code in Track], label)
    counted = ", ".join(
        f"{share:.1%} {word}" for word, share in zip(OUTCOMES, one.outcome.shares, strict=True) if share
    )
    yield strip(one.outcome.commonest, EAVESDROPPER.colours, f"{name}: packets by what became of them: {counted}")
    if spans:
        items = [
            f"slots {_where(span)}: lost track for {span.slots:,}"
            + (f", fooled in {span.fooled:,}" if span.fooled else "")
            for span in sorted(spans, key=lambda span: span.first)
        ]
        title = f"Its {len(spans)} longest spans" if len(spans) > 1 else "Its only span"
        yield element("details", element("summary", f"{title} ({name})"), *paragraphs(items))


@final
class LinksSection(Section[RunSource]):
    """Links against their models."""

    title = "Links"

    @classmethod
    def nodes(cls, of: RunSource) -> Iterator[Node]:
        """A row for each link."""
        table = TextTable.headed(
            ["link"],
            ["offered", "delivered", "late", "lost", "let through", "model", "interval"],
            ["within", "lost by"],
        )
        for name, one in of.summary.links.items():
            table.add(
                name,
                *(f"{count:,}" for count in (one.offered, one.delivered, one.late, one.lost)),
                figure_text(one.rate, ".4f"),
                figure_text(one.expected_rate, ".4f"),
                "–" if one.interval is None else f"{one.interval[0]:.4f} to {one.interval[1]:.4f}",
                {True: "yes", False: "NO", None: "–"}[one.within_interval],
                ", ".join(f"{count:,} {reason}" for reason, count in one.lost_by.items()) or "–",
            )
        if table.rows:
            yield html_table(
                table,
                "Packets, the share that the loss model let through, and the share by the model, which should lie in the 99.9 % "
                "confidence interval of the packets observed",
            )


@final
class EventsSection(Section[RunSource]):
    """What happened during the run."""

    title = "Events"

    @classmethod
    def nodes(cls, of: RunSource) -> Iterator[Node]:
        """A row for each event, and for each outage."""
        table = TextTable.headed([], ["slot"], ["event", "by"])
        for event in of.summary.events:
            table.add(f"{event.slot:,}", event.event, event.by)
        for outage in of.summary.outages:
            until = "the run did not continue" if outage.until is None else f"until slot {outage.until:,}"
            table.add(f"{outage.slot:,}", f"{outage.process} cut off from the network, {until}", "network")
        if table.rows:
            yield html_table(table, "Events and outages")


@final
class RepeatSection(Section[RunSource]):
    """How to repeat the run, and with which versions it was made."""

    title = "Repeat it"

    @classmethod
    def nodes(cls, of: RunSource) -> Iterator[Node]:
        """Commands, seed, versions, digests, the scenario."""
        summary, where = of.summary, shlex.quote(str(of.folder.absolute()))
        yield element("p", "The same run to the same bits, and a look at it:")
        commands = [repeating(of.folder, summary.trials, summary.mode), f"evedrop view {where}"]
        yield element("pre", element("code", "\n".join(commands)))
        made = of.tables.get("made_with", {})
        facts = {
            "seed": summary.seed,
            "trials": f"{summary.first_trial:,} to {summary.first_trial + summary.trials - 1:,}",
            "mode": summary.mode,
            "time": f"{summary.wall_seconds:,.1f} s",
            **(made if isinstance(made, dict) else {}),
            **{f"digest of {name}": peer.digest or "–" for name, peer in summary.peers.items()},
        }
        yield facts_table(facts, "Seed, versions and digests")
        if of.scenario_text and len(of.scenario_text) <= _MOST_TEXT:
            text = element("pre", element("code", of.scenario_text))
            yield element("details", element("summary", "The scenario with all its entries"), text)


RUN_SECTIONS: tuple[type[Section[RunSource]], ...] = (
    VerdictsSection,
    ExpectationsSection,
    FiguresSection,
    ErrorsSection,
    LostTrackSection,
    LinksSection,
    EventsSection,
    RepeatSection,
)
"""In the order of the page."""
