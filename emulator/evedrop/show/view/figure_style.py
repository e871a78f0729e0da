"""The style of all pictures drawn with matplotlib, and how they are saved: as PNG and PDF."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evedrop.show.view.palette import FIGURES, hexadecimal

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from evedrop.show.view.shown_figure import ShownFigure

SLATE, OCHRE, GREY = map(hexadecimal, FIGURES)
"""The colours of `FIGURES`, as matplotlib writes them: for curves that do not belong to a receiver."""

_STYLE: Any = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.labelsize": 10,
    "axes.linewidth": 0.7,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10.5,
    "font.size": 9.5,
    "grid.color": "#e3e5e8",
    "grid.linewidth": 0.6,
    "legend.fontsize": 9,
    "legend.framealpha": 0.92,
    "legend.edgecolor": "#d0d3d6",
    "lines.linewidth": 1.7,
    "mathtext.fontset": "dejavusans",
    "pdf.fonttype": 42,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
}


@contextmanager
def drawing(width: float, height: float, style: Any = None) -> Iterator[ShownFigure]:
    """A figure to draw on, in inches; style: what differs from other figures, as a mapping of matplotlib's settings.

    Needs no display, and leaves no global state changed.
    """
    import matplotlib as mpl  # noqa: PLC0415 - slow to import, and needed only for figures

    from evedrop.show.view.shown_figure import ShownFigure  # noqa: PLC0415 - as above

    with mpl.rc_context(_STYLE | (style or {})):
        yield ShownFigure(figsize=(width, height), layout="constrained")


@contextmanager
def panels(path: Path, columns: int, width: float, height: float) -> Iterator[list[Axes]]:
    """Axes to draw on, side by side; width and height in inches. Saved as `path`.png and `path`.pdf at the end.

    Uses no windowing toolkit, and leaves no global state changed.
    """
    with drawing(width, height) as figure:
        yield list(figure.subplots(1, columns, squeeze=False)[0])
        save(path, figure)


def save(path: Path, figure: ShownFigure, shows: Mapping[str, str] | None = None) -> None:
    """Save a figure as `path`.png and `path`.pdf.

    shows: what the picture shows, by keyword; the PNG file keeps it as text, which any reader of PNG metadata can read.
    """
    figure.savefig(path.with_suffix(".png"), dpi=180, metadata=dict(shows or {}))
    figure.savefig(path.with_suffix(".pdf"), metadata={"CreationDate": None})
