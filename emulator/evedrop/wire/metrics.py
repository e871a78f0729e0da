"""The metrics of a link that a wire file can expect something of: a class for each, and `WIRE_METRICS`, which lists them.

Source: docs/wire.md, expectations.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Protocol, final

from evedrop.results.wire_summary import WireLinkSummary
from evedrop.wire.tallies import LinkTally


class WireMetric(Protocol):
    """A metric of a link."""

    name: ClassVar[str]
    """As in `metric = "LINK.name"`."""
    has_quantile: ClassVar[bool]
    """Whether its table has `quantile`."""

    def value(self, link: WireLinkSummary, tally: LinkTally, quantile: float | None) -> float | None:
        """The metric so far; None if no message gives one: its expectation failed. quantile: that of the table, if it has one."""


@final
class Delivery:
    """The fraction of the messages that were delivered."""

    name: ClassVar[str] = "delivery"
    has_quantile: ClassVar[bool] = False

    def value(self, link: WireLinkSummary, tally: LinkTally, quantile: float | None) -> float | None:  # noqa: ARG002
        """Delivered messages per message that was heard."""
        return link.delivered / link.heard if link.heard else None


@final
class Heard:
    """The messages that the link took, which a silent link has too."""

    name: ClassVar[str] = "heard"
    has_quantile: ClassVar[bool] = False

    def value(self, link: WireLinkSummary, tally: LinkTally, quantile: float | None) -> float | None:  # noqa: ARG002
        """A number of messages."""
        return link.heard


@final
class Latency:
    """A quantile of the time for which delivered messages were held back."""

    name: ClassVar[str] = "latency"
    has_quantile: ClassVar[bool] = True

    def value(self, link: WireLinkSummary, tally: LinkTally, quantile: float | None) -> float | None:  # noqa: ARG002
        """Seconds; None if no message was delivered. Without a quantile, the median."""
        return tally.delay_quantile(quantile or 0.5)


@final
class GapMessages:
    """The most messages of one key in a row that were not delivered."""

    name: ClassVar[str] = "gap_messages"
    has_quantile: ClassVar[bool] = False

    def value(self, link: WireLinkSummary, tally: LinkTally, quantile: float | None) -> float | None:  # noqa: ARG002
        """A number of messages."""
        return link.gap_messages if link.heard else None


@final
class GapSeconds:
    """The longest time from a delivered message of a key to its next one, if messages between them were not delivered."""

    name: ClassVar[str] = "gap_seconds"
    has_quantile: ClassVar[bool] = False

    def value(self, link: WireLinkSummary, tally: LinkTally, quantile: float | None) -> float | None:  # noqa: ARG002
        """Seconds."""
        return link.gap_seconds if link.heard else None


_ALL: tuple[WireMetric, ...] = (Heard(), Delivery(), Latency(), GapMessages(), GapSeconds())
WIRE_METRICS: Mapping[str, WireMetric] = {metric.name: metric for metric in _ALL}
"""Name → the metric, in the order of docs/wire.md."""
