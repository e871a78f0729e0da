"""The pictures of results, drawn by matplotlib: of a run, of a sweep, and of a comparison.

That of a run is made from its tables: errors with bands, what became of each packet, and the plane. That of a sweep shows every
receiver's error against the first entry, in a panel for each combination of the others. That of a comparison is a matrix of
schemes and adversaries, with a mark, a colour and a ratio in every cell.

Source: docs/python.md.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.patches import Patch, Rectangle

from evedrop.counting import counted
from evedrop.errors import UsageError
from evedrop.model.metrics import all_metrics, error_column, shown_metric
from evedrop.model.metrics.text import short_text
from evedrop.model.process import Floats
from evedrop.model.receiver import NOTHING, SILENT
from evedrop.results.reading import Results
from evedrop.results.tables import swept_strategies
from evedrop.scenario.arguments import refuse_unless
from evedrop.scenario.recorded import recorded, recorded_noise, recorded_strategies, recorded_units
from evedrop.score.rare_events import recorded_rare_errors, sound_errors
from evedrop.score.verdict import SecrecyOutcome
from evedrop.show.view import journal_column
from evedrop.show.view.axis_name import are_numbers, as_mathematics, axis_name, squared_unit, without_mathematics
from evedrop.show.view.error_floor import ErrorAxis, error_floor
from evedrop.show.view.figure_style import drawing, save
from evedrop.show.view.lanes import EAVESDROPPER
from evedrop.show.view.palette import TRUTH_CURVE, VERDICTS, hexadecimal, paper_inks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from evedrop.results.comparison import Cell, Comparison, SchemeResult
    from evedrop.show.view.shown_figure import ShownFigure


_WIDTH = 8.4
_LETTERS = 100  # of a title that has room in a line
_LAST = 300  # slots of lanes and plane unless told otherwise
_MARGIN = 0.25  # around the truth in the plane, as a fraction of its extent
_LINES, _DOTS = ("-", "-.", ":"), (".", "x", "+")
"""Of the receivers in turn if there are more than `_ALIKE`, because colours alone would not suffice."""
_ALIKE = 7
_HEIGHTS: Mapping[str, Callable[[int], float]] = {
    "errors": lambda _: 3.2,
    "lanes": lambda receivers: 0.9 + 0.3 * receivers,
    "plane": lambda _: 3.8,
}
"""Panel → its height in inches, for a number of receivers."""
_AROUND = 0.8  # inches above and below the axes, for its title and labels
_WIDTHS: Mapping[str, float] = {"page": 1.0, "column": 0.72}
"""Width of a figure → the factor of these heights."""


def run_figure(
    results: Results, wanted: Sequence[str], slots: range | None, trial: int | None, width: str = "page"
) -> ShownFigure:
    """Draw these panels, all of them if none is named, one below the other; arguments and errors as `RunResults.plot`."""
    names = list(wanted) or list(_HEIGHTS)
    for name in names:
        if not isinstance(name, str) or name not in _HEIGHTS:
            raise UsageError(f"plot: there is no panel {name!r}; expected {', '.join(_HEIGHTS)}")
    refuse_unless(slots is None or isinstance(slots, range), "slots", slots, "a range of slots, such as range(0, 50)")
    refuse_unless(
        isinstance(width, str) and width in _WIDTHS, "width", width, '"page", or "column" for a column of a journal'
    )
    column = width == "column"
    rows = results.slots
    last = pc.max(rows["slot"]).as_py()
    if last is None:
        raise UsageError(f"plot: {results.folder} has no slots to plot; run the scenario again")
    if slots is not None and (not slots or slots.step != 1 or not 0 <= slots[0] <= slots[-1] <= last):
        raise UsageError(f"plot: {slots} are not slots of the run; expected some such as range(0, {last + 1})")
    receivers = rows["peer"].unique().to_pylist()
    inks = paper_inks(receivers, recorded_strategies(results.folder))
    recorded_trial = None if names == ["errors"] else _RecordedTrial(results, inks, trial, slots)
    heights = [_HEIGHTS[name](len(receivers)) * _WIDTHS[width] for name in names]
    with drawing(
        journal_column.WIDTH if column else _WIDTH, sum(heights), journal_column.STYLE if column else None
    ) as figure:
        if not column:
            figure.suptitle(without_mathematics(str(results.summary["scenario"])), x=0.02, ha="left", fontsize=11)
        places = figure.subplots(len(names), 1, height_ratios=heights, squeeze=False)[:, 0]
        for name, axes in zip(names, places, strict=True):
            if name == "errors":
                floor = error_floor(recorded_noise(results.folder), pc.max(rows["trials"]).as_py())
                what = "trace of the actual covariance" if _without_states(rows) else "squared error"
                y_label = f"{what}{without_mathematics(squared_unit(recorded_units(results.folder)))}"
                if results.summary.get("filter") is not None:
                    y_label += "\nto the sensor's estimate"
                rare = recorded_rare_errors(results.folder, last + 1, pc.max(rows["trials"]).as_py())
                _errors(axes, rows, inks, slots, floor, what, rare)
                axes.set_ylabel(y_label)
            elif recorded_trial is not None:
                (recorded_trial.lanes if name == "lanes" else recorded_trial.plane)(axes)
            height = heights[names.index(name)]
            if column:
                journal_column.fit(axes, name == "errors", height - 0.5)
            elif name == "errors":
                journal_column.name_curves(axes, height - _AROUND)
    return figure


def _without_states(rows: pa.Table) -> bool:
    """Whether slots have no errors, only covariances."""
    return bool(np.isnan(rows["mean_squared_error"].to_numpy()).all())


def _errors(
    axes: Axes,
    rows: pa.Table,
    inks: Mapping[str, str],
    slots: range | None,
    floor: float,
    what: str,
    rare: Mapping[str, Floats],
) -> None:
    """The mean squared error of each slot, theory dashed, and a band of two standard errors of its logarithm.

    inks: of each receiver; floor: values below it are drawn at it; what: is drawn, in words; rare: receiver → what rare events
    carry of its expected error in each slot of the run. There is no band where they carry more than it covers.
    """
    many, gaps, curves = False, False, dict[str, tuple[dict[str, Any], Floats, Floats]]()
    for name in inks:
        mine = rows.filter(pc.equal(rows["peer"], name))
        if slots is not None:
            mine = mine.filter(pc.is_in(mine["slot"], pa.array(slots, pa.int64())))
        columns = {column: mine[column].to_numpy() for column in mine.column_names if column != "peer"}
        error, theory = columns["mean_squared_error"], columns["theoretical_trace_covariance"]
        if np.isnan(error).all():
            error = columns["mean_actual_trace_covariance"]
        curves[name] = columns, error, theory
    axis = ErrorAxis.of([height for _, *heights in curves.values() for height in heights], floor)
    floor = axis.low if axis is not None and axis.below else floor
    for i, (name, (columns, error, theory)) in enumerate(curves.items()):
        ink = inks[name]
        dot = "o" if len(error) == 1 else ""  # a line through one slot cannot be seen
        line = _LINES[i % len(_LINES)] if len(inks) > _ALIKE else _LINES[0]
        axes.plot(columns["slot"], np.maximum(error, floor), line, color=ink, label=name, linewidth=1.3, marker=dot)
        axes.plot(columns["slot"], np.maximum(theory, floor), "--", color=ink, linewidth=0.9)
        if (columns["trials"] > 1).any():
            many = True
            with np.errstate(all="ignore"):
                scatter = sound_errors(columns["standard_error"], rare[name][columns["slot"]] if name in rare else None)
                fraction = np.exp(2.0 * scatter / error)  # symmetric on the logarithmic axis, and never below 0
                gaps |= bool(np.isnan(scatter[columns["trials"] > 1]).any())
            below, above = (np.maximum(edge, floor) for edge in (error / fraction, error * fraction))
            axes.fill_between(columns["slot"], below, above, color=ink, alpha=0.25, linewidth=0)
    if axis is not None:  # otherwise the axis has nothing to show, and no logarithms
        axes.set_yscale("log")
        axes.set_ylim(axis.low, axis.high)
    axes.set_xlabel("slot")
    title = what + (", mean ± 2 standard errors" if many else "") + "; dashed: theory"
    title += "; no band: rare events" if gaps else ""
    words = "" if axis is None else axis.words
    axes.set_title(title + (words if len(title + words) < _LETTERS else words.replace("; ", ";\n")))


class _RecordedTrial:
    """One recorded trial in the slots that are shown."""

    def __init__(self, results: Results, inks: Mapping[str, str], trial: int | None, slots: range | None) -> None:
        self.inks = inks
        rows = results.trials
        trials = rows["trial"].unique().to_pylist()
        if trial is None and trials:
            trial = trials[0]
        if trial not in trials:
            recorded_trials = (
                f"recorded are {', '.join(map(str, trials[:8]))}" if trials else "the run has recorded none"
            )
            raise UsageError(f"plot: trial {trial} is not recorded; {recorded_trials}, and 'errors' needs none")
        rows = rows.filter(pc.equal(rows["trial"], trial))
        last = int(pc.max(rows["slot"]).as_py())
        self.slots = slots or range(max(0, last + 1 - _LAST), last + 1)
        rows = rows.filter(pc.is_in(rows["slot"], pa.array(self.slots, pa.int64())))
        self.rows = {name: rows.filter(pc.equal(rows["peer"], name)) for name in inks}
        self.title = f"trial {trial}, slots {self.slots[0]} to {self.slots[-1]}"
        process = recorded(results.folder).scenario.process
        states = process.states or [f"x[{i}]" for i in range(len(process.A))]
        units = process.units or [""] * len(states)
        names = (f"{state} ({unit})" if unit else state for state, unit in zip(states, units, strict=True))
        self.states = [*map(without_mathematics, names)]

    def lanes(self, axes: Axes) -> None:
        """What became of each packet, a lane for each receiver."""
        codes = np.array([self._codes(rows) for rows in self.rows.values()])
        extent = (self.slots[0] - 0.5, self.slots[-1] + 0.5, len(codes) - 0.5, -0.5)
        axes.imshow(EAVESDROPPER.pixels(codes), aspect="auto", interpolation="nearest", extent=extent)
        axes.set_yticks(range(len(codes)), list(self.rows))
        axes.set_yticks(np.arange(len(codes) - 1) + 0.5, minor=True)
        axes.grid(visible=False)
        axes.grid(which="minor", axis="y", color="white", linewidth=2.0)
        axes.tick_params(which="minor", length=0)
        axes.set_xlabel("slot")
        axes.set_title(f"packets; {self.title}")
        marks = [Patch(color=ink, label=word) for word, ink in EAVESDROPPER.legend(np.unique(codes).tolist())]
        axes.legend(handles=marks, loc="upper left", bbox_to_anchor=(1.0, 1.0))

    @staticmethod
    def _codes(rows: pa.Table) -> NDArray[np.uint8]:
        shown = pc.if_else(pc.equal(rows["sent"].cast(pa.string()), NOTHING), SILENT, rows["action"].cast(pa.string()))
        return np.array([EAVESDROPPER.words.index(word) for word in shown.to_pylist()], np.uint8)

    def plane(self, axes: Axes) -> None:
        """The truth and the estimates, those of eavesdroppers as dots: in the plane of the first two states, or against the slot.

        The truth determines the limits: an estimate far from it lies outside the picture.
        """
        first = next(iter(self.rows.values()))
        truth = _path(first, "x")
        axes.plot(*truth, color=hexadecimal(TRUTH_CURVE), linewidth=2.6, alpha=0.8, label="truth")
        for i, (name, rows) in enumerate(self.rows.items()):
            dot = _DOTS[i % len(_DOTS)] if len(self.inks) > _ALIKE else _DOTS[0]
            manner: dict[str, Any] = (
                {"linewidth": 1.2} if i == 0 else {"marker": dot, "markersize": 4.0, "linewidth": 0.0}
            )
            axes.plot(*_path(rows, "x_hat"), color=self.inks[name], label=name, **manner)
        for limits, values in ((axes.set_xlim, truth[0]), (axes.set_ylim, truth[1])):
            margin = _MARGIN * (np.ptp(values) or 1.0)
            limits(values.min() - margin, values.max() + margin)
        axes.set_xlabel("slot" if len(self.states) == 1 else self.states[0])
        axes.set_ylabel(self.states[0] if len(self.states) == 1 else self.states[1])
        axes.set_title(f"truth and estimates; {self.title}")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _path(rows: pa.Table, column: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The first two states of every slot, or the slot and the only state."""
    values = np.array(rows[column].to_pylist())
    if values.shape[1] == 1:
        return rows["slot"].to_numpy().astype(float), values[:, 0]
    return values[:, 0], values[:, 1]


_MARKS = "osD^vPX*"
_MOST_PANELS = 6


def draw_sweep(path: Path, table: pa.Table, keys: Sequence[str]) -> None:
    """Draw the table of a sweep over these keys as `path`.png and `path`.pdf: simulated errors as marks, theory as lines.

    Bars at the marks are standard errors, except where rare events carry more of the mean than these cover.
    """
    save(path, sweep_figure(table, keys))


def sweep_figure(table: pa.Table, keys: Sequence[str]) -> ShownFigure:
    """The plot of a sweep as a figure."""
    count = min(_MOST_PANELS, len(_others(table.to_pylist(), keys)))
    with drawing(1.2 + 4.2 * count, 3.9) as figure:
        _draw_sweep_on(list(figure.subplots(1, count, squeeze=False)[0]), table, keys)
    return figure


def _others(rows: list[dict[str, Any]], keys: Sequence[str]) -> list[tuple[Any, ...]]:
    """The combinations of values of all entries but the first. The first `_MOST_PANELS` get a panel each."""
    return list(dict.fromkeys(tuple(row[key] for key in keys[1:]) for row in rows))


def _draw_sweep_on(axes: list[Axes], table: pa.Table, keys: Sequence[str]) -> None:
    rows, strategies = table.to_pylist(), swept_strategies(table)
    marks, lines = (
        [name for name, scheme in all_metrics().items() if scheme.sweep_picture == way] for way in ("marks", "lines")
    )
    inks = paper_inks(dict.fromkeys(row["peer"] for row in rows), strategies)
    combinations, gaps, zeros = _others(rows, keys), False, False
    if len(combinations) > len(axes):
        words = f"the first {len(axes)} of {len(combinations):,} combinations"
        axes[0].figure.suptitle(words, x=0.02, ha="left", fontsize=9)
    for scheme, values in zip(axes, combinations, strict=False):
        here = [row for row in rows if tuple(row[key] for key in keys[1:]) == values]
        swept = list(dict.fromkeys(row[keys[0]] for row in here))
        numbers, places = are_numbers(swept), dict(zip(swept, _positions(swept), strict=True))
        for (peer, ink), mark in zip(inks.items(), itertools.cycle(_MARKS), strict=False):
            mine = [row for row in here if row["peer"] == peer]  # not at every point if the eavesdroppers are swept
            x = [places[row[keys[0]]] for row in mine]
            theory = np.array([_height(row, lines) for row in mine])
            errors = np.array([_height(row, [error_column(name) for name in marks]) for row in mine])
            sound = sound_errors(errors, np.array([_height(row, ["rare_fraction"]) for row in mine]) * theory)
            gaps |= bool((np.isnan(sound) & ~np.isnan(errors)).any())
            means = [_height(row, marks) for row in mine]
            zeros |= 0.0 in means
            scheme.plot(x, theory, "-" if numbers else "_", color=ink, linewidth=1.2, markersize=26)
            scheme.errorbar(
                x,
                means,
                sound,
                fmt=mark,
                color=ink,
                markerfacecolor="white",
                elinewidth=1.0,
                capsize=2.5,
                label=peer,
            )
        if not numbers:
            scheme.set_xticks(list(places.values()), [without_mathematics(str(value)) for value in swept])
            scheme.set_xlim(-0.5, len(swept) - 0.5)
        scheme.set_yscale("log")
        scheme.set_xlabel(as_mathematics(axis_name(keys[0])))
        title = ", ".join(f"{key} = {value}" for key, value in zip(keys[1:], values, strict=True))
        scheme.set_title(without_mathematics(title))
    limits = [limit for scheme in axes for limit in scheme.get_ylim()]
    for scheme in axes:
        scheme.set_ylim(min(limits), max(limits))
    more = (";\nno ±: rare events" if gaps else "") + (";\nnot drawn: 0" if zeros else "")
    axes[0].set_ylabel(f"mean error ± standard error (lines: theory{more})")
    axes[0].legend()


def _height(row: dict[str, Any], metrics: list[str]) -> float:
    value = shown_metric(row, metrics)
    return math.nan if value is None else value


def _positions(values: list[Any]) -> list[float]:
    """Places on the axis: numbers as they are; other values side by side."""
    if are_numbers(values):
        return [float(value) for value in values]
    return [float(i) for i in range(len(values))]


# Blue for secrecy kept, darker where perfect; orange for broken: distinct with any colour blindness, and in greyscale.
_GROUND = {outcome: hexadecimal(colour) for outcome, colour in VERDICTS.items()}
_INK = {
    SecrecyOutcome.PERFECT: "white",
    SecrecyOutcome.RELATIVE: "#10202e",
    SecrecyOutcome.OPEN: "#3c3c3c",
    SecrecyOutcome.BROKEN: "#2a1200",
}
_SAID = {
    SecrecyOutcome.PERFECT: "perfectly secret: its error grows without bound",
    SecrecyOutcome.RELATIVE: "secret: it stays above the legitimate error",
    SecrecyOutcome.OPEN: "cannot tell yet",
    SecrecyOutcome.BROKEN: "not secret",
}
_NOTABLE = 1.1  # the factor by which an attack must raise the legitimate error to be noted
_FACTS = ("legitimate\nerror", "ACKs", "bits\na slot", "energy\na slot", "secret bits\na slot (+ once)")
_FACT_WIDTH = 1.25
_LEFT = _FACT_WIDTH * len(_FACTS)
_LEAST_WIDTH = 9.0


def draw_comparison(path: Path, result: Comparison) -> None:
    """Draw a comparison as `path`.png and `path`.pdf. The PNG file names its rows and columns in its metadata."""
    save(path, comparison_figure(result), shown(result))


def shown(comparison: Comparison) -> dict[str, str]:
    """What the picture of a comparison shows, by keyword, as its PNG file says it: so that a kept picture can be checked."""
    return {
        "Rows": ",".join(comparison.schemes),
        "Columns": ",".join(comparison.adversaries),
        "Size": f"{comparison.slots} slots, {comparison.trials} trials, seed {comparison.seed}",
    }


def comparison_figure(comparison: Comparison) -> ShownFigure:
    """The picture of a comparison as a figure."""
    width, height = 0.92 * (_LEFT + _right(comparison) + 2.0), 2.3 + 0.56 * len(comparison.schemes)
    with drawing(width, height) as figure:
        _draw_comparison_on(figure.subplots(), comparison)
    return figure


def _right(comparison: Comparison) -> float:
    """The right end of the picture: room for the adversaries, and for the legend."""
    return max(float(len(comparison.adversaries)) + 1.1, _LEAST_WIDTH)


def _draw_comparison_on(axes: Axes, comparison: Comparison) -> None:
    schemes, adversaries, left = list(comparison.schemes.values()), comparison.adversaries, _LEFT
    axes.set_axis_off()
    axes.set_xlim(-left - 2.0, _right(comparison))
    axes.set_ylim(len(schemes) + 1.6, -2.6)
    for row, scheme in enumerate(schemes):
        weight = "bold" if scheme.name in comparison.dominant else "normal"
        axes.text(-left - 0.1, row, scheme.name, ha="right", va="center", fontsize=10.5, fontweight=weight)
        for i, fact in enumerate(_facts(scheme)):
            place = -left + _FACT_WIDTH * (i + 0.5)
            axes.text(place, row, fact, ha="center", va="center", fontsize=9, color="#33383d")
        for column, adversary in enumerate(adversaries):
            _cell(axes, column, row, scheme, scheme.cells[adversary])
    for i, head in enumerate(_FACTS):
        axes.text(-left + _FACT_WIDTH * (i + 0.5), -0.62, head, ha="center", va="bottom", fontsize=9)
    for column, adversary in enumerate(adversaries):
        axes.text(column + 0.42, -0.62, adversary, ha="left", va="bottom", fontsize=9.5, rotation=38)
    _legend(axes, comparison, left)


def _facts(scheme: SchemeResult) -> Iterator[str]:
    needs = scheme.needs
    legitimate = scheme.legitimate
    scatter = f"\n± {short_text(legitimate.standard_error)}" if legitimate.standard_error else ""
    yield short_text(legitimate.typical) + ("\nmed" if legitimate.infinite_variance else scatter)
    yield "needed" if needs.acknowledgements else "–"
    yield short_text(needs.bits_per_slot)
    yield f"{needs.energy_per_slot:.3g}"
    once = f" (+ {needs.initial_secret_bits})" if needs.initial_secret_bits else ""
    yield f"{needs.secret_bits_per_slot}{once}" if needs.secret_bits_per_slot else "–"


def _cell(axes: Axes, column: int, row: int, scheme: SchemeResult, cell: Cell) -> None:
    box: Any = {"xy": (column + 0.03, row - 0.47), "width": 0.94, "height": 0.94, "linewidth": 0}
    word = cell.verdict
    if word is None or cell.ratio is None or cell.legitimate is None:
        axes.add_patch(Rectangle(**box, facecolor="white"))
        axes.text(column + 0.5, row, "·", ha="center", va="center", color="#9aa0a6", fontsize=9)
        return
    axes.add_patch(Rectangle(**box, facecolor=_GROUND[word]))
    axes.text(column + 0.5, row - 0.17, word.glyph, ha="center", va="center", color=_INK[word], fontsize=11)
    legitimate = cell.legitimate.typical / scheme.legitimate.typical if scheme.legitimate.typical else math.inf
    raised = f"\nlegitimate {short_text(legitimate)}×" if legitimate > _NOTABLE else ""
    axes.text(
        column + 0.5,
        row + 0.24,
        f"{short_text(cell.ratio)}×{raised}",
        ha="center",
        va="center",
        color=_INK[word],
        fontsize=6.6 if raised else 8.4,
        linespacing=1.1,
    )


def _legend(axes: Axes, comparison: Comparison, left: float) -> None:
    rows = len(comparison.schemes)
    place = -left - 1.9
    for word, meaning in _SAID.items():
        axes.add_patch(Rectangle((place, rows - 0.12), 0.42, 0.44, facecolor=_GROUND[word], linewidth=0))
        axes.text(place + 0.21, rows + 0.1, word.glyph, ha="center", va="center", color=_INK[word], fontsize=9.5)
        axes.text(place + 0.52, rows + 0.1, meaning, ha="left", va="center", fontsize=8.8)
        place += 1.0 + 0.092 * len(meaning)
    notes = [
        f"{without_mathematics(comparison.title)}: {counted(comparison.slots, 'slot')}, "
        f"{counted(comparison.trials, 'trial')}.",
        "n×: the adversary's error over the legitimate one. legitimate n×: an attack raises the legitimate error n-fold. "
        "·: not defined." + (f" Bold: dominates ({', '.join(comparison.dominant)})." if comparison.dominant else ""),
    ]
    if any(scheme.legitimate.infinite_variance for scheme in comparison.schemes.values()):
        notes.append("med: the median trial, since the variance over trials is infinite.")
    axes.text(-left - 1.9, rows + 0.55, "\n".join(notes), ha="left", va="top", fontsize=8.8, linespacing=1.5)
