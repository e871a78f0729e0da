"""The sections of the report of a run. To add one, write a function and add it to `RUN_SECTIONS`."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Callable, Iterator, Mapping
from io import BytesIO

from markupsafe import Markup

from evedrop.model.metrics.text import number_text
from evedrop.model.receiver import Codes
from evedrop.score.expectations_held import repeating
from evedrop.score.track import FACTOR, LostSpan, Track
from evedrop.show.report import closing
from evedrop.show.report.chart import Curve, LogChart
from evedrop.show.report.page import facts_table, made
from evedrop.show.report.run_source import OUTCOMES, RecordedTrial, RunSource
from evedrop.show.report.text_table import TextTable
from evedrop.show.view.error_floor import error_floor
from evedrop.show.view.lanes import EAVESDROPPER, KNOWLEDGE, Lane

_MOST_TEXT = 40_000


def _verdicts(of: RunSource) -> Iterator[Markup]:
    """What the run shows about secrecy, in sentences."""
    lines = [*closing.verdicts(of.summary), *closing.doubts(of.summary), *closing.application_lines(of.summary)]
    surprise = closing.surprise(of.summary)
    yield made("sentences", [*lines, *([surprise] if surprise is not None else [])])


def _expectations(of: RunSource) -> Iterator[Markup]:
    """The expectations of the scenario, with their outcomes."""
    yield made("expectations", of.summary.expectations)


def _metrics(of: RunSource) -> Iterator[Markup]:
    """The metrics with their standard errors, theory, and z."""
    yield made(
        "table",
        closing.receivers_table(of.summary),
        "Means over slots and trials ± standard errors. z: the z-score of the error against theory.",
    )
    if of.summary.directions:
        yield made(
            "table",
            closing.directions_table(of.summary.directions),
            "Errors in the directions of the scenario",
        )
    yield made("sentences", list(closing.remarks(of.summary)))


def _errors(of: RunSource) -> Iterator[Markup]:
    """The error of every receiver, slot by slot."""
    curves = [
        Curve(name, of.colour(name), mean.slot, mean.error, mean.low, mean.high, mean.theory)
        for name, mean in of.means.items()
    ]
    if not curves:
        return
    several = of.summary.trials > 1
    bands = "bands: its 95 % interval; " if several else ""
    caption = f"Mean squared error over {of.summary.trials:,} trials" if several else "Squared error of the trial"
    chart = LogChart(
        f"{caption} in every slot, by receiver, with what theory expects. The table above has its means.",
        "slot",
        f"{caption}; {bands}dotted: theory",
        curves,
        x_range=(min(curve.first for curve in of.means.values()), max(curve.last for curve in of.means.values())),
        floor=error_floor(of.noise, of.summary.trials),
    )
    yield chart.figure or Markup()


def _lost_track(of: RunSource) -> Iterator[Markup]:
    """The spans in which each receiver lost track, in the first recorded trial."""
    if not of.trial:
        return
    yield made(
        "paragraph",
        f"Trial {of.summary.first_trial}, slot by slot. A receiver is fooled where its squared error is more than "
        f"{FACTOR:g} times what its own covariance tr P expects, and than tr Q, the noise of one step. Otherwise it drifts "
        f"where its squared error or tr P is more than {FACTOR:g} tr Q, and is in track elsewhere.",
    )
    table = TextTable.headed(["receiver"], ["in track", "drifting", "fooled", "spans lost", "longest"])
    for name, recorded in of.trial.items():
        table.add(
            name,
            *(f"{fraction:.1%}" for fraction in recorded.track.fractions),
            f"{recorded.lost.count:,}",
            f"slots {_where(recorded.lost.spans[0])}" if recorded.lost.count else "–",
        )
    yield made("table", table, "Fractions of the slots, and spans in which the receiver lost track")
    used = {code for lanes in of.trial.values() for code, fraction in enumerate(lanes.outcome.fractions) if fraction}
    yield made("legend", "Upper lanes:", KNOWLEDGE.legend())
    yield made("legend", "Lower lanes, packets:", EAVESDROPPER.legend(used))
    for name, recorded in of.trial.items():
        yield from _lanes(name, recorded)


def _where(span: LostSpan) -> str:
    return f"{span.first:,} to {span.last:,}" if span.slots > 1 else f"{span.first:,}"


def _lanes(name: str, recorded: RecordedTrial) -> Iterator[Markup]:
    """The two lanes of a receiver, and its longest spans."""
    spans = recorded.lost.spans
    yield made("heading", name)
    label = f"{name}: in track in {recorded.track.fractions[Track.IN_TRACK]:.1%} of the slots 0 to {recorded.last:,}"
    yield lane_picture(KNOWLEDGE, recorded.track.highest, label)
    counted = ", ".join(
        f"{fraction:.1%} {word}"
        for word, fraction in zip(OUTCOMES, recorded.outcome.fractions, strict=True)
        if fraction
    )
    yield lane_picture(EAVESDROPPER, recorded.outcome.commonest, f"{name}: packets by what became of them: {counted}")
    if spans:
        items = [
            f"slots {_where(span)}: lost track for {span.slots:,}"
            + (f", fooled in {span.fooled:,}" if span.fooled else "")
            for span in sorted(spans, key=lambda span: span.first)
        ]
        title = f"Its {len(spans)} longest spans" if len(spans) > 1 else "Its only span"
        yield made("details", f"{title} ({name})", made("sentences", items))


def lane_picture(lane: Lane, codes: Codes, label: str) -> Markup:
    """A row of pixels, one for each code; label: what it shows, in words."""
    from PIL import Image  # noqa: PLC0415 - only pages with lanes need it

    png = BytesIO()
    Image.fromarray(lane.pixels(codes[None])).save(png, "PNG", optimize=True)
    source = f"data:image/png;base64,{base64.b64encode(png.getvalue()).decode()}"
    return made("lane", source, len(codes), label)


def _links(of: RunSource) -> Iterator[Markup]:
    """Links against their models."""
    table = TextTable.headed(
        ["link"],
        ["offered", "delivered", "late", "lost", "let through", "model", "interval"],
        ["within", "lost by"],
    )
    for name, link in of.summary.links.items():
        table.add(
            name,
            *(f"{count:,}" for count in (link.offered, link.delivered, link.late, link.lost)),
            number_text(link.rate, ".4f"),
            number_text(link.expected_rate, ".4f"),
            "–" if link.interval is None else f"{link.interval[0]:.4f} to {link.interval[1]:.4f}",
            {True: "yes", False: "NO", None: "–"}[link.within_interval],
            ", ".join(f"{count:,} {reason}" for reason, count in link.lost_by.items()) or "–",
        )
    if table.rows:
        yield made(
            "table",
            table,
            "Packets, the fraction that the loss model let through, and the fraction by the model, which should lie in the "
            "99.9 % confidence interval of the packets observed",
        )


def _events(of: RunSource) -> Iterator[Markup]:
    """What happened during the run."""
    table = TextTable.headed([], ["slot"], ["event", "by"])
    for event in of.summary.events:
        table.add(f"{event.slot:,}", event.event, event.by)
    for outage in of.summary.outages:
        until = "the run did not continue" if outage.until is None else f"until slot {outage.until:,}"
        table.add(f"{outage.slot:,}", f"{outage.process} cut off from the network, {until}", "network")
    if table.rows:
        yield made("table", table, "Events and outages")


def _repeat(of: RunSource) -> Iterator[Markup]:
    """How to repeat the run, and with which versions it was made."""
    summary, where = of.summary, shlex.quote(str(of.folder.absolute()))
    yield made("paragraph", "The same run to the same bits, and a look at it:")
    commands = [repeating(of.folder, summary.trials, summary.mode), f"evedrop view {where}"]
    yield made("code", "\n".join(commands))
    versions = of.tables.get("made_with", {})
    facts = {
        "seed": summary.seed,
        "trials": f"{summary.first_trial:,} to {summary.first_trial + summary.trials - 1:,}",
        "mode": summary.mode,
        "time": f"{summary.wall_seconds:,.1f} s",
        **(versions if isinstance(versions, dict) else {}),
        **{f"digest of {name}": peer.digest or "–" for name, peer in summary.peers.items()},
    }
    yield facts_table(facts, "Seed, versions and digests")
    if of.scenario_text and len(of.scenario_text) <= _MOST_TEXT:
        yield made("details", "The scenario with all its entries", made("code", of.scenario_text))


RUN_SECTIONS: Mapping[str, Callable[[RunSource], Iterator[Markup]]] = {
    "Verdicts": _verdicts,
    "Expectations": _expectations,
    "Metrics": _metrics,
    "Errors": _errors,
    "Lost track": _lost_track,
    "Links": _links,
    "Events": _events,
    "Repeat it": _repeat,
}
"""Title → the function that makes the contents, in the order of the page."""
