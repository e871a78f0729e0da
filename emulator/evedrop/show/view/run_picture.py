"""The figure of a run from its tables: errors with bands, what became of each packet, and the plane.

Source: docs/python.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.patches import Patch

from evedrop.errors import UsageError
from evedrop.model.process import Floats
from evedrop.model.receiver import NOTHING, SILENT
from evedrop.results.reading import Results
from evedrop.scenario.arguments import refuse_unless
from evedrop.scenario.loading.recorded import recorded, recorded_noise
from evedrop.show.view.error_floor import ErrorAxis, error_floor, floor_words
from evedrop.show.view.figure_style import drawing
from evedrop.show.view.lanes import EAVESDROPPER
from evedrop.show.view.palette import RECEIVERS, TRUTH_CURVE, colour, hexadecimal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from evedrop.show.view.shown_figure import ShownFigure

_WIDTH = 8.4
_LAST = 300  # slots of lanes and plane unless told otherwise
_MARGIN = 0.25  # around the truth in the plane, as a fraction of its extent
_LINES, _DOTS = ("-", "-.", ":"), (".", "x", "+")
"""Of the first receivers with different colours, of the next ones, whose colours are the same, and so on."""
_HEIGHTS: Mapping[str, Callable[[int], float]] = {
    "errors": lambda _: 3.2,
    "lanes": lambda receivers: 0.9 + 0.3 * receivers,
    "plane": lambda _: 3.8,
}
"""Panel → its height in inches, for a number of receivers."""


def run_figure(results: Results, wanted: Sequence[str], slots: range | None, trial: int | None) -> ShownFigure:
    """Draw these panels, all of them if none is named, one below the other; arguments and errors as `RunResults.plot`."""
    names = list(wanted) or list(_HEIGHTS)
    for name in names:
        if name not in _HEIGHTS:
            raise UsageError(f"plot: there is no panel {name!r}; expected {', '.join(_HEIGHTS)}")
    refuse_unless(slots is None or isinstance(slots, range), "slots", slots, "a range of slots, such as range(0, 50)")
    rows = results.slots
    last = pc.max(rows["slot"]).as_py()
    if slots is not None and (not slots or slots.step != 1 or not 0 <= slots[0] <= slots[-1] <= last):
        raise UsageError(f"plot: {slots} are not slots of the run; expected some such as range(0, {last + 1})")
    receivers = rows["peer"].unique().to_pylist()
    noise = recorded_noise(results.folder)
    recorded_trial = None if names == ["errors"] else _RecordedTrial(results, receivers, trial, slots)
    heights = [_HEIGHTS[name](len(receivers)) for name in names]
    with drawing(_WIDTH, sum(heights)) as figure:
        figure.suptitle(str(results.summary["scenario"]), x=0.02, ha="left", fontsize=11)
        places = figure.subplots(len(names), 1, height_ratios=heights, squeeze=False)[:, 0]
        for name, axes in zip(names, places, strict=True):
            if name == "errors":
                _errors(axes, rows, receivers, slots, error_floor(noise, pc.max(rows["trials"]).as_py()))
            elif recorded_trial is not None:
                (recorded_trial.lanes if name == "lanes" else recorded_trial.plane)(axes)
    return figure


def _errors(axes: Axes, rows: pa.Table, receivers: list[str], slots: range | None, floor: float) -> None:
    """The mean squared error of each slot, theory dashed, and a band of two standard errors of its logarithm.

    floor: values below it are drawn at it.
    """
    many, heights = False, list[Floats]()
    for i, name in enumerate(receivers):
        mine = rows.filter(pc.equal(rows["peer"], name))
        if slots is not None:
            mine = mine.filter(pc.is_in(mine["slot"], pa.array(slots, pa.int64())))
        columns = {column: mine[column].to_numpy() for column in mine.column_names if column != "peer"}
        ink = hexadecimal(colour(i))
        error, theory = columns["mean_squared_error"], columns["expected_trace_covariance"]
        if np.isnan(error).all():
            error = columns["mean_actual_trace_covariance"]
        heights += [error, theory]
        dot = "o" if len(error) == 1 else ""  # a line through one slot cannot be seen
        line = _LINES[i // len(RECEIVERS) % len(_LINES)]
        axes.plot(columns["slot"], np.maximum(error, floor), line, color=ink, label=name, linewidth=1.3, marker=dot)
        axes.plot(columns["slot"], np.maximum(theory, floor), "--", color=ink, linewidth=0.9)
        if (columns["trials"] > 1).any():
            many = True
            with np.errstate(all="ignore"):
                fraction = np.exp(
                    2.0 * columns["standard_error"] / error
                )  # symmetric on the logarithmic axis, and never below 0
            edges = (np.maximum(edge, floor) for edge in (error / fraction, error * fraction))
            axes.fill_between(columns["slot"], *edges, color=ink, alpha=0.25, linewidth=0)
    axis = ErrorAxis.of(heights, floor)
    if axis is not None:  # otherwise the axis has nothing to show, and no logarithms
        axes.set_yscale("log")
        axes.set_ylim(axis.low, axis.high)
    axes.set_xlabel("slot")
    title = "squared error" + (", mean ± 2 standard errors" if many else "") + "; dashed: theory"
    axes.set_title(f"{title}; {floor_words(floor)}" if axis is not None and axis.below else title)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


class _RecordedTrial:
    """One recorded trial in the slots that are shown."""

    def __init__(self, results: Results, receivers: list[str], trial: int | None, slots: range | None) -> None:
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
        self.rows = {name: rows.filter(pc.equal(rows["peer"], name)) for name in receivers}
        self.title = f"trial {trial}, slots {self.slots[0]} to {self.slots[-1]}"
        process = recorded(results.folder).scenario.process
        states = process.states or [f"x[{i}]" for i in range(len(process.A))]
        units = process.units or [""] * len(states)
        self.states = [f"{state} ({unit})" if unit else state for state, unit in zip(states, units, strict=True)]

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
            dot = _DOTS[i // len(RECEIVERS) % len(_DOTS)]
            manner: dict[str, Any] = (
                {"linewidth": 1.2} if i == 0 else {"marker": dot, "markersize": 4.0, "linewidth": 0.0}
            )
            axes.plot(*_path(rows, "x_hat"), color=hexadecimal(colour(i)), label=name, **manner)
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
