"""Pictures as wide as a column of a journal: serif letters of 8 points, names beside the curves, and no titles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from evedrop.show.view.label_places import end_of, label_places

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH = 3.5
"""Inches: 89 mm, as of IEEE and Elsevier."""
_POINTS = 8.0
_LINE_OF_TEXT = 1.19  # its height over that of its letters
STYLE: Mapping[str, Any] = {
    "axes.labelsize": _POINTS,
    "axes.titlesize": _POINTS,
    "font.family": ["STIXGeneral", "DejaVu Serif"],
    "font.size": _POINTS,
    "legend.fontsize": 7.0,
    "lines.linewidth": 1.0,
    "mathtext.fontset": "stix",
    "xtick.labelsize": _POINTS,
    "ytick.labelsize": _POINTS,
}
"""What differs from other figures."""


def fit(axes: Axes, direct: bool, height: float) -> None:
    """Make axes fit a column: without a title, and with names beside the ends of the curves, or else a legend below.

    direct: whether the names stand beside the curves; height: of the axes, in inches, about.
    """
    axes.set_title("")
    legend = axes.get_legend()
    if direct:
        for line in axes.get_lines():
            line.set_linewidth(0.8)
        name_curves(axes, height)
    elif legend is not None:
        handles = [handle for handle in legend.legend_handles if handle is not None]
        texts = [text.get_text() for text in legend.get_texts()]
        axes.legend(
            handles, texts, loc="upper center", bbox_to_anchor=(0.5, -0.28 / height * 1.6), ncols=3, frameon=False,
            handlelength=1.2, columnspacing=0.8, handletextpad=0.4,
        )  # fmt: skip


def name_curves(axes: Axes, height: float) -> None:
    """Write the name of each curve to the right of its end, with a line to it in its colour; height: of the axes, in inches."""
    from matplotlib import rcParams  # noqa: PLC0415 - slow to import, and needed only for figures

    curves = [line for line in axes.get_lines() if not str(line.get_label()).startswith("_")]
    ends = [end_of(axes, np.asarray(line.get_ydata(), float)) for line in curves]
    gap = _LINE_OF_TEXT * rcParams["font.size"] / (72.0 * height)
    for line, end, place in zip(curves, ends, label_places(ends, gap), strict=True):
        leader = {"arrowstyle": "-", "color": line.get_color(), "linestyle": line.get_linestyle(), "relpos": (0.0, 0.5)}
        axes.annotate(
            str(line.get_label()), (1.0, end), (1.075, place), axes.transAxes, axes.transAxes, va="center", annotation_clip=False,
            arrowprops=leader | {"shrinkA": 3.0, "shrinkB": 0.0},
        )  # fmt: skip
