"""The results folder of a run that is being recorded: rows while it lasts, and the summary at its end.

Source: docs/results.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import final

from evedrop.errors import FolderTaken, NoAnswer, UnwrittenResults
from evedrop.live.recorder.run_end import RunEnd
from evedrop.live.recorder.run_score import RunScore
from evedrop.results.ending import note_end
from evedrop.results.folder import HeldFolder
from evedrop.results.resolved_scenario import write_resolved
from evedrop.results.shard_score import dump_score
from evedrop.results.summary_file import unwritten, write_summary
from evedrop.results.writer import DigestRows, ResultsWriter, write_rows
from evedrop.scenario.tables import Scenario
from evedrop.score.scorekeeper import Scored
from evedrop.score.slots import Slots
from evedrop.score.summary import Summary
from evedrop.score.verdict import Verdict
from evedrop.system.world import world


@final
class RunFolder:
    """Writes a results folder; rows go there inside the block of `open`."""

    def __init__(self, place: Path, score: RunScore, shard: bool) -> None:
        """shard: whether the run is one of several whose scores are merged."""
        self._place, self._score, self._shard = place, score, shard
        self._held: HeldFolder | None = None
        self._writer: ResultsWriter
        self._digest_rows = DigestRows(score.joiner.digests, score.scenario.first_trial)
        self._final: Summary | None = None
        self._begun = score.scenario  # whose classes have answered: the operator may change a link

    @property
    def now(self) -> Path:
        """Where it is, even if it was renamed. Raises FileNotFoundError if it was removed."""
        return self._place if self._held is None else self._held.now

    @contextmanager
    def open(self) -> Iterator[None]:
        """Write the scenario, and have a writer of rows during the block.

        Raises OSError if the folder does not exist, FolderTaken, with nothing written, if it has the rows of another run.
        """
        scenario = self._score.scenario
        self._held = HeldFolder(self._place)
        try:
            writer = ResultsWriter(self.now, scenario, self._dump_shard)
        except FileExistsError as error:
            raise FolderTaken(f"{self._place} is the results folder of another run; give another folder") from error
        with writer as self._writer:
            write_resolved(self.now, scenario)
            yield

    def amend(self, scenario: Scenario) -> None:
        """Replace the scenario with one that the operator has amended. Raises RunError if it cannot be written."""
        try:
            write_resolved(self.now, scenario)
            world().disk.sync(self.now / "scenario.toml")  # its new name, too: rows of the changed link follow
        except OSError as error:
            raise UnwrittenResults(unwritten(error)) from error
        self._score.scenario = scenario

    def add_slots(self, slots: Slots, scored: Mapping[str, Scored]) -> None:
        """Add the rows of some slots, and those of the digests that have come."""
        write_rows(self._writer, slots, scored, self._score.scenario.first_trial)
        self._digest_rows.write(self._writer)

    def save_rows(self) -> None:
        """Save all rows. Raises RunError if they cannot be written."""
        try:
            self._writer.write_rows(self._at)
        except OSError as error:
            raise UnwrittenResults(unwritten(error)) from error

    def save(self) -> None:
        """Save the results so far, from time to time. Raises RunError if they cannot be written."""
        try:
            self._writer.checkpoint(self._at, self._so_far, lambda: self._digest_rows.write(self._writer))
        except OSError as error:
            raise UnwrittenResults(unwritten(error)) from error

    @property
    def verdict(self) -> Verdict | None:
        """The verdict on the run, once it is settled."""
        return None if self._final is None else self._final.verdict

    def settle(self, end: RunEnd) -> None:
        """Compute the summary, and save it and all rows to disk. Raises OSError if they cannot be written."""
        self._digest_rows.write(self._writer)
        self._final = self._score.summary(self.now, end.how, end.accused)
        self._writer.settle(self._at, self._final)
        if self._score.scenario.process.source == "zenoh" and self._score.all_joined:
            write_resolved(self.now, self._score.scenario, taken=True)

    def complete(self, end: RunEnd) -> None:
        """Write the summary, and note what it says against the run, or why it cannot be written.

        If not all rows are on disk, or the metrics cannot be computed, the summary has the last metrics whose rows are.
        """
        try:
            if end.saved and self._final is None:
                with suppress(Exception):  # noted when the run was to be settled
                    self._final = self._score.summary(self.now, end.how, end.accused)
                self._dump_shard()
            if end.saved and self._final is not None:
                end.judge(self._final)
                write_summary(self.now, replace(self._final, ended=end.how))
            else:
                end.judge(note_end(self.now, self._begun, end.how))
        except OSError as error:
            end.fail(unwritten(error))

    @property
    def _at(self) -> str:
        """How far the run has come, in words."""
        return f"slot {self._score.joiner.done}"

    def _so_far(self) -> Summary | None:
        self._score.end()
        with suppress(NoAnswer):  # reported at the end
            return self._score.summary(self.now, "")
        return None

    def _dump_shard(self) -> None:
        if self._shard:
            dump_score(self._score.run_tally, self.now, self._score.scenario)
