"""The kinds of event by their name in a scenario: one file each, and those of installed packages.

Source: docs/scenario.md, events; docs/your-own.md, an event.
"""

from __future__ import annotations

from collections.abc import Mapping

from evedrop.model.registry import Registry
from evedrop.scenario.events.cut import Cut, Heal
from evedrop.scenario.events.event import EventKind
from evedrop.scenario.events.jam import Jam
from evedrop.scenario.events.kill import Kill, Restart
from evedrop.scenario.events.note import Note
from evedrop.scenario.events.partition import Partition
from evedrop.scenario.events.pause import Pause, Resume
from evedrop.scenario.events.set import Set
from evedrop.scenario.events.spoof import Spoof

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
