"""Reads from a recording which messages of a link were lost, and how long the others took.

Source: docs/links.md, recordings of messages.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

from evedrop.errors import TraceError, UsageError
from evedrop.model.process import Floats
from evedrop.scenario.recordings.message_numbers import MessageSeries

_SHORTEST_PART = 20


@final
@dataclass(frozen=True)
class MessageRecording:
    """The messages of a topic, or of a link of a wire."""

    name: str
    """The recording and the topic or link, for messages."""
    series: MessageSeries
    delays: Floats
    """Seconds, of each message that was delivered and whose delay is known, (d,)."""
    corrupt: float | None = None
    """The fraction of messages that were damaged among those that were not lost; None: nothing would show it."""
    notes: tuple[str, ...] = ()
    """What was left out or assumed, in sentences."""
    source: str = "robot"
    """The side from which the messages came."""
    target: str = "base"
    keys: str = "**"
    """The key expression of the messages in a wire file."""


def check_parts(name: str, series: MessageSeries, why: str) -> None:
    """Raise TraceError if the messages are cut into parts too short to learn anything about bursts; why: what cuts them."""
    count = len(series.outcomes)
    if count < _SHORTEST_PART * series.parts and series.parts > 1:
        raise TraceError(
            name,
            "file",
            f"its {count} outcomes are in {series.parts} parts, {count / series.parts:.3g} outcomes long on average: {why}; "
            f"expected parts of {_SHORTEST_PART} or more",
        )


def save_outcomes(recording: MessageRecording, path: Path) -> None:
    """Write the outcomes as a CSV file that the loss model `trace` can read. Raises UsageError if it cannot be written."""
    lines = ["received", *map(str, recording.series.outcomes.tolist())]
    try:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"--save {path} cannot be written ({error.strerror}); give another file") from error
