"""The words of the closing report of a run or a sweep: its table, and the sentences that go with it.

Source: docs/results.md; docs/montecarlo.md, sweeps.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from evedrop.counting import counted
from evedrop.model.metrics import all_metrics, columns, error_column, shown_metric, unloadable_metrics, z_column
from evedrop.model.metrics.text import count_text, estimate, fraction_text, number_text
from evedrop.model.registry import CLASS_ERRORS, place_of
from evedrop.model.theory.rare_events import RARE
from evedrop.names import SENSOR
from evedrop.scenario.application import applications_in, is_own
from evedrop.score.summary import (
    RARE_FRACTION,
    ControllerSummary,
    DirectionSummary,
    FilterSummary,
    Judged,
    LinkSummary,
    PeerSummary,
    Summary,
    failed,
)
from evedrop.score.verdict import SecrecyOutcome, times_text
from evedrop.show.report.text_table import TextColumn, TextTable

SWEEP_FILE = "sweep.json"
"""The file that says what a sweep is; its folder has it from the beginning."""
SWEEP_TABLE = "sweep.parquet"
"""The file that has the results of a sweep."""


def amount(summary: Summary) -> str:
    """How much was run, and how fast."""
    trials = counted(summary.trials, "trial")
    rate = f"{summary.slots_per_second:,.0f} slots/s"
    if summary.mode != "live":
        rate = f"{summary.slots_per_second * summary.trials:,.0f} trial-slots/s in memory"
    return f"{counted(summary.slots, 'slot')} · {trials} · {rate}"


def heading(summary: Summary) -> str:
    """What was run, how much of it, how fast, and how many expectations failed."""
    title = f"{summary.scenario} · {amount(summary)}"
    if summary.failed_expectations:
        title += f" · {summary.failed_expectations} of {len(summary.expectations)} expectations FAILED"
    return title


def looking(folder: str, summary: Summary) -> str:
    """The command that shows the results in a folder: their view, or their table if they have no slot of a recorded trial."""
    recorded = summary.mode in {"live", "exact"} and summary.slots_per_second > 0.0
    return f"evedrop view {shlex.quote(folder)}{'' if recorded else ' --table'}"


def outcome(summary: Summary) -> tuple[str, bool | None]:
    """The verdict on a run and how its expectations ended, in sentences, and whether that is good; None if that is open."""
    sentence, good = expectations_outcome(summary.expectations, "scenario")
    if summary.ended != "complete":
        sentence, good = f"{summary.ended.splitlines()[0]}; {sentence}", False
    sentence = sentence[0].upper() + sentence[1:]
    if summary.verdict is None:
        return sentence, good
    secret = _GOOD[summary.verdict.outcome]
    both = secret if good is not False else False
    return f"{summary.verdict.sentence}. {sentence}", both


_GOOD = {
    SecrecyOutcome.PERFECT: True,
    SecrecyOutcome.RELATIVE: True,
    SecrecyOutcome.OPEN: None,
    SecrecyOutcome.BROKEN: False,
}


def expectations_outcome(expectations: Sequence[Judged], of: str) -> tuple[str, bool | None]:
    """How many expectations held, and whether that is good; None without any. of: what gives them, such as "scenario"."""
    if not expectations:
        return f"the {of} has no expectations", None
    if number := len(failed(expectations)):
        return f"{number} of {len(expectations)} expectations FAILED", False
    return f"all {len(expectations)} expectations held" if len(expectations) > 1 else "the expectation held", True


def receivers_table(summary: Summary, wide: bool = True, judged: bool = False) -> TextTable:
    """The table of the receivers: their metrics; if `wide`, with all standard errors, and the digests.

    judged: with each eavesdropper's verdict and ratio of errors, which the terminal has below the table.
    """
    shown = columns("column", summary.mode)
    compared = {metric: z for peer in summary.peers.values() for metric, z in peer.z.items() if z is not None}
    table = TextTable.headed(
        ["receiver"],
        [*(column.heading for column in shown), *(["z"] if compared else [])],
        [*(_JUDGED if judged else []), *([_TRUE] if judged and summary.filter else []), *(["digest"] if wide else [])],
        heading(summary),
    )
    for name, peer in summary.peers.items():
        metrics, errors, z, marked = _with_rare_estimate(peer)
        table.add(
            name,
            *(
                estimate(
                    shown_metric(metrics, names),
                    shown_metric(errors, names) if wide or not compared.keys().isdisjoint(names) else None,
                    column.format,
                )
                + (_MARK if marked and not set(_SPLIT).isdisjoint(names) else "")
                for column, names in shown.items()
            ),
            *([_z_text(shown_metric(z, list(compared)), marked)] if compared else []),
            *(_judged(summary, name) if judged else []),
            *([(peer.digest or "–")[:12]] if wide else []),
        )
    return table


_JUDGED, _TRUE = ("verdict", "times the error"), "times the true error"


def _judged(summary: Summary, name: str) -> Iterator[str]:
    """The cells about an eavesdropper's verdict; dashes for the legitimate estimator."""
    secrecy = summary.secrecy.get(name)
    verdict = None if secrecy is None else secrecy.verdict
    yield "–" if verdict is None else verdict.headline
    yield "–" if verdict is None else verdict.times or "–"
    if summary.filter is not None:
        true = summary.filter.true_ratios.get(name)
        yield "–" if true is None else times_text(true.ratio, true.interval)


_Metrics = Mapping[str, float | None]
_MARK = "*"
_SPLIT = ("mean_squared_error", "mean_actual_trace_covariance")
"""The metrics that splitting estimates; a run has one of them."""


def _with_rare_estimate(peer: PeerSummary) -> tuple[_Metrics, _Metrics, _Metrics, bool]:
    """The metrics of a receiver, their standard errors and z, and whether its mean error is that of splitting."""
    rare = peer.rare_estimate
    given = peer.all_metrics, peer.standard_errors, peer.z
    if rare is None or rare.mean_error is None:
        return *given, False
    values = (rare.mean_error, rare.standard_error, rare.z)
    metrics, errors, z = ({**old, **dict.fromkeys(_SPLIT, new)} for old, new in zip(given, values, strict=True))
    return metrics, errors, z, True


def _z_text(z: float | None, marked: bool) -> str:
    return number_text(z, "+.1f") + (_MARK if marked and z is not None else "")


def _split_lines(summary: Summary) -> Iterator[str]:
    """A line for each receiver whose mean error was estimated by splitting, or should have been."""
    for name, peer in summary.peers.items():
        rare = peer.rare_estimate
        if rare is None:
            continue
        if rare.mean_error is None:
            yield f"{name}: splitting gives no estimate that can be trusted: {rare.doubt}"
            continue
        plain = estimate(shown_metric(peer.all_metrics, _SPLIT), shown_metric(peer.standard_errors, _SPLIT))
        yield (
            f"{_MARK} {name}: by splitting, {counted(rare.populations, 'population')} of {rare.trials:,} trials, copied after "
            f"{counted(rare.splits, 'slot')}; the mean over the {summary.trials:,} trials is {plain}"
        )


def remarks(summary: Summary) -> Iterator[str]:
    """Notes to the table: metrics by splitting, metrics that are left out, and links unlike their models."""
    yield from _split_lines(summary)
    for name, why in unloadable_metrics().items():
        yield f"the metric {name} is left out{why}"
    yield from _link_lines(summary.links)
    if summary.controller is not None:
        yield _loop_line(summary.controller)
    if summary.filter is not None:
        yield _filter_line(summary.filter)


def _filter_line(filter_: FilterSummary) -> str:
    """What errors of receivers are measured against, and those against the true state."""
    scatter = filter_.standard_errors.get("mean_true_squared_errors")
    of_mean = dict(scatter) if isinstance(scatter, Mapping) else {}
    own = filter_.standard_errors.get("mean_squared_error")
    of_mean[SENSOR] = None if isinstance(own, Mapping) else own
    errors = {SENSOR: filter_.mean_squared_error, **filter_.mean_true_squared_errors}
    against = ", ".join(f"{name} {estimate(error, of_mean.get(name))}" for name, error in errors.items())
    return f"the sensor sends its filter's estimate, which other errors are measured against; against the true state: {against}"


def verdict_lines(summary: Summary) -> Iterator[tuple[SecrecyOutcome, str]]:
    """For each of several eavesdroppers, the outcome and a line: the verdict, its name, and the ratio of errors."""
    verdicts = {name: entry.verdict for name, entry in summary.secrecy.items() if entry.verdict is not None}
    if len(verdicts) < 2:  # the verdict on all says the same
        return
    words = max((len(verdict.headline) for verdict in verdicts.values()), default=0)
    names = max(map(len, verdicts), default=0)
    for name, verdict in verdicts.items():
        times = f"{verdict.times} its squared error" if verdict.times else ""
        if summary.filter is not None and (true := summary.filter.true_ratios.get(name)) is not None:
            times += f", {times_text(true.ratio, true.interval)} against the true state"
        if times and summary.trials > 1:
            claims = summary.secrecy[name]
            times += " (by means of infinite variance)" if claims.judged_by == "median" else ""
            if verdict.outcome == SecrecyOutcome.RELATIVE and claims.perfect_by_theory:
                times += "; perfect by theory, which trials may never show"
        yield verdict.outcome, f"{verdict.headline:{words}}  {name:{names}}  {times}".rstrip()


def details(summary: Summary) -> Iterator[str]:
    """What run and theory say about secrecy against each eavesdropper, and what hidden packets revealed."""
    for name, verdict in summary.secrecy.items():
        yield verdict.sentence
        if verdict.leak is not None and verdict.leak.bits > 0.0:
            yield f"{name}: packets that hide the state revealed {verdict.leak.text} of its path"


def doubts(summary: Summary) -> list[str]:
    """The lines that say why mean errors are meaningless or too uncertain."""
    return [line for _, line in _doubts(summary)]


def doubtful(summary: Summary) -> set[str]:
    """The receivers that `doubts` is about."""
    return {name for name, _ in _doubts(summary)}


def _doubts(summary: Summary) -> Iterator[tuple[str, str]]:
    """Receivers whose mean error is meaningless or too uncertain, with the reason in a line."""
    for name, peer in summary.peers.items():
        if peer.infinite_variance and peer.error_quantiles and summary.trials > 1:
            low, middle, high = (f"{value:.3g}" for value in peer.error_quantiles.values())
            yield (
                name,
                f"{name}: its error has infinite variance, so the mean over trials says nothing; "
                f"a trial's mean error is {middle} in the median, {low} to {high} in nine of ten",
            )
    yield from _rare_lines(summary)


def surprise(summary: Summary) -> str | None:
    """The most surprising trial, as a sentence; None without one."""
    trial = summary.surprising
    if trial is None:
        return None
    return (
        f"most surprising: trial {trial.trial}, {trial.receiver}, mean error "
        f"{trial.mean_error:.3g} against {trial.expected_error:.3g} expected after the same losses "
        f"(probability {trial.probability:.1g})"
    )


def directions_table(directions: Mapping[str, Mapping[str, DirectionSummary]]) -> TextTable:
    """A row for each receiver and direction: its error, theory, and the verdict on secrecy in that direction."""
    table = TextTable.headed(
        ["receiver", "direction"],
        ["mean error", "theory", "z"],
        ["by theory", "relative secrecy", "perfect secrecy"],
    )
    for receiver, entries in directions.items():
        for direction, values in entries.items():
            table.add(
                receiver,
                direction,
                estimate(values.mean_squared_error, values.standard_error),
                number_text(values.expected),
                number_text(values.z, "+.1f"),
                {True: "unbounded", False: "bounded", None: "–"}[values.unbounded],
                values.relative or "–",
                values.perfect or "–",
            )
    return table


def _link_lines(links: Mapping[str, LinkSummary]) -> Iterator[str]:
    """A line for each link whose delivered fraction differs from its model's."""
    for name, link in links.items():
        if link.within_interval is False and link.interval is not None:
            low, high = link.interval
            yield (
                f"the link of {name} let {link.rate:.5g} of its packets through; its model predicts "
                f"{link.expected_rate:.5g}, and for this run an interval of {low:.5g} to {high:.5g}"
            )


def _rare_lines(summary: Summary) -> Iterator[tuple[str, str]]:
    """Receivers whose expected error is carried by events that too few of the trials contain, with a line each."""
    for name, peer in summary.peers.items():
        rare = peer.rare_events
        if rare is not None and rare.fraction > RARE_FRACTION and summary.trials > 1:
            split = peer.rare_estimate is not None
            enough = f"{count_text(rare.trials)} trials" if math.isfinite(rare.trials) else "no number of trials"
            yield (
                name,
                f"{name}: {fraction_text(rare.fraction)} of its expected error is carried by "
                f"{rare_events_words(summary.trials)}, so its mean over the trials is uncertain, probably too small"
                f"{'' if split else ', and has no z'}; {enough} would leave {fraction_text(RARE_FRACTION)}"
                + ("" if split else "; montecarlo --rare estimates it by splitting"),
            )


def rare_events_words(trials: int) -> str:
    """Events that are too rare for this number of trials."""
    return f"events that are expected fewer than {RARE} times in {trials:,} trials"


def application_lines(summary: Summary) -> Iterator[str]:
    """The lines of the applications that the scenario uses."""
    for name, application in applications_in(summary.applications).items():
        try:
            yield from list(application.lines(summary.applications[name]))
        except CLASS_ERRORS as error:
            if is_own(application):
                raise
            yield f"{name}: its lines cannot be written ({place_of(error)})"


def _loop_line(controller: ControllerSummary) -> str:
    """The line about a closed loop."""
    scatter = controller.standard_errors.get("mean_squared_errors")
    of_mean = scatter if isinstance(scatter, Mapping) else {}  # results of an older version have none
    errors = ", ".join(
        f"{estimate(error, of_mean.get(name))} {name.replace('_', ' the ')}"
        for name, error in controller.mean_squared_errors.items()
    )
    line = f"controller {controller.strategy}, {controller.decisions:,} decisions; the estimator's error is {errors}"
    if controller.failed_fraction:
        line += f"; {controller.failed_fraction:.2%} of inputs were held because a decision failed"
    if controller.clipped_fraction:
        line += f"; {controller.clipped_fraction:.2%} were clipped by the plant"
    return line


def sweep_doubts(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """A line about the means of a sweep that rare events carry, if there are some; rows: as for `sweep_table`."""
    count = sum(row["trials"] > 1 and (row["rare_fraction"] or 0.0) > RARE_FRACTION for row in rows)
    if count:
        are, have = ("are", "have") if count > 1 else ("is", "has")
        yield (
            f"{count:,} of the {len(rows):,} means {are} probably too small, and {have} no z: rare events carry more than "
            f"{fraction_text(RARE_FRACTION)} of the expected error"
        )


def sweep_table(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> TextTable:
    """A row for each point and receiver; rows: those of sweep.parquet, keys: the entries that the sweep changed."""
    metrics = columns("sweep_column")
    compared = [z_column(name) for name in all_metrics() if rows and z_column(name) in rows[0]]
    filtered = any("true_times" in row for row in rows)
    true = [_TRUE] if filtered else []
    heads = [*keys, "peer", *(column.heading for column in metrics), "z", *_JUDGED, *true]
    least = ["z", *(column.heading for column in list(metrics)[:0:-1]), "times the error"]
    words = {"peer", *_JUDGED, *true}
    table = TextTable([TextColumn(head, head not in words) for head in heads], least=least)
    for row in rows:
        table.add(
            *(f"{row[key]}" for key in keys),
            row["peer"],
            *(
                estimate(shown_metric(row, names), shown_metric(row, list(map(error_column, names))), column.format)
                for column, names in metrics.items()
            ),
            number_text(shown_metric(row, compared), "+.1f"),
            "–" if row["verdict"] is None else SecrecyOutcome(row["verdict"]).headline,
            row["times"] or "–",
            *([row.get("true_times") or "–"] if filtered else []),
        )
    return table
