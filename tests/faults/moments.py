"""When a fault strikes: somewhere in the start, in the run, or at its finish."""

from __future__ import annotations

import time
from dataclasses import dataclass

from tests.faults.disturbed import Disturbed

PHASES = ("start", "run", "finish")


@dataclass(frozen=True)
class Usual:
    """How long each phase of an undisturbed run takes here, in seconds."""

    start: float
    """From the command to the first slot."""
    run: float
    """To the last slot."""
    finish: float
    """To the launcher's end."""


@dataclass(frozen=True)
class Moment:
    """A fraction of a phase."""

    phase: str
    fraction: float

    def wait(self, run: Disturbed, usual: Usual) -> bool:
        """Wait for it; false if the run was over before."""
        while not run.over.is_set():
            at = self._at(run, usual)
            now = time.monotonic()
            if at is not None and now >= at:
                return True
            run.over.wait(0.02 if at is None else min(0.02, at - now))
        return False

    def _at(self, run: Disturbed, usual: Usual) -> float | None:
        """When it is, as far as it can be told by now."""
        if self.phase == "start":
            return run.begun + self.fraction * usual.start
        if self.phase == "run":
            return None if run.started is None else run.started + self.fraction * usual.run
        return None if run.finished is None else run.finished + self.fraction * usual.finish

    def __str__(self) -> str:
        return f"{self.phase} {self.fraction:.2f}"
