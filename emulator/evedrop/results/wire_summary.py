"""The files of a wire's folder that other packages look for, and the contents of its summary.json as typed classes.

`WireSummary` has a class for each kind of entry in it; the fields of a class are the entry's keys, in their order. Imports
neither Zenoh nor Rerun.

Source: docs/wire/results.md, the summary.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from evedrop.errors import UsageError
from evedrop.results.summary_file import plain
from evedrop.score.summary import Judged, failed
from evedrop.system.files import Unreadable, text_of

if TYPE_CHECKING:
    from pydantic import TypeAdapter


WIRE_FILE = "wire.toml"
"""The complete wire file in a wire's folder."""


def is_wire(folder: Path) -> bool:
    """Whether a results folder is that of a wire."""
    return (folder / WIRE_FILE).is_file()


WIRE_SUMMARY_FILE = "summary.json"
"""The summary in a wire's folder, written when the wire ends."""
JournalState = Literal["running", "ended", "killed"]
"""What became of the start of a wire to which a journal belongs."""
_MOST_BYTES = 2**28


@dataclass(frozen=True)
class WireLinkSummary:
    """What became of the messages of a link."""

    source: str
    target: str
    keys: str
    heard: int
    bytes: int
    delivered: int
    again: int
    """How many messages were delivered twice."""
    lost_by: Mapping[str, int]
    """Reason → messages that the link's settings stopped."""
    dropped_by: Mapping[str, int]
    """Reason → messages that the wire itself or Zenoh stopped."""
    rate: float | None
    """The fraction that the link's models let through, of the messages on which they decided; None if there were none."""
    expected_rate: float | None
    bounds: tuple[float, float] | None
    """Between which this fraction is in 99 % of all wires with these models."""
    within_bounds: bool | None
    delays: Mapping[str, float]
    """Quantile → seconds for which delivered messages were held back."""
    gap_messages: int
    """The most messages of one key in a row that were not delivered."""
    gap_seconds: float
    """The longest time from a delivered message of a key to its next one, if messages between them were not delivered."""

    def __post_init__(self) -> None:
        """Raise ValueError unless the rate and what the models say about it are all there, or none of them is."""
        if len({value is None for value in (self.rate, self.expected_rate, self.bounds, self.within_bounds)}) > 1:
            raise ValueError("rate, expected_rate, bounds and within_bounds must be given together, or all be null")


@dataclass(frozen=True)
class JournalSummary:
    """What became of the journal of a wire."""

    recovered: int
    """The number of records that an earlier, killed start had left behind."""
    missing: int
    """The number of records that a full disk kept out."""
    incomplete_since: float | None
    """When the disk first was full; None: it never was."""


@dataclass(frozen=True)
class WireEventSummary:
    """A cut, a partition, a change or a note, of the file or of an operator; or a way past the wire."""

    seconds: float
    """Since this start of the wire."""
    event: str
    bypass: bool = False
    """Whether it is a way past the wire, by which messages may have crossed that the journal does not have."""


@dataclass(frozen=True)
class WireSummary:
    """The summary of a start of a wire."""

    seed: int
    start: int
    """The number of the start in its folder, from 1."""
    state: JournalState
    seconds: float
    """How long this start has lasted."""
    heard: int
    """The records of the journal: a message counts once for each link that took it."""
    unlinked: int
    """The messages that no link took."""
    unaccounted: int
    """Records that are not in exactly one fate of one link: 0, or the wire has a fault."""
    journal: JournalSummary
    links: Mapping[str, WireLinkSummary]
    expectations: Sequence[Judged]
    events: Sequence[WireEventSummary]
    made_with: Mapping[str, str]
    """Program → its version."""

    @property
    def failed_expectations(self) -> int:
        """The number of expectations that failed."""
        return len(failed(self.expectations))

    @property
    def bypasses(self) -> list[WireEventSummary]:
        """The ways past the wire that it noticed: with any, the wire has no verdict."""
        return [event for event in self.events if event.bypass]

    def as_dict(self) -> dict[str, Any]:
        """The contents of summary.json."""
        entries: dict[str, Any] = plain(
            {**asdict(self), "expectations": [expectation.as_dict() for expectation in self.expectations]}
        )
        return entries

    @property
    def text(self) -> str:
        """The text of summary.json."""
        return json.dumps(self.as_dict(), indent=1, ensure_ascii=False) + "\n"

    @classmethod
    def read(cls, path: Path) -> WireSummary:
        """The summary in a file. Raises UsageError if it is not the summary of a wire of this version."""
        try:
            entries = json.loads(text_of(path, _MOST_BYTES))
        except (OSError, Unreadable, ValueError, RecursionError) as error:
            why = (error.strerror if isinstance(error, OSError) else None) or error
            raise UsageError(f"{path} is not the summary of a wire ({why})") from error
        if not isinstance(entries, dict):
            raise _foreign(path, "it has no entries")
        from pydantic import ValidationError  # noqa: PLC0415 - as below

        try:
            # The summaries of an older version, all of wires that ended, lack the state.
            return _adapter().validate_python({"state": "ended", **entries})
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            raise _foreign(path, f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error


def _foreign(path: Path, why: str) -> UsageError:
    return UsageError(f"{path} is not the summary of a wire of this version ({why})")


@cache
def _adapter() -> TypeAdapter[WireSummary]:
    from pydantic import TypeAdapter  # noqa: PLC0415 - as slow to build as to import, and only readers need it

    return TypeAdapter(WireSummary)
