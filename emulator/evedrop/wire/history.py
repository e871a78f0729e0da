"""The history of a wire's folder: its starts, the settings of its links and their changes, and how many messages it numbered.

A wire that starts again in the same folder continues from here, so that the n-th message of a key has the same fate whether or
not the wire was ended or killed between.

Source: docs/wire/results.md, a wire that starts again.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, final

from evedrop.errors import UsageError
from evedrop.model.checks import probability_mistakes
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.links import LOSS_MODELS
from evedrop.model.slot.link import NEVER, Change
from evedrop.results.wire_summary import JournalSummary
from evedrop.scenario.table import model_mistakes
from evedrop.system.files import LineFile, lines_in
from evedrop.system.world import world
from evedrop.wire.plan import WirePlan, numbered_as

Numbered = tuple[str, str, str]
"""Link, key as in `numbered_as`, and kind: the messages that share these are numbered from 0."""
_FILE = "history.jsonl"
_COMPLETE = JournalSummary(0, 0, None)


class NotedEvent(NamedTuple):
    """An event of a wire."""

    time: float
    """In seconds: since 1970 in `WireHistory.noted`, since the start in `WireHistory.events`."""
    line: str
    bypass: bool = False
    """Whether it tells a way past the wire."""


@dataclass(frozen=True)
class _Settings:
    """Settings of a link, and from which message of each stream on they were in force: from the first on if not stated."""

    settings: Mapping[str, Any]
    since: Mapping[tuple[str, str], int]


@final
@dataclass
class WireHistory:
    """What was written so far in the file `history.jsonl` of a journal's folder, and its continuation.

    Threads may call its methods at the same time.
    """

    folder: Path
    start: int = 0
    """The number of the latest start, from 1."""
    ended: bool = True
    """Whether the latest start ended, and was not killed."""
    counts: dict[Numbered, int] = field(default_factory=dict)
    """How many messages each stream had numbered at the end of the latest start that ended."""
    links: dict[int, list[str]] = field(default_factory=dict)
    """Start → the names of its links, in the order of their codes."""
    began: float = 0.0
    """When the latest start began, in seconds since 1970."""
    over: float = 0.0
    """When the latest start ended, in seconds since 1970; 0 if it has not."""
    completeness: JournalSummary = _COMPLETE
    """What the latest start found of an earlier one, and, if it ended, what it could not write."""
    noted: list[NotedEvent] = field(default_factory=list)
    """The events since the latest start."""
    _seed: int | None = None
    _settings: dict[str, list[_Settings]] = field(default_factory=dict)
    _of_new_keys: dict[str, tuple[Change, ...]] = field(default_factory=dict)
    """Link → the changes of all streams that had no message at any of them."""
    _unsynced: bool = False
    _lock: AbstractContextManager[bool] = field(default_factory=lambda: world().lock(), repr=False, compare=False)

    @classmethod
    def read(cls, folder: Path) -> WireHistory:
        """Read the history of a journal's folder; an empty one if there is none. Raises UsageError if it is damaged."""
        history = cls(folder)
        path = folder / _FILE
        try:
            lines = lines_in(path)
        except FileNotFoundError:
            return history
        except OSError as error:
            raise UsageError(f"{path} cannot be read ({error.strerror}); give another folder") from error
        for at, line in enumerate(lines, start=1):
            if b"\0" in line:  # a power cut left a page without its contents
                continue
            try:
                history._take(json.loads(line))
            except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
                raise UsageError(f"{path}, line {at}, is not the history of a wire; give another folder") from error
        return history

    @property
    def events(self) -> list[NotedEvent]:
        """The events since the latest start, with seconds since it began."""
        with self._lock:
            return [event._replace(time=round(event.time - self.began, 3)) for event in self.noted]

    def begin(self, plan: WirePlan, now: float, recovered: int = 0) -> None:
        """Begin the next start, which has the seed of the earlier ones. Raises OSError if the disk is full.

        recovered: the number of records that an earlier start left behind.
        """
        links = {link.name: dict(link.settings) for link in plan.links}
        start = {"start": self.start + 1, "time": now, "seed": plan.seed, "links": links}
        self._write({**start, "recovered": recovered})

    def change(self, link: str, settings: Mapping[str, Any], since: Mapping[tuple[str, str], int], now: float) -> None:
        """Note other settings of a link. since: (key, kind of stream) → the first number that has them. Raises OSError."""
        rows = [[*stream, n] for stream, n in since.items()]
        self._write({"change": link, "time": now, "settings": dict(settings), "since": rows})
        self._unsynced = True

    def sync(self) -> None:
        """Have the changes so far on the disk, also after a power cut: later records depend on them. Raises OSError."""
        if self._unsynced:
            self._unsynced = False
            world().disk.sync(self.folder / _FILE)

    def note(self, line: str, now: float, bypass: bool = False) -> None:
        """Note an event. Raises OSError."""
        self._write({"event": line, "time": now, **({"bypass": True} if bypass else {})})

    def end(self, counts: Mapping[Numbered, int], now: float, completeness: JournalSummary = _COMPLETE) -> None:
        """End the latest start. completeness: what could not be written. Raises OSError."""
        self._write(
            {
                "end": self.start,
                "time": now,
                "counts": [[*numbered, n] for numbered, n in counts.items()],
                "missing": completeness.missing,
                "incomplete_since": completeness.incomplete_since,
            }
        )

    def changes_of(self, link: str, key: str, kind: str) -> tuple[Change, ...]:
        """The settings of a stream's messages: the first from message 0 on, then the changes. For `PerKeyLinks`."""
        stream, versions = (numbered_as(key), kind), self._settings.get(link, [])
        if any(stream in version.since for version in versions):
            return _changes((version.since.get(stream, 0), version.settings) for version in versions)
        if link not in self._of_new_keys:
            self._of_new_keys[link] = _changes((0, version.settings) for version in versions)
        return self._of_new_keys[link]

    def expect_settings(self) -> None:
        """Raise UsageError unless each link had settings from which fates, and their distribution, can be computed."""
        for link, changes in self._settings.items():
            for change in changes:
                mistakes = [
                    (f"{entry}.{name}", reason)
                    for entry, models in (("loss", LOSS_MODELS), ("delay", DELAY_MODELS))
                    if change.settings.get(entry) is not None
                    for name, reason in model_mistakes(change.settings[entry], models)
                ]
                mistakes += probability_mistakes(change.settings, "corrupt", "duplicate", "reorder")
                for name, reason in mistakes:
                    raise UsageError(f"{self.folder / _FILE} has settings of the link {link} in which {name} {reason}")

    def expect_seed(self, plan: WirePlan) -> None:
        """Raise UsageError if an earlier start had another seed."""
        if self._seed not in {None, plan.seed}:
            raise UsageError(
                f"the wire of {self.folder.parent} had the seed {self._seed}, and this one has {plan.seed}: its fates would not "
                "go on; give the same seed, or another folder"
            )

    def _write(self, entry: Mapping[str, Any]) -> None:
        lasting = "start" in entry or "end" in entry  # records after a start are nothing without it
        with self._lock:
            path = self.folder / _FILE
            if not lasting:  # it is in force, even if it cannot be written
                self._take(json.loads(json.dumps(entry)))
            with LineFile(path) as file:
                line = file.append(entry)
            if lasting:
                self._take(json.loads(line))
                world().disk.sync(path)

    def _take(self, entry: Mapping[str, Any]) -> None:
        if "start" in entry:
            self.start, self.ended, self._seed = _number(entry["start"]), False, int(entry["seed"])
            self.began, self.over, self.noted = float(entry["time"]), 0.0, []
            self.completeness = JournalSummary(_number(entry.get("recovered", 0)), 0, None)
            self.links[self.start] = list(entry["links"])
            for name, settings in entry["links"].items():
                self._add(name, settings, {})
        elif "change" in entry:
            self._add(
                entry["change"], entry["settings"], {(str(k), str(kind)): _number(n) for k, kind, n in entry["since"]}
            )
        elif "event" in entry:
            self.noted.append(NotedEvent(float(entry["time"]), str(entry["event"]), bool(entry.get("bypass"))))
        elif int(entry["end"]) == self.start:
            self.ended, self.over = True, float(entry["time"])
            since = entry.get("incomplete_since")
            self.completeness = replace(
                self.completeness,
                missing=_number(entry.get("missing", 0)),
                incomplete_since=None if since is None else float(since),
            )
            self.counts = {(str(link), str(key), str(kind)): _number(n) for link, key, kind, n in entry["counts"]}

    def _add(self, link: str, settings: Mapping[str, Any], since: Mapping[tuple[str, str], int]) -> None:
        """Settings come into force; those of a start, at the present counts of all streams."""
        str(settings["loss"]["model"])  # raises an error unless they are settings
        earlier = self._settings.setdefault(link, [])
        counted = {(key, kind): n for (name, key, kind), n in self.counts.items() if name == link}
        if not earlier or earlier[-1].settings != settings:
            earlier.append(_Settings(settings, {**counted, **since}))
            self._of_new_keys.pop(link, None)


def _changes(settings: Iterable[tuple[int, Mapping[str, Any]]]) -> tuple[Change, ...]:
    """Settings as changes, from the numbers of the first messages that had them; of several at one message the last counts."""
    last = dict(settings)
    return tuple(Change(at, last[at]) for at in sorted(last))


def _number(text: Any) -> int:
    """A number of a start or a message. Raises ValueError or TypeError."""
    number = int(text)
    if not 0 <= number < NEVER:
        raise ValueError(number)
    return number


def highest(counts: dict[Numbered, int], stream: Numbered, n: int) -> None:
    """Raise the count of the stream of a link, key and kind to n, in place."""
    link, key, kind = stream
    numbered = (link, numbered_as(key), kind)
    counts[numbered] = max(counts.get(numbered, 0), n)
