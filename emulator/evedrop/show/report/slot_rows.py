"""The rows of a table by receiver, in the order of the slots, piece by piece: memory does not grow with the slots."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple, final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from evedrop.results.reading import Results


class RowExtent(NamedTuple):
    """The rows of a receiver: how many there are, and their first and last slot."""

    rows: int
    first: int
    last: int


@final
class SlotRows:
    """The rows of some receivers in a table of a run: a row for each slot, of one recorded trial if the table has trials."""

    def __init__(self, results: Results, table: str, receivers: Collection[str], trial: int | None = None) -> None:
        """Reads where the rows are. Raises UsageError if the table cannot be read, or lacks a column."""
        self._results, self._table, self._receivers, self._trial = results, table, receivers, trial
        self.extents: dict[str, RowExtent] = {}
        """Of the receivers that have rows."""
        self._in_order = True
        for name, rows in self._by_receiver(results.pieces(table, self._with_keys([]))):
            slots = rows["slot"].to_numpy()
            first, last, before = int(slots.min()), int(slots.max()), self.extents.get(name)
            self._in_order &= bool((np.diff(slots) > 0).all()) and (before is None or before.last < first)
            if before is not None:
                first, last = min(first, before.first), max(last, before.last)
            self.extents[name] = RowExtent(len(slots) + (0 if before is None else before.rows), first, last)

    def pieces(self, columns: Sequence[str]) -> Iterator[tuple[str, pa.Table]]:
        """Some columns, as pieces: the receiver, and its next rows. All rows at once if the slots of the table are not in order.

        Raises UsageError as the constructor does.
        """
        if self._in_order:
            yield from self._by_receiver(self._results.pieces(self._table, self._with_keys(columns)))
        else:  # somebody has written the table again
            where = None if self._trial is None else pc.field("trial") == self._trial
            whole = self._results.part(self._table, self._with_keys(columns), where).sort_by("slot")
            yield from self._by_receiver(iter([whole]))

    def _with_keys(self, columns: Sequence[str]) -> list[str]:
        keys = ["slot", "peer", *([] if self._trial is None else ["trial"])]
        return list(dict.fromkeys([*keys, *columns]))

    def _by_receiver(self, tables: Iterator[pa.Table]) -> Iterator[tuple[str, pa.Table]]:
        for table in tables:
            of_trial = table if self._trial is None else table.filter(pc.equal(table["trial"], self._trial))
            for name in self._receivers:
                rows = of_trial.filter(pc.equal(of_trial["peer"], name))
                if rows.num_rows:
                    yield name, rows
