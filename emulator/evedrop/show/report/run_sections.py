"""The sections of the report of a run, and its data. To add a section, write a function and add it to `RUN_SECTIONS`.

The data are the run's summary, its scenario, and the parts of its tables that the report shows. The rows of a table are read by
receiver, in the order of the slots, piece by piece: memory does not grow with the slots.
"""

from __future__ import annotations

import base64
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np
import pyarrow as pa
from markupsafe import Markup

from evedrop.errors import UsageError
from evedrop.model.metrics.metric import COVARIANCE_ONLY
from evedrop.model.metrics.text import number_text, percent_text
from evedrop.model.process import Floats
from evedrop.model.receiver import NOTHING, SILENT, Codes, Flags
from evedrop.results.reading import Results
from evedrop.scenario.recorded import recorded_noise, recorded_strategies
from evedrop.score.expectations_held import repeating
from evedrop.score.rare_events import recorded_rare_errors, sound_errors
from evedrop.score.summary import Summary
from evedrop.score.synchronisation import FACTOR, LongestSpans, LostSpan, Synchronisation, synchronisation_of
from evedrop.show.report import closing
from evedrop.show.report.chart import POINTS, Curve, GroupCounts, GroupMeans, LogChart
from evedrop.show.report.page import facts_table, made
from evedrop.show.report.text_table import TextTable
from evedrop.show.report.travel import OF_PAGE, SCENARIO, circumstances, download, input_files
from evedrop.show.view.axis_name import squared_unit
from evedrop.show.view.error_floor import error_floor, mean_band
from evedrop.show.view.lanes import EAVESDROPPER, KNOWLEDGE, SPIED, Lane, knowledge_lane
from evedrop.show.view.palette import paper_inks
from evedrop.system.files import Unreadable, text_of


class RowExtent(NamedTuple):
    """The rows of a receiver: how many there are, and their first and last slot."""

    rows: int
    first: int
    last: int


@final
class SlotRows:
    """The rows of some receivers in a table of a run: a row for each slot, of one recorded trial if the table has trials."""

    def __init__(self, results: Results, table: str, receivers: Collection[str], trial: int | None = None) -> None:
        """Reads where the rows are. Raises UsageError if the table cannot be read, or lacks a column."""
        self._results, self._table, self._receivers, self._trial = results, table, receivers, trial
        self.extents: dict[str, RowExtent] = {}
        """Of the receivers that have rows."""
        self._in_order = True
        for name, rows in self._by_receiver(results.pieces(table, self._with_keys([]))):
            slots = rows["slot"]
            first, last, before = int(slots.min()), int(slots.max()), self.extents.get(name)
            self._in_order &= bool((np.diff(slots) > 0).all()) and (before is None or before.last < first)
            if before is not None:
                first, last = min(first, before.first), max(last, before.last)
            self.extents[name] = RowExtent(len(slots) + (0 if before is None else before.rows), first, last)

    def pieces(self, columns: Sequence[str]) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Some columns, as pieces: the receiver, and its next rows. All rows at once if the slots of the table are not in order.

        Without the rows that a run in progress has added since the constructor read the table.

        Raises UsageError as the constructor does.
        """
        if self._in_order:
            tables = self._results.pieces(self._table, self._with_keys(columns))
        else:  # somebody has written the table again
            tables = iter([self._results.part(self._table, self._with_keys(columns)).sort_by("slot")])
        left = {name: extent.rows for name, extent in self.extents.items()}
        for name, rows in self._by_receiver(tables):
            if left.get(name):
                yield name, {key: _rows(column, slice(left[name])) for key, column in rows.items()}
                left[name] = max(0, left[name] - len(rows["slot"]))

    def _with_keys(self, columns: Sequence[str]) -> list[str]:
        keys = ["slot", "peer", *([] if self._trial is None else ["trial"])]
        return list(dict.fromkeys([*keys, *columns]))

    def _by_receiver(self, tables: Iterable[pa.Table]) -> Iterator[tuple[str, Mapping[str, Any]]]:
        for table in tables:  # without Arrow's own functions, whose import takes 9 MB
            columns = {name: _column(name, table[name]) for name in table.column_names}
            peers, names = columns["peer"]
            for name in self._receivers:
                some = np.array([peer == name for peer in names], np.bool_)[peers]
                if self._trial is not None:
                    some &= columns["trial"] == self._trial
                if some.any():
                    yield name, {key: _rows(column, some) for key, column in columns.items()}


def _column(name: str, column: pa.ChunkedArray) -> Any:
    """A column of numbers, (c,); one of words as indices, (c,), into the words that follow."""
    if name not in _OF_WORDS:
        return column.to_numpy()
    whole = column.combine_chunks()
    if isinstance(whole, pa.DictionaryArray) and not whole.null_count:
        return whole.indices.to_numpy().astype(np.intp), whole.dictionary.to_pylist()
    words: dict[str, int] = {}
    return np.array([words.setdefault(str(word), len(words)) for word in column.to_pylist()], np.intp), list(words)


def _rows(column: Any, some: Flags | slice) -> Any:
    """Some rows of a column as `_column` returns it."""
    return (column[0][some], column[1]) if isinstance(column, tuple) else column[some]


_OF_WORDS = ("peer", "sent", "action")
_MOST_BYTES = 2**24
OUTCOMES = EAVESDROPPER.words
"""The fates of a packet; the index of a word is its code."""
MOST_SPANS = 12
"""The most spans without synchronisation that a report lists for a receiver."""
PIXELS = 2000
"""The most pixels of a lane. Each of a long run stands for several slots: for their most frequent code, or the highest."""


class SlotMeans(NamedTuple):
    """The error of a receiver, at most `POINTS` points: slot by slot, or means of neighbouring slots; NaN where it is unknown."""

    first: int
    last: int
    """The last slot."""
    slot: Floats
    error: Floats
    low: Floats
    """The 95 % interval of the mean over trials, by the standard error of its logarithm: the interval stays above 0."""
    high: Floats
    theory: Floats


@final
class RecordedTrial:
    """A receiver in the first recorded trial."""

    def __init__(self, extent: RowExtent, noise: float) -> None:
        """noise: tr Q."""
        self._noise = noise
        self.last = extent.last
        """The last slot."""
        self.outcome = GroupCounts(extent.rows, PIXELS, len(OUTCOMES))
        """What became of every packet, as indices into `OUTCOMES`."""
        self.synchronisation = GroupCounts(extent.rows, PIXELS, len(Synchronisation))
        self.lost = LongestSpans(MOST_SPANS, extent.first)
        """The spans in which it lost synchronisation."""

    def add(self, rows: Mapping[str, Any]) -> None:
        """The rows of the next slots. Raises UsageError if one has an unknown action."""
        sent, actions = rows["sent"], rows["action"]
        unknown = sorted({actions[1][place] for place in np.unique(actions[0])} - set(OUTCOMES))
        if unknown:
            raise UsageError(f"trials.parquet has the unknown action {unknown[0]}; run the scenario again")
        codes = np.array([OUTCOMES.index(word) if word in OUTCOMES else 0 for word in actions[1]], np.uint8)[actions[0]]
        silent = np.array([word == NOTHING for word in sent[1]], np.bool_)[sent[0]]
        self.outcome.add(np.where(silent, np.uint8(OUTCOMES.index(SILENT)), codes))
        codes = synchronisation_of(_numbers(rows["squared_error"]), _numbers(rows["trace_covariance"]), self._noise)
        self.synchronisation.add(codes)
        self.lost.add(codes)


@dataclass(frozen=True)
class RunSource:
    """A results folder of a run, read."""

    folder: Path
    results: Results
    summary: Summary
    scenario_text: str
    """The scenario.toml of the folder; empty if it cannot be read."""

    @classmethod
    def read(cls, folder: Path) -> RunSource:
        """Read a folder. Raises UsageError if it is not a results folder of this version."""
        results = Results.read(folder)
        try:
            text = text_of(folder / SCENARIO, _MOST_BYTES)
        except (OSError, Unreadable):
            text = ""
        return cls(folder, results, results.typed_summary, text)

    @cached_property
    def tables(self) -> Mapping[str, Any]:
        """The tables of the scenario; empty if they cannot be read."""
        try:
            return tomllib.loads(self.scenario_text)
        except (ValueError, RecursionError):
            return {}

    def colour(self, receiver: str) -> str:
        """The colour of a receiver, as in the view."""
        return self._colours[receiver]

    @cached_property
    def _colours(self) -> dict[str, str]:
        return paper_inks(self.summary.peers, recorded_strategies(self.folder))

    @cached_property
    def means(self) -> dict[str, SlotMeans]:
        """Receiver → its error in every slot. Raises UsageError if the table cannot be read."""
        columns = ["slot", "trials", "mean_squared_error", "mean_actual_trace_covariance", "standard_error"]
        table = SlotRows(self.results, "slots", self.summary.peers)
        groups = {name: GroupMeans(extent.rows, POINTS, 5) for name, extent in table.extents.items()}
        slots, trials = 1 + max((extent.last for extent in table.extents.values()), default=0), self.summary.trials
        rare = recorded_rare_errors(self.folder, slots, trials) if trials > 1 else {}
        for name, rows in table.pieces([*columns, "theoretical_trace_covariance"]):
            groups[name].add(_means(rows, rare.get(name)))
        return {
            name: SlotMeans(extent.first, extent.last, *groups[name].means) for name, extent in table.extents.items()
        }

    @cached_property
    def trial(self) -> dict[str, RecordedTrial]:
        """Receiver → its first recorded trial; empty without one. Raises UsageError if the table cannot be read."""
        table = SlotRows(self.results, "trials", self.summary.peers, self.summary.first_trial)
        trials = {name: RecordedTrial(extent, self.noise) for name, extent in table.extents.items()}
        for name, rows in table.pieces(["sent", "action", "squared_error", "trace_covariance"]):
            trials[name].add(rows)
        return trials

    @property
    def unit(self) -> str:
        """The unit of a squared error, to follow its name; empty if the states have none."""
        process = self.tables.get("process")
        units = process.get("units") if isinstance(process, dict) else None
        return squared_unit(map(str, units) if isinstance(units, list) else ())

    @cached_property
    def noise(self) -> float:
        """The process noise tr Q; 0 if it is unknown, because the scenario cannot be read."""
        return recorded_noise(self.folder)


def _means(rows: Mapping[str, Any], rare: Floats | None) -> Floats:
    """Slot, error, the ends of its interval, and what theory expects, (5, c).

    rare: what rare events carry of the expected error in each slot of the run.
    """
    error = _numbers(rows["mean_squared_error"])
    actual = _numbers(rows["mean_actual_trace_covariance"])
    error = np.where(np.isnan(error), actual, error)
    slot, scatter = _numbers(rows["slot"]), _numbers(rows["standard_error"])
    sound = sound_errors(scatter, None if rare is None else rare[slot.astype(np.int64)])
    low, high = mean_band(error, sound, _numbers(rows["trials"]))
    theory = _numbers(rows["theoretical_trace_covariance"])
    return np.stack([slot, error, low, high, theory])


def _numbers(column: Any) -> Floats:
    return np.asarray(column, np.float64)


_MOST_TEXT = 40_000


def _verdicts(of: RunSource) -> Iterator[Markup]:
    """What the run shows about secrecy, in sentences."""
    each = [line for _, line in closing.verdict_lines(of.summary)]
    lines = [*each, *closing.details(of.summary), *closing.doubts(of.summary), *closing.application_lines(of.summary)]
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
    table = TextTable.headed(["receiver"], ["5 %", "median", "95 %"])
    for name, peer in of.summary.peers.items():
        if peer.error_quantiles and of.summary.trials > 1:
            table.add(name, *(number_text(value) for value in peer.error_quantiles.values()))
    if table.rows:
        yield made("table", table, f"Quantiles over trials of a trial's mean error{of.unit}")


def _errors(of: RunSource) -> Iterator[Markup]:
    """The error of every receiver, slot by slot."""
    curves = [
        Curve(name, of.colour(name), mean.slot, mean.error, mean.low, mean.high, mean.theory)
        for name, mean in of.means.items()
    ]
    if not curves:
        return
    several = of.summary.trials > 1
    against = "" if of.summary.filter is None else " to the sensor's estimate"
    bands = "bands: its 95 % interval; " if several else ""
    if several and any(np.isnan(mean.low).any() for mean in of.means.values()):
        bands = "bands: its 95 % interval (none where rare events carry the mean); "
    what = "trace of the actual covariance" if of.summary.mode == COVARIANCE_ONLY else "squared error"
    caption = f"Mean {what}{against} over {of.summary.trials:,} trials"
    caption = caption if several else f"{what.capitalize()}{against} of the trial"
    chart = LogChart(
        f"{caption} in every slot, by receiver, with what theory expects. The table above has its means.",
        "slot",
        f"{caption}; {bands}dotted: theory",
        curves,
        x_range=(min(curve.first for curve in of.means.values()), max(curve.last for curve in of.means.values())),
        floor=error_floor(of.noise, of.summary.trials),
        y_axis=f"{what}{of.unit}",
    )
    yield chart.figure or Markup()


def _lost_synchronisation(of: RunSource) -> Iterator[Markup]:
    """The spans in which each receiver lost synchronisation, in the first recorded trial."""
    if not of.trial:
        return
    if not of.noise:
        yield made("paragraph", "Not shown: tr Q, the noise of one step, is 0 or unknown.")
        return
    yield made(
        "paragraph",
        f"Trial {of.summary.first_trial}, slot by slot. A receiver is overconfident where its squared error is more than "
        f"{FACTOR:g} times what its own covariance tr P allows, and than tr Q, the noise of one step. Otherwise it is uncertain "
        f"where its squared error or tr P is more than {FACTOR:g} tr Q, and is synchronised elsewhere.",
    )
    table = TextTable.headed(["receiver"], ["synchronised", "uncertain", "overconfident", "spans lost", "longest"])
    for name, recorded in of.trial.items():
        table.add(
            name,
            *map(percent_text, recorded.synchronisation.fractions),
            f"{recorded.lost.count:,}",
            f"slots {_where(recorded.lost.spans[0])}" if recorded.lost.count else "–",
        )
    yield made("table", table, "Fractions of the slots, and spans in which the receiver lost synchronisation")
    used = {code for lanes in of.trial.values() for code, fraction in enumerate(lanes.outcome.fractions) if fraction}
    yield made("legend", "Upper lane of the legitimate estimator:", KNOWLEDGE.legend())
    yield made("legend", "Upper lanes of eavesdroppers:", SPIED.legend())
    yield made("legend", "Lower lanes, packets:", EAVESDROPPER.legend(used))
    for name, recorded in of.trial.items():
        yield from _lanes(name, recorded)


def _where(span: LostSpan) -> str:
    return f"{span.first:,} to {span.last:,}" if span.slots > 1 else f"{span.first:,}"


def _lanes(name: str, recorded: RecordedTrial) -> Iterator[Markup]:
    """The two lanes of a receiver, and its longest spans."""
    spans = recorded.lost.spans
    yield made("heading", name)
    fraction = recorded.synchronisation.fractions[Synchronisation.SYNCHRONISED]
    label = f"{name}: synchronised in {percent_text(fraction)} of the slots 0 to {recorded.last:,}"
    yield lane_picture(knowledge_lane(name), recorded.synchronisation.highest, label)
    counted = ", ".join(
        f"{percent_text(fraction)} {word}"
        for word, fraction in zip(OUTCOMES, recorded.outcome.fractions, strict=True)
        if fraction
    )
    yield lane_picture(EAVESDROPPER, recorded.outcome.commonest, f"{name}: packets by what became of them: {counted}")
    if spans:
        items = [
            f"slots {_where(span)}: lost synchronisation for {span.slots:,}"
            + (f", overconfident in {span.overconfident:,}" if span.overconfident else "")
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
    """The scenario to save, the command that repeats the run with it, and when, where and with which versions it was made."""
    summary = of.summary
    if of.scenario_text:
        whole = summary.ended == "complete"
        same = "the same results to the same bits" if whole else "the whole run; this one ended early"
        yield made("paragraph", f"Save the scenario, and run it in its folder: {same}, and a look at them.")
        yield download(SCENARIO, of.scenario_text)
        yield from input_files(of.folder)
        if "secret_file" in of.tables:
            yield made("paragraph", "Its secret is in a file, which does not travel with this page.")
        planned = of.tables.get("trials")  # of which a study that was interrupted has only some
        trials = planned if type(planned) is int else summary.trials
        command = repeating(Path(SCENARIO), trials, summary.mode)
        if any(peer.rare_estimate is not None for peer in summary.peers.values()):
            command += " --rare"
        yield made("code", f"{command} --out again\n{closing.looking('again', summary)}")
    else:
        yield made("paragraph", f"The run cannot be repeated: its folder has no {SCENARIO} that can be read.")
    versions = of.tables.get("made_with", {})
    facts = {
        "seed": summary.seed,
        "trials": f"{summary.first_trial:,} to {summary.first_trial + summary.trials - 1:,}",
        "mode": summary.mode,
        **circumstances(of.folder / "summary.json"),
        "time": f"{summary.wall_seconds:,.1f} s",
        **(versions if isinstance(versions, dict) else {}),
        **{f"digest of {name}": peer.digest or "–" for name, peer in summary.peers.items()},
    }
    yield facts_table(facts, f"Seed, versions and digests of the run; {OF_PAGE}")
    if of.scenario_text and len(of.scenario_text) <= _MOST_TEXT:
        yield made("details", "The scenario with all its entries", made("code", of.scenario_text))


RUN_SECTIONS: Mapping[str, Callable[[RunSource], Iterator[Markup]]] = {
    "Verdicts": _verdicts,
    "Expectations": _expectations,
    "Metrics": _metrics,
    "Errors": _errors,
    "Lost synchronisation": _lost_synchronisation,
    "Links": _links,
    "Events": _events,
    "Repeat it": _repeat,
}
"""Title → the function that makes the contents, in the order of the page."""
