"""The rows of all tables, made from slots and digests of a run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

from evedrop.model.digest import DigestLog
from evedrop.results.writer import ResultsWriter
from evedrop.score.scorekeeper import Scored
from evedrop.score.slots import Slots


def write_rows(writer: ResultsWriter, slots: Slots, scored: Mapping[str, Scored], first_trial: int) -> None:
    """Write all rows of some slots."""
    for name, values in scored.items():
        writer.slot_rows(slots.first, name, values.sums, values.expected)
    writer.input_rows(slots, first_trial)
    writer.state_rows(slots)
    writer.trial_rows(slots, {name: values.squared_error for name, values in scored.items()}, first_trial)
    writer.journal_rows(slots)


@final
class DigestRows:
    """The digests of a run; their rows are written as blocks are reported."""

    def __init__(self, digests: Mapping[str, DigestLog], first_trial: int) -> None:
        """digests: receiver, or controller → block → digests of the trials from first_trial on; blocks are added later."""
        self._digests = digests
        self._first_trial = first_trial
        self._written = dict.fromkeys(digests, 0)

    def write(self, writer: ResultsWriter) -> None:
        """Write the blocks that were added since the last call."""
        for name, blocks in self._digests.items():
            if len(blocks) > self._written[name]:
                writer.digest_rows(self._first_trial, {name: blocks.after(self._written[name])})
                self._written[name] = len(blocks)
