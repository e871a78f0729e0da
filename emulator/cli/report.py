"""The results of runs and sweeps on the terminal: tables, and the sentences that go with them."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from evedrop.cli.narrow import fitted
from evedrop.figures import all_figures, columns, error_column, shown_figure, unloadable_figures, z_column
from evedrop.figures.text import estimate, figure_text
from evedrop.scenario.application import applications_in
from evedrop.score.summary import RARE_SHARE, ControllerSummary, DirectionSummary, LinkSummary, PeerSummary, Summary

if TYPE_CHECKING:
    import pyarrow as pa


_DIGEST_WIDTH = 100
"""The least width of a terminal, in columns, to show digests, and the standard error of every figure."""
_LARGE_COUNT = 1e7


def closing_table(summary: Summary, width: int) -> Table:
    """The table of the receivers: their figures and, if there is room, their digests; width: of the terminal, in columns."""
    trials = f"{summary.trials:,} trials" if summary.trials > 1 else "1 trial"
    rate = f"{summary.slots_per_second:,.0f} slots/s"
    if summary.mode != "live":
        rate = f"{summary.slots_per_second * summary.trials:,.0f} trial-slots/s in memory"
    title = f"{summary.scenario} · {summary.slots:,} slots · {trials} · {rate}"
    if summary.failed_expectations:
        title += f" · {summary.failed_expectations} of {len(summary.expectations)} expectations FAILED"
    wide = width >= _DIGEST_WIDTH
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=wide, collapse_padding=not wide)
    table.add_column("receiver", no_wrap=True)
    shown = columns("column", summary.mode)
    compared = {figure: z for peer in summary.peers.values() for figure, z in peer.z.items() if z is not None}
    for column in shown:
        heading = column.heading if wide else column.heading.replace(" ", "\n", 1)
        table.add_column(heading, justify="right", no_wrap=True)
    if compared:
        table.add_column("z", justify="right", no_wrap=True)
    if wide:
        table.add_column("digest", no_wrap=True)
    for name, peer in summary.peers.items():
        figures, errors, z, marked = _with_rare_estimate(peer)
        table.add_row(
            name,
            *(
                estimate(
                    shown_figure(figures, names),
                    shown_figure(errors, names) if wide or not compared.keys().isdisjoint(names) else None,
                    column.format,
                )
                + (_MARK if marked and not set(_SPLIT).isdisjoint(names) else "")
                for column, names in shown.items()
            ),
            *([_z_text(shown_figure(z, list(compared)), marked)] if compared else []),
            *([(peer.digest or "–")[:12]] if wide else []),
        )
    return table


_Figures = Mapping[str, float | None]
_MARK = "*"
_SPLIT = ("mean_squared_error", "mean_actual_trace_covariance")
"""The figures that splitting estimates; a run has one of them."""


def _with_rare_estimate(peer: PeerSummary) -> tuple[_Figures, _Figures, _Figures, bool]:
    """The figures of a receiver, their standard errors and z, and whether its mean error is that of splitting."""
    rare = peer.rare_estimate
    given = peer.all_figures, peer.standard_errors, peer.z
    if rare is None or rare.mean_error is None:
        return *given, False
    values = (rare.mean_error, rare.standard_error, rare.z)
    figures, errors, z = ({**old, **dict.fromkeys(_SPLIT, new)} for old, new in zip(given, values, strict=True))
    return figures, errors, z, True


def _z_text(z: float | None, marked: bool) -> str:
    return figure_text(z, "+.1f") + (_MARK if marked and z is not None else "")


def _split_lines(summary: Summary) -> Iterator[str]:
    """A line for each receiver whose mean error was estimated by splitting, or should have been."""
    for name, peer in summary.peers.items():
        rare = peer.rare_estimate
        if rare is None:
            continue
        if rare.mean_error is None:
            yield f"{name}: splitting gives no estimate that can be trusted: {rare.doubt}"
            continue
        plain = estimate(shown_figure(peer.all_figures, _SPLIT), shown_figure(peer.standard_errors, _SPLIT))
        yield (
            f"{_MARK} {name}: by splitting, {rare.populations} populations of {rare.trials:,} trials, copied after "
            f"{rare.splits} slot{'' if rare.splits == 1 else 's'}; the mean over the {summary.trials:,} trials is {plain}"
        )


def print_summary(summary: Summary, folder: str, replay: str | None = None) -> None:
    """Print the closing report on standard output; replay: the beginning of the command that shows one trial live."""
    console = terminal()
    if summary.ended != "complete":
        console.print(f"{summary.ended.splitlines()[0]}; the results so far:")
    console.print(closing_table(summary, console.width))
    for line in _split_lines(summary):
        console.print(line)
    for name, why in unloadable_figures().items():
        console.print(f"the figure {name} is left out{why}")
    for line in _link_lines(summary.links):
        console.print(line)
    if summary.controller is not None:
        console.print(_loop_line(summary.controller))
    for one in _secrecy_lines(summary):
        console.print(one)
    for name, peer in summary.peers.items():
        if peer.infinite_variance and peer.error_quantiles and summary.trials > 1:
            low, middle, high = (f"{value:.3g}" for value in peer.error_quantiles.values())
            console.print(
                f"{name}: its error has infinite variance, so the mean over trials says nothing; "
                f"a trial's mean error is {middle} in the median, {low} to {high} in nine of ten"
            )
    for line in (*_rare_lines(summary), *_application_lines(summary), *_expectation_lines(summary)):
        console.print(line)
    surprising = summary.surprising
    if surprising is not None:
        console.print(
            f"most surprising: trial {surprising.trial}, {surprising.receiver}, mean error "
            f"{surprising.mean_error:.3g} against {surprising.expected_error:.3g} expected after the same losses "
            f"(probability {surprising.probability:.1g})"
        )
        if replay is not None:
            console.print(f"    watch it live: {replay} --first-trial {surprising.trial} --trials 1")
    console.print(f"results: {folder}; to look at them: evedrop view {folder}")


def _secrecy_lines(summary: Summary) -> Iterator[str | Table]:
    """The verdicts, what hidden packets revealed, and the table of directions if there are any."""
    for name, verdict in summary.secrecy.items():
        yield verdict.sentence
        if verdict.leak is not None and verdict.leak.bits > 0.0:
            yield f"{name}: packets that hide the state revealed {verdict.leak.text} of its path"
    if summary.directions:
        yield _direction_table(summary.directions)


def _direction_table(directions: Mapping[str, Mapping[str, DirectionSummary]]) -> Table:
    """A row for each receiver and direction: its error, theory, and the verdict on secrecy in that direction."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for heading in ("receiver", "direction"):
        table.add_column(heading, no_wrap=True)
    for heading in ("mean error", "theory", "z"):
        table.add_column(heading, justify="right", no_wrap=True)
    for heading in ("by theory", "relative secrecy", "perfect secrecy"):
        table.add_column(heading, no_wrap=True)
    for receiver, entries in directions.items():
        for direction, one in entries.items():
            table.add_row(
                receiver,
                direction,
                estimate(one.mean_squared_error, one.standard_error),
                figure_text(one.expected),
                figure_text(one.z, "+.1f"),
                {True: "unbounded", False: "bounded", None: "–"}[one.unbounded],
                one.relative or "–",
                one.perfect or "–",
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


def _rare_lines(summary: Summary) -> Iterator[str]:
    """A line for each receiver whose expected error is carried by events that so few trials need not meet."""
    for name, peer in summary.peers.items():
        rare = peer.rare_events
        if rare is not None and rare.share > RARE_SHARE and summary.trials > 1:
            enough = f"{_count(rare.trials)} trials" if math.isfinite(rare.trials) else "no number of trials"
            yield (
                f"{name}: {100 * rare.share:.2g} % of its expected error is carried by events of which {summary.trials:,} trials "
                f"contain fewer than one on average, so its mean and standard error are probably too small; {enough} would "
                f"leave {100 * RARE_SHARE:.2g} %"
                + ("; montecarlo --rare estimates it by splitting" if peer.rare_estimate is None else "")
            )


def _count(number: float) -> str:
    return f"{number:,.0f}" if number < _LARGE_COUNT else f"{number:.1e}"


def _application_lines(summary: Summary) -> Iterator[str]:
    """The lines of the applications that the scenario uses."""
    for name, application in applications_in(summary.applications).items():
        yield from application.lines(summary.applications[name])


def _expectation_lines(summary: Summary) -> Iterator[str]:
    """A line for each expectation, and the command that reproduces a failure."""
    for expectation in summary.expectations:
        yield expectation.sentence
        if expectation.replay is not None:
            yield f"    see it again: {expectation.replay}"


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


def print_sweep(table: pa.Table, keys: tuple[str, ...], folder: str) -> None:
    """Print the table of a sweep: one row for each point and peer."""
    shown = Table(box=SIMPLE_HEAD)
    figures = columns("sweep_column")
    compared = [z_column(name) for name in all_figures() if z_column(name) in table.schema.names]
    for heading in (*keys, "peer", *(column.heading for column in figures), "z", "relative secrecy"):
        shown.add_column(heading, justify="left" if heading in {"peer", "relative secrecy"} else "right", no_wrap=True)
    for row in table.to_pylist():
        shown.add_row(
            *(f"{row[key]}" for key in keys),
            row["peer"],
            *(
                estimate(shown_figure(row, names), shown_figure(row, list(map(error_column, names))), column.format)
                for column, names in figures.items()
            ),
            figure_text(shown_figure(row, compared), "+.1f"),
            row["relative_secrecy"] or "–",
        )
    console = terminal()
    console.print(shown)
    console.print(f"results: {folder}/sweep.parquet, sweep.png")


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """Re-raise: a closed pipe is not a failure of the program, and main.py handles it."""
        raise  # noqa: PLE0704 - rich calls this where it has caught the error

    def print(self, *objects: Any, **named: Any) -> None:
        """Show a table that is wider than the terminal row by row."""
        super().print(*(fitted(one, self) if isinstance(one, Table) else one for one in objects), **named)


def terminal() -> Console:
    """A console on standard output; 140 columns wide if that is not a terminal."""
    return _Console(
        highlight=False,
        markup=False,
        soft_wrap=True,
        width=None if sys.stdout is not None and sys.stdout.isatty() else 140,
    )
