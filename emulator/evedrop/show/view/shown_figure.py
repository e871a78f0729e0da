"""A matplotlib figure that a notebook shows by itself, without a display and without pyplot."""

from __future__ import annotations

from io import BytesIO
from typing import final

from matplotlib.figure import Figure

_DOTS_PER_INCH = 110


@final
class ShownFigure(Figure):
    """A figure; `savefig` writes it to a file."""

    def _repr_png_(self) -> bytes:
        written = BytesIO()
        self.savefig(written, format="png", dpi=_DOTS_PER_INCH)
        return written.getvalue()
