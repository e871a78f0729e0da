"""The effects that an event can have on links, receivers and processes.

The code that carries them out does not know the kinds of event.

Source: docs/architecture.md, events.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from evedrop.model.links.link import Fate
from evedrop.names import ProcessAction


@dataclass(frozen=True)
class Nothing:
    """No effect but the event's line."""


@dataclass(frozen=True)
class LinkSettings:
    """A link has other settings from now on."""

    entries: Mapping[str, Any] | None
    """The changed entries of the link's table, in addition to earlier changes; None restores the link as it was at first."""


@dataclass(frozen=True)
class LinkCut:
    """Packets that are sent over a link are lost from now on."""

    reason = Fate.CUT


@dataclass(frozen=True)
class LinkHealed:
    """A link is no longer cut."""

    reason = Fate.CUT


@dataclass(frozen=True)
class Jamming:
    """Acknowledgements are attacked from now on, or no longer."""

    on: bool


@dataclass(frozen=True)
class Spoofing:
    """The sensor's measurements are attacked from now on, or no longer."""

    on: bool


@dataclass(frozen=True)
class Leave:
    """A receiver is away from now on."""

    reason: Fate
    """Why its packets are lost."""
    action: ProcessAction
    keeps_state: bool = False
    """Whether its belief continues from its last one while it is away, as for a paused process; otherwise from the prior."""


@dataclass(frozen=True)
class Return:
    """A receiver is back."""

    reason: Fate
    """The reason of the absence that ends."""
    action: ProcessAction
    after: str
    """The entry of the event that must have begun the absence."""
    keeps_state: bool = False
    """Whether it continues from its last belief; otherwise from the prior of the slot in which it went away."""


Effect = Nothing | LinkSettings | LinkCut | LinkHealed | Jamming | Spoofing | Leave | Return
