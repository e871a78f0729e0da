"""The sections of the report of a sweep. To add one, write a function and add it to `SWEEP_SECTIONS`."""

from __future__ import annotations

import contextlib
import json
import math
import platform
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from markupsafe import Markup, escape

from evedrop.counting import counted
from evedrop.errors import UsageError
from evedrop.model.checks import toml_of
from evedrop.model.metrics import all_metrics, error_column, shown_metric
from evedrop.model.process import Floats
from evedrop.results.tables import swept_strategies
from evedrop.scenario.loading import value_of
from evedrop.score.rare_events import sound_errors
from evedrop.score.verdict import SecrecyOutcome, weakest
from evedrop.show.report.chart import Curve, LogChart
from evedrop.show.report.closing import SWEEP_FILE, SWEEP_TABLE, sweep_doubts, sweep_table
from evedrop.show.report.page import facts_table, made
from evedrop.show.report.travel import OF_PAGE, SCENARIO, circumstances, download
from evedrop.show.view.axis_name import are_numbers, axis_name
from evedrop.show.view.error_floor import mean_band
from evedrop.show.view.palette import paper_inks
from evedrop.system.files import Unreadable, text_of

_MOST_BYTES = 2**24
_MOST_CHARTS = 12
_NAMES_A_FILE = re.compile(r"\bfile\w*\s*=|_file\s*=")
_MODES = {"covariance-only": ["--covariance-only"], "error-coordinates": ["--error-coordinates"]}


@dataclass(frozen=True)
class SweepSource:
    """The folder of a sweep, read."""

    folder: Path
    table: pa.Table
    rows: Sequence[Mapping[str, Any]]
    """Of the table."""
    scenario: str
    changes: Mapping[str, Any]
    grid: Mapping[str, Sequence[Any]]
    """Entry → its values."""
    mode: str
    amount: str
    """How much was run."""
    outcome: str
    """At how many points the state is secret, as a sentence, or how many points were done."""
    lacking: str
    """How many points were done before the sweep was interrupted; empty if all were."""
    inks: Mapping[str, str]
    """Receiver → its colour."""

    @classmethod
    def read(cls, folder: Path) -> SweepSource:
        """Read a folder. Raises UsageError if it is not that of a sweep, or none of its points is done."""
        if not (folder / SWEEP_TABLE).exists() and (folder / SWEEP_FILE).exists():
            raise UsageError(
                f"{folder} has nothing yet: no point of its sweep is done; go on with the sweep (--resume)"
            )
        try:
            entries = json.loads(text_of(folder / SWEEP_FILE, _MOST_BYTES))
            table, grid = pq.read_table(folder / SWEEP_TABLE), entries["over"]
            rows = table.to_pylist()
            inks = paper_inks(dict.fromkeys(row["peer"] for row in rows), swept_strategies(table))
            done, planned = len({tuple(row[key] for key in grid) for row in rows}), math.prod(map(len, grid.values()))
            sizes = (_size([row[f"{name}s"] for row in rows], name) for name in ("slot", "trial"))
            amount = " · ".join((f"{counted(done, 'point')} of {', '.join(grid)}", *sizes))
            outcome = "; ".join(sweep_outcome(table.to_pylist(), list(grid), done, planned))
            changes, mode = entries["changes"], entries["mode"]
            lacking = _points_done(done, planned) if done < planned else ""
            return cls(folder, table, rows, entries["scenario"], changes, grid, mode, amount, outcome, lacking, inks)
        except Exception as error:  # pyarrow raises many kinds of errors for a damaged file
            raise UsageError(f"{folder} cannot be read as a sweep ({error}); run the sweep again") from error


def sweep_outcome(rows: Sequence[Mapping[str, Any]], keys: Sequence[str], done: int, planned: int) -> Iterator[str]:
    """The verdict at each point, where there are eavesdroppers, then how many points were done if that is not said."""
    at: dict[tuple[Any, ...], list[SecrecyOutcome]] = {}
    for row in rows:
        if row["verdict"] is not None:
            at.setdefault(tuple(row[key] for key in keys), []).append(SecrecyOutcome(row["verdict"]))
    counts = Counter(map(weakest, at.values()))
    if list(counts.values()) == [planned]:
        yield f"{next(iter(counts)).headline} at all {planned:,} points"
        return
    if counts:
        yield ", ".join(
            f"{outcome.headline} at {counts[outcome]:,}" for outcome in reversed(SecrecyOutcome) if counts[outcome]
        )
    if done < planned:
        yield _points_done(done, planned)
    elif not counts:
        yield f"All {planned:,} points were done"


def _points_done(done: int, planned: int) -> str:
    return f"{done:,} of {planned:,} points were done"


def _size(counts: Sequence[int], of: str) -> str:
    """The counts of all points in words, such as "1,000 slots"; their range if the points differ."""
    least, most = min(counts), max(counts)
    return counted(least, of) if least == most else f"{least:,} to {counted(most, of)}"


def _verdicts(of: SweepSource) -> Iterator[Markup]:
    """The number of points with each verdict."""
    counts_of, lines = dict[str, Counter[str]](), list[str]()
    for row in of.rows:
        if row["verdict"] is not None:
            counts_of.setdefault(row["peer"], Counter())[SecrecyOutcome(row["verdict"]).headline] += 1
    for name, counts in counts_of.items():
        word = ", ".join(f"{word} at {counted(count, 'point')}" for word, count in counts.items())
        lines.append(f"{name}: {word}")
    yield made("sentences", lines)


def _errors(of: SweepSource) -> Iterator[Markup]:
    """The error of every receiver against the first entry, in a chart for each combination of the others."""
    first, *others = of.grid
    combinations = list(dict.fromkeys(tuple(row[key] for key in others) for row in of.rows))
    for values in combinations[:_MOST_CHARTS]:
        rows = [row for row in of.rows if tuple(row[key] for key in others) == values]
        where = ", ".join(f"{key} = {value}" for key, value in zip(others, values, strict=True))
        words = None
        if not are_numbers(row[first] for row in rows):
            words = list(dict.fromkeys(str(row[first]) for row in rows))
        drawn = [
            _curve(name, of.inks[name], [row for row in rows if row["peer"] == name], first, words)
            for name in dict.fromkeys(row["peer"] for row in rows)
        ]
        label = (
            f"Mean error of every receiver against {first}, with what theory expects. The table has the values. {where}"
        )
        few = " (none where rare events carry the mean)" if any(gaps for _, gaps in drawn) else ""
        shown = f"Mean error with its 95 % interval{few}; dotted: theory{'; ' if where else ''}{where}"
        curves = [curve for curve, _ in drawn]
        yield LogChart(label, _axis(first), shown, curves, words, y_axis="mean error").figure or Markup()
    if len(combinations) > _MOST_CHARTS:
        yield made(
            "paragraph",
            f"Charts of the first {_MOST_CHARTS} of {len(combinations):,} combinations; all are in the table.",
        )


def _axis(key: str) -> Markup:
    return Markup(escape(axis_name(key)).replace("μ_d", Markup("μ<sub>d</sub>")))  # noqa: S704 - escaped


def _curve(
    name: str, ink: str, rows: Sequence[Mapping[str, Any]], key: str, words: Sequence[str] | None
) -> tuple[Curve, bool]:
    """The curve of a receiver, and whether marks have no bars because rare events carry the mean.

    words: the names of the places of the axis, if it has names.
    """
    marks, lines = (
        [metric for metric, kind in all_metrics().items() if kind.sweep_picture == way] for way in ("marks", "lines")
    )
    x = [float(row[key]) if words is None else float(words.index(str(row[key]))) for row in rows]
    y, theory = (_values(rows, names) for names in (marks, lines))
    errors = _values(rows, [error_column(metric) for metric in marks])
    sound = sound_errors(errors, _values(rows, ["rare_fraction"]) * theory)
    band = mean_band(y, np.nan_to_num(sound), np.array([row["trials"] for row in rows]))
    curve = Curve(name, ink, np.array(x), y, *band, theory, bars=True)
    return curve, bool((np.isnan(sound) & ~np.isnan(errors)).any())


def _values(rows: Sequence[Mapping[str, Any]], names: list[str]) -> Floats:
    metrics = [shown_metric(row, names) for row in rows]
    return np.array([math.nan if metric is None else metric for metric in metrics], np.float64)


def _metrics(of: SweepSource) -> Iterator[Markup]:
    """The metrics of all points, with their standard errors, theory, and z."""
    caption = (
        "A row for each point and receiver: means ± standard errors; z: the z-score of the error against theory; "
        "times the error: an eavesdropper's squared error over the legitimate one, in the second half of the run; "
        "if the sensor measures, against the estimate that it sends, and times the true error: against the true state"
    )
    yield made("table", sweep_table(of.rows, tuple(of.grid)), caption)
    yield made("sentences", list(sweep_doubts(of.rows)))


def _repeat(of: SweepSource) -> Iterator[Markup]:
    """The scenario to save unless it is built in, the command that repeats the sweep, and when and where it was made."""
    name = of.scenario
    with contextlib.suppress(OSError, Unreadable):
        text = text_of(of.folder / SCENARIO, _MOST_BYTES)
        name = SCENARIO
        yield made("paragraph", "Save the scenario, and run the command in its folder.")
        yield download(SCENARIO, text)
        if _NAMES_A_FILE.search(text):
            yield made("paragraph", "Files that the scenario names do not travel with this page.")
    words = ["evedrop", "sweep", name]
    for key, values in of.grid.items():
        words += ["--over", f"{key}={','.join(_listed(values))}"]
    for key, value in of.changes.items():
        words += [f"--{key}", _toml(value)] if key == "trials" else ["--set", f"{key}={_toml(value)}"]
    words += _MODES.get(of.mode, [])
    yield made("code", shlex.join(words))
    facts = {**circumstances(of.folder / SWEEP_TABLE), "python": platform.python_version(), "numpy": np.__version__}
    yield facts_table({**facts, "evedrop": version("evedrop")}, f"Date of the results; versions, {OF_PAGE}")


def _listed(values: Sequence[Any]) -> list[str]:
    """Values as the command line takes a list of them: all with quotes where one needs them, for they are read together."""
    return [str(value) if all(map(_is_plain, values)) else toml_of(value) for value in values]


def _toml(value: Any) -> str:
    """A value as the command line takes it; a word without quotes unless it would be read as something else."""
    return str(value) if _is_plain(value) else toml_of(value)


def _is_plain(value: Any) -> bool:
    """Whether a value is a word that is read as such without quotes."""
    return isinstance(value, str) and value_of(value) == value and not {",", ":"} & set(value)


SWEEP_SECTIONS: Mapping[str, Callable[[SweepSource], Iterator[Markup]]] = {
    "Verdicts": _verdicts,
    "Errors": _errors,
    "Metrics": _metrics,
    "Repeat it": _repeat,
}
"""Title → the function that makes the contents, in the order of the page."""
