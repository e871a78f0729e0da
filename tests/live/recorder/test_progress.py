"""How fast a run is, as the recorder tells it."""

from __future__ import annotations

import pytest

from evedrop.live.recorder import progress
from evedrop.live.recorder.progress import ProgressReporter
from evedrop.scenario.progress_events import RunProgress


class Clock:
    """A clock that a test sets."""

    now = 100.0

    def monotonic(self) -> float:
        """The time."""
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock of the module."""
    clock = Clock()
    monkeypatch.setattr(progress, "world", lambda: clock)
    return clock


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[RunProgress]:
    """What the launcher is told."""
    told: list[RunProgress] = []
    monkeypatch.setattr(progress, "emit", told.append)
    return told


def test_the_rate_between_two_reports_is_that_of_the_last_one(clock: Clock, told: list[RunProgress]) -> None:
    """Whenever somebody asks; a run that stands still becomes slower and slower."""
    reporter = ProgressReporter()
    reporter.start()
    clock.now += 0.5
    reporter.report(50, {})
    assert [event.rate for event in told] == [100.0]
    for passed, rate in ((0.0, 100.0), (0.125, 100.0), (0.375, 2.0), (7.5, 0.125)):
        clock.now += passed
        assert reporter.rate(50) == rate
    assert reporter.rate(51) == 0.25


def test_a_hold_does_not_count(clock: Clock, told: list[RunProgress]) -> None:
    """The first report after it has the rate since."""
    reporter = ProgressReporter()
    reporter.start()
    clock.now += 60.0
    reporter.start(10)
    clock.now += 0.5
    reporter.report(60, {})
    assert [event.rate for event in told] == [100.0]
