"""What the recorder shows of a run: a recording for the views, if anybody wants it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, final

from evedrop.live.network.launcher_pipe import emit
from evedrop.scenario.progress_events import RunEvent, ViewOpened
from evedrop.scenario.tables import Scenario
from evedrop.score.scorekeeper import Scored
from evedrop.score.slots import Slots
from evedrop.score.verdict import Verdict
from evedrop.show.view.scene_slots import ShownTrial, open_recording
from evedrop.system.world import world

if TYPE_CHECKING:
    from evedrop.show.view.recording import ViewRecording


@final
class RunView:
    """The recording of a run; without one, until it is opened, every method does nothing."""

    def __init__(self) -> None:
        self._recording: ViewRecording | None = None
        self._trial: ShownTrial | None = None
        self._noted = 0

    def open(self, scenario: Scenario, run: str, path: Path) -> None:
        """Begin the recording of the run with this name."""
        world().process.switch_threads_soon()  # the view's thread computes for tens of milliseconds at a time
        self._trial = ShownTrial(scenario, scenario.first_trial)
        self._recording = open_recording(scenario, run, path, lambda text: emit(ViewOpened(None, text)), live=True)

    def add_slots(self, slots: Slots, scored: Mapping[str, Scored]) -> None:
        """Show the next slots."""
        if self._recording is not None and self._trial is not None:
            self._recording.add(self._trial.scored(slots, scored))

    def note(self, events: Sequence[RunEvent]) -> None:
        """Note the events of the run that are new; events: all so far."""
        if self._recording is not None:
            for event in events[self._noted :]:
                self._recording.note(event.slot, "INFO", event.line)
        self._noted = len(events)

    def conclude(self, verdict: Verdict | None) -> None:
        """Show the verdict on the run."""
        if self._recording is not None:
            self._recording.conclude(verdict)

    def close(self) -> bool:
        """Complete the recording; returns whether this process can end as usual: False if a thread hangs."""
        return self._recording is None or self._recording.close()

    def remove_incomplete(self, path: Path) -> None:
        """Remove the recording, which is at this path now, if it failed. Raises OSError.

        `evedrop view` makes another one from the tables; it would show this one as that of the whole run.
        """
        if self.failure is not None:
            world().disk.remove(path, missing_ok=True)

    @property
    def failure(self) -> str | None:
        """Why there is no recording, or an incomplete one; None if it did not fail."""
        return None if self._recording is None else self._recording.failure
