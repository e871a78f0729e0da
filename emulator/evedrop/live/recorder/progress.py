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

    def start(self) -> None:
        """Note that the first slot begins."""
        self._before = (world().monotonic(), 0)

    def rate(self, done: int) -> float:
        """Slots per second since the last report."""
        at, before = self._before
        return (done - before) / max(world().monotonic() - at, 1e-3)

    def report(self, done: int, scored: Mapping[str, Scored]) -> None:
        """Report that all slots below `done` are scored, if it is time to; scored: the last of them."""
        now = world().monotonic()
        if now - self._told < _SECONDS:
            return
        errors = {name: float(score.squared_error.mean()) for name, score in scored.items()}
        emit(RunProgress(done, self.rate(done), "slots/s", errors))
        self._told, self._before = now, (now, done)
