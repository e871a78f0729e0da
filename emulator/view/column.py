"""Values of one entity over some slots, in Rerun's form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.view import paths


@dataclass(frozen=True)
class Column:
    """Values of one entity over some slots: the arguments of Rerun's `send_columns`."""

    path: str
    slots: NDArray[np.int64]
    values: rr.ComponentColumnList

    def send(self, to: rr.RecordingStream) -> None:
        """Add it to a recording."""
        to.send_columns(self.path, indexes=[rr.TimeColumn(paths.TIMELINE, sequence=self.slots)], columns=self.values)


def scalars(path: str, k: NDArray[np.int64], values: Floats) -> Column:
    """A number in each slot."""
    return Column(path, k, rr.Scalars.columns(scalars=values))
