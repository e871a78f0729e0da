"""A matplotlib figure that a notebook shows by itself, without a display and without pyplot."""

from __future__ import annotations

import warnings
from io import BytesIO
from typing import Any, final

import matplotlib as mpl
from matplotlib.figure import Figure

_DOTS_PER_INCH = 110
_STYLED = {"axes", "font", "mathtext", "pdf", "xtick", "ytick"}


@final
class ShownFigure(Figure):
    """A figure; `savefig` writes it to a file, in the style in which it was made."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """As of `Figure`."""
        super().__init__(*arguments, **options)
        # Read by name: reading the setting `backend` looks for a windowing toolkit.
        self._style = {name: mpl.rcParams[name] for name in mpl.rcParams if name.partition(".")[0] in _STYLED}

    def savefig(self, *arguments: Any, **options: Any) -> None:
        """Write the figure to a file, as `Figure` does: PDF, SVG or PNG by the ending of its name."""
        # Labels of ticks are made only now, and fonts looked up; a letter that they lack is a box.
        with mpl.rc_context(self._style), warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Glyph")
            super().savefig(*arguments, **options)

    def _repr_png_(self) -> bytes:
        written = BytesIO()
        self.savefig(written, format="png", dpi=_DOTS_PER_INCH)
        return written.getvalue()
