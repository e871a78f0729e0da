"""Long rows of numbers in a few groups of neighbours, taken piece by piece: memory does not grow with their length."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.model.receiver import Codes


class _Groups:
    """Divides `count` places into at most `most` groups of neighbours, as equal as possible."""

    def __init__(self, count: int, most: int) -> None:
        self.groups = min(count, most)
        self.taken = 0
        """How many places have been taken, from the first one on."""
        self._edges = np.linspace(0, count, self.groups + 1).astype(np.int64)

    def _next(self, count: int) -> NDArray[np.int64]:
        """The groups of the next places, (count,)."""
        places = np.arange(self.taken, self.taken + count)
        self.taken += count
        return np.asarray(np.searchsorted(self._edges, places, side="right") - 1, np.int64)


@final
class GroupMeans(_Groups):
    """The mean of each group of some functions of the place; not a number where one of its values is not."""

    def __init__(self, count: int, most: int, functions: int) -> None:
        super().__init__(count, most)
        self._sums = np.zeros((functions, self.groups))

    def add(self, values: Floats) -> None:
        """The values at the next c places, (functions, c)."""
        groups = self._next(values.shape[1])
        with np.errstate(over="ignore", invalid="ignore"):
            self._sums += np.stack([np.bincount(groups, row, self.groups) for row in values])

    @property
    def means(self) -> Floats:
        """(functions, groups)."""
        return np.asarray(self._sums / np.diff(self._edges), np.float64)


@final
class GroupCounts(_Groups):
    """How often each code occurs in each group."""

    def __init__(self, count: int, most: int, kinds: int) -> None:
        """kinds: codes are 0 to kinds − 1."""
        super().__init__(count, most)
        self._counts = np.zeros((self.groups, kinds), np.int64)

    def add(self, codes: Codes) -> None:
        """The codes at the next places, (c,)."""
        kinds = self._counts.shape[1]
        cells = self._next(len(codes)) * kinds + codes
        self._counts += np.bincount(cells, minlength=self._counts.size).reshape(self._counts.shape)

    @property
    def fractions(self) -> list[float]:
        """The fraction of each code among all codes so far; there must be at least one."""
        return [int(total) / self.taken for total in self._counts.sum(0)]

    @property
    def commonest(self) -> Codes:
        """The most frequent code of each group, the lowest of several, (groups,)."""
        codes: Codes = np.argmax(self._counts, axis=1).astype(np.uint8)
        return codes

    @property
    def highest(self) -> Codes:
        """The highest code of each group, (groups,)."""
        kinds = self._counts.shape[1]
        codes: Codes = (kinds - 1 - np.argmax(self._counts[:, ::-1] > 0, axis=1)).astype(np.uint8)
        return codes
