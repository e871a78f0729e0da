"""Whether a run does what it has told its operators, and its scenario.toml is what it was.

Source: docs/control.md; docs/results.md.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evedrop.errors import EvedropError
from evedrop.scenario.loading import load
from evedrop.scenario.tables import Scenario
from evedrop.virtual.notes import PutMessage

_HELD = re.compile(r"before slot (\d+)")
_MADE_WITH = frozenset({"made_with", "modules"})
"""Entries that the folder adds."""


@dataclass
class Typed:
    """A command of an operator."""

    words: str
    begun: float
    """When it was typed, in virtual seconds."""
    answered: float = math.inf
    status: int | None = None
    said: str = ""

    @property
    def held(self) -> int | None:
        """The slot before which the run is held, as the command said; None if it said nothing of the kind."""
        match = _HELD.search(self.said)
        holds = self.status == 0 and self.words.split()[0] in {"pause", "step"}
        return int(match[1]) if holds and match is not None else None


def broken_holds(typed: Sequence[Typed], put: Sequence[PutMessage]) -> Iterator[str]:
    """Slots that a run sends although it is held, as far as no other command was under way; steps of another length."""
    before: Typed | None = None
    for command in sorted(typed, key=lambda each: each.begun):
        others = [other for other in typed if other is not command]
        alone = not any(other.begun <= command.answered and other.answered >= command.begun for other in others)
        if alone and command.held is not None:
            until = min((other.begun for other in others if other.begun > command.answered), default=math.inf)
            late = [
                message
                for message in put
                if message.key == "uplink" and command.answered <= message.at < until
                if message.slots and message.slots[-1] >= command.held
            ]
            if late:
                yield f"slot {late[0].slots[-1]} is sent, and {command.words} said: {command.said.strip()}"
            if command.words.startswith("step ") and before is not None and before.held is not None:
                wanted = before.held + int(command.words.split()[1])
                if command.held != wanted:
                    yield f"{command.words} from slot {before.held} said: {command.said.strip()}"
        before = command if alone else None


def wrong_scenario(folder: Path, scenario: Scenario, typed: Sequence[Typed]) -> Iterator[str]:
    """What scenario.toml says beside the scenario and the changes of operators; changes that they were told of, and it lacks."""
    try:
        there = load(folder)
    except EvedropError as error:
        yield f"scenario.toml cannot be read: {error}"
        return
    tables, wanted = ({**each.model_dump(mode="json", exclude_none=True)} for each in (there, scenario))
    events, of_file = tables.pop("event", []), wanted.pop("event", [])
    for name in sorted((tables.keys() | wanted.keys()) - _MADE_WITH):
        if tables.get(name) != wanted.get(name):
            yield f"scenario.toml has {name} = {tables.get(name)}, and the run {wanted.get(name)}"
    added = [_words_of(event) for event in events if event not in of_file]
    if len(events) - len(added) != len(of_file):
        yield f"scenario.toml lacks events of the scenario: {events}"
    changes = [command for command in typed if command.words.startswith("link ")]
    done = [command.words for command in changes if command.status == 0]
    if lacking := [words for words in done if words not in added]:
        yield f"scenario.toml lacks what operators were told to be done: {', '.join(lacking)}"
    if strange := [words for words in added if words not in {command.words for command in changes}]:
        yield f"scenario.toml has what nobody typed: {', '.join(strange)}"


def _words_of(event: Mapping[str, Any]) -> str:
    """The command that makes an event."""
    for kind in ("cut", "heal"):
        if kind in event:
            return f"link {event[kind]} {kind}"
    return f"link {event.get('link')} {' '.join(f'{name}={value}' for name, value in event.get('set', {}).items())}"
