"""Lanes below each other, each of which shows a word in every slot; only changes are recorded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from evedrop.show.view.column import Column


@final
class StateLanes:
    """The lanes of one view. A lane's codes are the indices of its words."""

    def __init__(self, origin: str, lanes: Iterable[tuple[str, Sequence[str]]], first: int) -> None:
        """origin: the path of the view; lanes: name and words of each; first: the number of the first lane."""
        names, self._words = zip(*lanes, strict=True)
        # The viewer sorts lanes by path, hence the numbers.
        digits = len(str(first + len(names) - 1))
        self.paths = [f"{origin}/{i:0{digits}d}_{name}" for i, name in enumerate(names, first)]
        self._last = [-1] * len(names)

    def columns(self, slots: NDArray[np.int64], codes: Iterable[NDArray[np.integer]]) -> Iterator[Column]:
        """The changes in the next slots, (c,), given the codes of each lane, (c,)."""
        for i, (path, words, lane) in enumerate(zip(self.paths, self._words, codes, strict=True)):
            at = np.flatnonzero(np.diff(lane.astype(np.int64), prepend=self._last[i]))
            self._last[i] = int(lane[-1])
            if len(at):
                states = [words[code] for code in lane[at].tolist()]
                yield Column(path, slots[at], rr.StateChange.columns(state=states))
