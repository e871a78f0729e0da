"""The effects that an event can have on links, receivers and processes.

The code that carries them out knows neither the kinds of event nor those of effect: it asks an effect what it does.

Source: docs/architecture.md, events.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from evedrop.model.links.loss_model import Fate
from evedrop.names import ProcessAction


class Effect:
    """The base class of effects, with the values of an effect that changes nothing."""

    needs_receivers: ClassVar[bool] = True
    """Whether its act must name at least one receiver."""
    one_receiver: ClassVar[bool] = False
    """Whether its act must name exactly one."""
    changes_settings: ClassVar[bool] = False
    """Whether it changes the settings of links; see `entries`."""
    cuts: ClassVar[bool | None] = None
    """Whether links are cut from now on (true) or no longer (false); None if it leaves that as it is."""
    present: ClassVar[bool | None] = None
    """Whether a receiver is back from now on (true) or away (false); None if it leaves that as it is."""
    attacked: ClassVar[str | None] = None
    """What an attack that it begins or ends is on."""
    on: bool = False
    """Whether it begins that attack; otherwise it ends it."""
    entries: Mapping[str, Any] | None = None
    """The changed entries of a link's table, in addition to earlier changes; None restores the link as it was at first."""
    reason: Fate = Fate.LOST
    """The fate of packets during the cut or absence that it begins or ends."""
    action: ProcessAction | None = None
    """What the launcher does to the receiver's process; None for nothing."""
    keeps_state: bool = False
    """Whether the receiver continues from its last belief; otherwise from the prior."""
    after: str = ""
    """The entry of the event that must have begun the absence that it ends."""

    @property
    def loses(self) -> bool | None:
        """Whether packets are lost for its `reason` from now on (true) or no longer (false); None if it leaves that as it is."""
        return self.cuts if self.present is None else not self.present


@dataclass(frozen=True)
class Nothing(Effect):
    """No effect but the event's line."""

    needs_receivers = False


@dataclass(frozen=True)
class LinkSettings(Effect):
    """A link has other settings from now on."""

    entries: Mapping[str, Any] | None = field()

    changes_settings = True


@dataclass(frozen=True)
class LinkCut(Effect):
    """Packets that are sent over a link are lost from now on."""

    cuts = True
    reason = Fate.CUT


@dataclass(frozen=True)
class LinkHealed(Effect):
    """A link is no longer cut."""

    cuts = False
    reason = Fate.CUT


@dataclass(frozen=True)
class Jamming(Effect):
    """Acknowledgements are attacked from now on, or no longer."""

    on: bool = field()

    needs_receivers = False
    attacked: ClassVar[str] = "acknowledgements"


@dataclass(frozen=True)
class Spoofing(Effect):
    """The sensor's measurements are attacked from now on, or no longer."""

    on: bool = field()

    needs_receivers = False
    attacked: ClassVar[str] = "measurements"


@dataclass(frozen=True)
class Leave(Effect):
    """A receiver is away from now on."""

    reason: Fate = field()
    action: ProcessAction = field()
    keeps_state: bool = False
    """Whether its belief continues from its last one while it is away, as for a paused process; otherwise from the prior."""

    one_receiver = True
    present = False


@dataclass(frozen=True)
class Return(Effect):
    """A receiver is back."""

    reason: Fate = field()
    action: ProcessAction = field()
    after: str = field()
    keeps_state: bool = False
    """Whether it continues from its last belief; otherwise from the prior of the slot in which it went away."""

    one_receiver = True
    present = True
