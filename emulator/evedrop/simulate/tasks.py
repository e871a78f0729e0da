"""Tasks: parts of a study that any worker can carry out, here or on a cluster."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

OnProgress = Callable[[int], None]
"""Takes the number of trial-slots done since the last call."""
Stopped = Callable[[], bool]
"""Whether the study was told to stop."""


class Result(Protocol):
    """The result of a task."""

    @property
    def complete(self) -> bool:
        """Whether the task was carried out to its end, and not stopped before."""


R = TypeVar("R", bound=Result)


@dataclass(frozen=True)
class Task(ABC, Generic[R]):
    """Some consecutive trials of a scenario."""

    scenario: dict[str, Any]
    """The scenario, from `Scenario.model_dump`."""
    start: int
    stop: int

    @property
    def work(self) -> int:
        """The trial-slots of the task."""
        return (self.stop - self.start) * int(self.scenario["slots"])

    @abstractmethod
    def carry_out(self, on_progress: OnProgress, stopped: Stopped) -> R:
        """Simulate the trials. The simulation ends early once `stopped`; the result is then not complete."""

    @abstractmethod
    def example(self) -> R:
        """A result with an instance of every class that a result may have: kept results are read like it."""
