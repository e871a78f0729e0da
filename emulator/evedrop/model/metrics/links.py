"""The account of a link's packets, whose entries are the link metrics that expectations can name."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Self

from evedrop.model.metrics.metric import ReceiverTally


@dataclass(frozen=True)
class LinkAccount:
    """The packets of one link: every packet offered is delivered, or lost for a reason."""

    offered: int
    """Packets that the sensor sent."""
    delivered: int
    """Packets that the receiver counted itself, late ones included."""
    late: int
    lost: int
    """Packets lost according to the router's journal."""
    unexplained: int
    """Packets for which the journal and another process disagree."""

    @classmethod
    def of(cls, tally: ReceiverTally) -> Self:
        """The account of a receiver's link."""
        # In a run cut short, packets that are still under way count as lost; in a whole run, the router reports them itself.
        lost = sum(tally.lost.values()) + max(0, tally.late_sent - tally.late)
        delivered = tally.received + tally.late
        offered = tally.offered - tally.unsent
        missing = abs(offered - delivered - lost)
        return cls(offered, delivered, tally.late, lost, max(missing, tally.unexplained))


LINK_METRICS = (*(one.name for one in fields(LinkAccount)), "rate")
"""The metrics of a link; `rate` is the fraction of packets that its loss model let through."""
