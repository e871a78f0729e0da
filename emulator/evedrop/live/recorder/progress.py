"""How far a run has come and how fast, as the recorder tells the launcher and the operator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

from evedrop.live.network.launcher_pipe import emit
from evedrop.scenario.progress_events import RunProgress
from evedrop.score.scorekeeper import Scored
from evedrop.system.world import world

_SECONDS = 0.25


@final
class ProgressReporter:
    """Reports progress to the launcher four times a second."""

    def __init__(self) -> None:
        self._told = world().monotonic()
        self._before = (self._told, 0)
        self._rate = 0.0

    def start(self, done: int = 0) -> None:
        """Note that the next slot, `done`, begins only now: the run begins, or is held."""
        self._before = (world().monotonic(), done)

    def rate(self, done: int) -> float:
        """Slots per second as last reported, or fewer if the next report is late; all slots below `done` are joined."""
        at, before = self._before
        passed = world().monotonic() - at
        return self._rate if passed < _SECONDS else min(self._rate, (done - before + 1) / passed)

    def report(self, done: int, scored: Mapping[str, Scored]) -> None:
        """Report that all slots below `done` are scored, if it is time to; scored: the last of them."""
        now = world().monotonic()
        if now - self._told < _SECONDS:
            return
        errors = {name: float(score.squared_error.mean()) for name, score in scored.items()}
        at, before = self._before
        self._rate = (done - before) / max(now - at, 1e-3)
        emit(RunProgress(done, self._rate, "slots/s", errors))
        self._told, self._before = now, (now, done)
