"""The picture of a design: the errors of all receivers over μ_d, with the μ_d to choose."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evedrop.errors import UsageError
from evedrop.show.view.figure_style import GREY, drawing
from evedrop.show.view.palette import paper_inks

if TYPE_CHECKING:
    from evedrop.model.theory.design import Design
    from evedrop.show.view.shown_figure import ShownFigure

_SUFFIXES = (".pdf", ".png", ".svg")
_POINTS = 240
_DECADES = 6.0  # of errors above the least one; those of unbounded curves go on upwards


def draw_design(path: Path, design: Design) -> None:
    """Draw a design as the kind of picture that the name says.

    Raises UsageError for another kind, a design without admissible μ_d, and a file that cannot be written.
    """
    if path.suffix.lower() not in _SUFFIXES:
        raise UsageError(f"--plot {path}: expected a name that ends in {', '.join(_SUFFIXES[:-1])} or {_SUFFIXES[-1]}")
    if design.remark is not None:
        raise UsageError(f"--plot: there is nothing to draw: {design.remark}")
    try:
        design_figure(design).savefig(path, dpi=180)
    except OSError as error:
        raise UsageError(f"{path} cannot be written ({error.strerror}); give another file") from error


def design_figure(design: Design) -> ShownFigure:
    """The plot of a design as a figure; there must be an admissible μ_d."""
    low = design.bound
    mu_d = np.concatenate([low + np.geomspace(1e-4, 0.05, _POINTS // 2) * (1.0 - low), np.linspace(low, 1.0, _POINTS)])
    mu_d = np.unique(mu_d[mu_d > low])
    traces = [design.traces_at(float(each)) for each in mu_d]
    with drawing(6.4, 4.0) as figure:
        axes = figure.subplots()
        finite = [trace for at in traces for trace in at.values() if math.isfinite(trace) and trace > 0.0]
        inks = paper_inks(traces[0], {})
        for i, name in enumerate(traces[0]):
            curve = np.array([at[name] for at in traces])
            curve[~np.isfinite(curve)] = np.nan
            unbounded = ": unbounded" if np.isnan(curve).all() else ""
            axes.plot(mu_d, curve, color=inks[name], linewidth=2.2 if i == 0 else 1.4, label=f"{name}{unbounded}")
        if finite:
            axes.set_yscale("log")
            axes.set_ylim(0.7 * min(finite), min(1.5 * max(finite), min(finite) * 10**_DECADES))
        axes.set_xlim(math.floor(20.0 * low) / 20.0, 1.0)
        axes.axvspan(0.0, low, color="#eceef0", zorder=0)
        choice = design.choice or design.suggestion
        if choice is not None:
            axes.axvline(choice.mu_d, color=GREY, linewidth=1.2, linestyle="--", label=f"choose {choice.mu_d:.4g}")
        axes.set_xlabel("μ_d, the probability that a packet is the state (grey: not admissible)")
        axes.set_ylabel("trace of the error covariance in the limit")
        axes.legend()
    return figure
