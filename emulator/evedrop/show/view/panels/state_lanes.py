"""Lanes below each other in Rerun, each of which shows a word at every time; only changes are recorded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from evedrop.show.view.lanes import Lane


@final
class StateLanes:
    """The lanes of one view."""

    def __init__(self, origin: str, lanes: Iterable[tuple[str, Lane]], first: int, *, labelled: bool = False) -> None:
        """origin: the path of the view; lanes: each with its name; first: the number of the first lane.

        labelled: whether a lane shows its words. Mostly a slot is too narrow for one, and a legend says what the colours mean.
        """
        given = list(lanes)
        self._lanes = [lane for _, lane in given]
        # The viewer sorts lanes by path, hence the numbers.
        digits = len(str(first + len(given) - 1))
        self.paths = [
            f"{origin}/{rr.escape_entity_path_part(f'{i:0{digits}d}_{name}')}"
            for i, (name, _) in enumerate(given, first)
        ]
        self._labelled = labelled
        self._last = [-1] * len(given)

    def styles(self) -> dict[str, rr.StateConfiguration]:
        """The words and colours of each lane."""
        return {
            path: rr.StateConfiguration(
                values=lane.words, labels=None if self._labelled else [" "] * len(lane.words), colors=lane.colours
            )
            for path, lane in zip(self.paths, self._lanes, strict=True)
        }

    def changes(
        self, codes: Iterable[NDArray[np.integer]]
    ) -> Iterator[tuple[str, NDArray[np.intp], rr.ComponentColumnList]]:
        """The path of each lane that changes in the next c steps, the steps, and the words; codes: of each lane, (c,)."""
        for i, (path, lane, steps) in enumerate(zip(self.paths, self._lanes, codes, strict=True)):
            at = np.flatnonzero(np.diff(steps.astype(np.int64), prepend=self._last[i]))
            self._last[i] = int(steps[-1])
            if len(at):
                yield path, at, rr.StateChange.columns(state=[lane.words[code] for code in steps[at].tolist()])
