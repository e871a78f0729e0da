"""The status of a wire while it runs, which it sends to an operator on request.

Source: docs/protocol.md, request and answer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from evedrop.model.entries import SLOT, entry, flag, listed, named, not_negative, read, table_of, text


@dataclass(frozen=True)
class WireLinkStatus:
    """The messages of a wire's link so far."""

    heard: int = field(metadata=entry(SLOT))
    delivered: int = field(metadata=entry(SLOT))
    cut: bool = field(metadata=entry(flag))
    """Whether nothing passes now."""

    def __str__(self) -> str:
        fraction = f"{self.delivered / self.heard:.4f}" if self.heard else "–"
        return f"{self.delivered} of {self.heard} messages delivered, {fraction}" + (", cut" if self.cut else "")


def _links(found: Mapping[str, Any]) -> dict[str, WireLinkStatus]:
    return {name: read(WireLinkStatus, one) for name, one in found.items()}


@dataclass(frozen=True)
class WireStatus:
    """The state of a wire."""

    seconds: float = field(metadata=entry(not_negative))
    """Since it began."""
    sides: Mapping[str, Sequence[str]] = field(metadata=entry(named(listed(text))))
    """Side → the endpoints at which programs connect."""
    links: Mapping[str, WireLinkStatus] = field(metadata=entry(named(table_of(WireLinkStatus)), _links))
    events: Sequence[str] = field(metadata=entry(listed(text)))
    """The events so far, a line each."""
    journal: str = field(metadata=entry(text))
    """Whether the journal is complete, in words."""
    bypasses: Sequence[str] = field(metadata=entry(listed(text)))
    """The ways past the wire that it noticed, a line each."""

    @property
    def lines(self) -> Iterator[str]:
        """The status as lines of text."""
        yield f"{self.seconds:.1f} s, journal {self.journal}"
        yield from (f"side {name}: {', '.join(endpoints)}" for name, endpoints in self.sides.items())
        yield from (f"link {name}: {link}" for name, link in self.links.items())
        yield from (f"event at {event}" for event in self.events)
        yield from (f"no verdict: {bypass}" for bypass in self.bypasses)
