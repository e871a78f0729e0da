"""The status of a run in progress, which its recorder sends to an operator on request.

Source: docs/protocol.md, request and answer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

from evedrop.model.entries import SLOT, entry, flag, listed, maybe, named, not_negative, read, table_of, text
from evedrop.scenario.progress_events import RunEvent


@dataclass(frozen=True)
class LinkStatus:
    """The packets of a link so far."""

    offered: int = field(metadata=entry(SLOT))
    delivered: int = field(metadata=entry(SLOT))
    fraction: float | None = field(metadata=entry(maybe(not_negative)))
    """The fraction of the offered packets that was delivered; None if none was offered."""

    @classmethod
    def of(cls, offered: int, delivered: int) -> Self:
        """The status of a link with these packets."""
        return cls(offered, delivered, delivered / offered if offered else None)

    def __str__(self) -> str:
        fraction = "–" if self.fraction is None else f"{self.fraction:.4f}"
        return f"{self.delivered} of {self.offered} packets delivered, {fraction}"


def _links(found: Mapping[str, Any]) -> dict[str, LinkStatus]:
    return {name: read(LinkStatus, one) for name, one in found.items()}


def _events(found: Sequence[Mapping[str, Any]]) -> list[RunEvent]:
    return [read(RunEvent, one) for one in found]


@dataclass(frozen=True)
class RunStatus:
    """The state of a run in progress."""

    slot: int = field(metadata=entry(SLOT))
    """The first slot that is not scored."""
    slots: int = field(metadata=entry(SLOT))
    """The number of slots of the run."""
    slots_per_second: float = field(metadata=entry(not_negative))
    state: str = field(metadata=entry(text))
    """`running`, `held` or `paused`."""
    processes: Mapping[str, bool] = field(metadata=entry(named(flag)))
    """Process → whether it is on the network."""
    links: Mapping[str, LinkStatus] = field(metadata=entry(named(table_of(LinkStatus)), _links))
    """Receiver → its link."""
    events: Sequence[RunEvent] = field(metadata=entry(listed(table_of(RunEvent)), _events))

    @property
    def lines(self) -> Iterator[str]:
        """The status as lines of text."""
        state = self.state if self.state == "running" else f"{self.state} before slot {self.slot}"
        yield f"slot {self.slot} of {self.slots}, {self.slots_per_second:,.0f} slots/s, {state}"
        there = ", ".join(name for name, is_there in self.processes.items() if is_there)
        missing = ", ".join(name for name, is_there in self.processes.items() if not is_there)
        yield f"processes: {there}" + (f"; not on the network: {missing}" if missing else "")
        yield from (f"link {name}: {link}" for name, link in self.links.items())
        yield from (f"event at slot {one.slot}: {one.event} (by the {one.by})" for one in self.events)


def status_of_shards(statuses: Sequence[RunStatus]) -> RunStatus:
    """The status of a run in shards: the slowest one's slot; processes present if they are in all shards; and all packets."""
    slowest = min(statuses, key=lambda status: status.slot)
    processes = {name: all(one.processes[name] for one in statuses) for name in slowest.processes}
    links = {
        name: LinkStatus.of(
            *(sum(getattr(one.links[name], what) for one in statuses) for what in ("offered", "delivered"))
        )
        for name in slowest.links
    }
    return replace(slowest, processes=processes, links=links)
