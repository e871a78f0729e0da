"""The effects that an event can have on links, receivers and processes. Code that carries them out knows no kinds of event.

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
    """Only a line in the journal."""


@dataclass(frozen=True)
class LinkSettings:
    """A link has other settings from now on."""

    entries: Mapping[str, Any] | None
    """The changed entries of the link's table, on top of earlier ones; None restores the link as it was at first."""


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
class Leave:
    """A receiver is away from now on."""

    reason: Fate
    """Why its packets are lost."""
    action: ProcessAction
    keeps_state: bool = False
    """Whether it follows the slots while it is away, as a process does that is stopped."""


@dataclass(frozen=True)
class Return:
    """A receiver is back."""

    reason: Fate
    """Of the absence that ends."""
    action: ProcessAction
    after: str
    """The entry of the event that must have begun the absence."""
    keeps_state: bool = False
    """False: it restarts from the prior of the slot in which it went away."""


Effect = Nothing | LinkSettings | LinkCut | LinkHealed | Jamming | Leave | Return
