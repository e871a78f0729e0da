"""What is recorded of a run: messages become slots, and these are scored, written and shown."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import final

from evedrop.errors import NoAnswer
from evedrop.live.protocol.brief import Brief, RecorderPart
from evedrop.live.protocol.codec import Reader
from evedrop.live.recorder.intake import Intake
from evedrop.live.recorder.progress import ProgressReporter
from evedrop.live.recorder.run_folder import RunFolder
from evedrop.live.recorder.run_score import RunScore
from evedrop.live.recorder.run_view import RunView
from evedrop.live.recorder.steering import Steering
from evedrop.scenario.tables import Scenario
from evedrop.score.scorekeeper import Scorekeeper


@final
class RecordedRun:
    """The parts of a run's record, from the messages to the results folder."""

    def __init__(self, brief: Brief[RecorderPart], scenario: Scenario) -> None:
        self._keeper = Scorekeeper(scenario, scenario.trials)
        self._intake = Intake(brief, scenario, self._keeper.run_tally)
        self.joiner = self._intake.joiner
        self.score = RunScore(scenario, self._keeper.run_tally, self.joiner)
        self.folder = RunFolder(Path(brief.part.results), self.score, brief.part.shard)
        self.view = RunView()
        self.progress = ProgressReporter()

    def start(self) -> None:
        """Note that the first slot begins."""
        self.score.start()
        self.progress.start()

    def amend(self, scenario: Scenario) -> None:
        """The operator has changed the scenario from the next slot on. Raises RunError if it cannot be written."""
        self.folder.amend(scenario)
        with suppress(NoAnswer):  # of a class that is asked again at the end, too, where that is reported
            self._keeper.amend(scenario)

    def take(self, source: str, message: Reader, steering: Steering) -> None:
        """Take a message of telemetry or of the journal.

        Raises MalformedMessage, Gap or Contradiction.
        """
        slots = self._intake.take(source, message, steering)
        if slots is None:
            return
        scored = self._keeper.add_slots(slots)
        self.folder.add_slots(slots, scored)
        self.view.add_slots(slots, scored)
        self.progress.report(self.joiner.done, scored)
