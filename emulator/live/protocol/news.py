"""The observer's news to its launcher: JSON objects, each with `event` and the entries of that kind.

The kinds that have no class here have no entries, or are only shown to the user.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Self

from evedrop.names import ProcessAction

News = Mapping[str, Any]


@dataclass(frozen=True)
class _Kind:
    event: ClassVar[str]

    @classmethod
    def of(cls, news: News) -> Self:
        """Read news of this kind."""
        return cls(**{name: value for name, value in news.items() if name != "event"})

    @property
    def news(self) -> dict[str, Any]:
        """The news as the launcher gets them."""
        return {"event": self.event, **asdict(self)}


@dataclass(frozen=True)
class ProcessRequest(_Kind):
    """The observer asks the launcher to act on a process, and to confirm it."""

    event = "act"
    do: ProcessAction
    process: str
    first: int
    """The first slot that a restarted process handles."""
    number: int
    """By which the launcher confirms it."""


@dataclass(frozen=True)
class RunProgress(_Kind):
    """How far a run has come."""

    event = "progress"
    done: int
    """Slots."""
    rate: float
    rate_unit: str
    squared_errors: Mapping[str, float]
    """Estimator → its mean over the trials, in the last slots."""


@dataclass(frozen=True)
class RunEnded(_Kind):
    """The end of a run, as the observer sees it."""

    event = "ended"
    status: int
    """Its exit status."""
    how: str
    """`complete`, `interrupted`, or the reason of a failure."""
    suspects: Sequence[str] = ()
    """Processes that were missing."""
    accused: Sequence[str] = ()
    """Processes whose misbehaviour ended the run."""
    view: str | None = None
    """Why the view stopped early, if it did."""

    @property
    def well(self) -> bool:
        """Whether the run came to its end, whatever its expectations."""
        return self.status in {0, 1}
