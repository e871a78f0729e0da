"""The kinds of event by their name in a scenario: the built-in ones, and those of installed packages.

Source: docs/scenario.md, events; docs/your-own/event.md.
"""

from __future__ import annotations

from collections.abc import Mapping

from evedrop.model.registry import Registry
from evedrop.scenario.events.event import EventKind
from evedrop.scenario.events.kinds import (
    Cut,
    Heal,
    Jam,
    Kill,
    Note,
    Partition,
    Pause,
    Restart,
    Resume,
    Set,
    Spoof,
)

_BUILT_IN: Mapping[str, type[EventKind]] = {
    "set": Set,
    "cut": Cut,
    "partition": Partition,
    "kill": Kill,
    "pause": Pause,
    "jam": Jam,
    "spoof": Spoof,
    "heal": Heal,
    "restart": Restart,
    "resume": Resume,
    "note": Note,
}
EVENTS: Registry[EventKind] = Registry("event", EventKind, "evedrop.events", _BUILT_IN)  # type: ignore[type-abstract]
