"""Each metric that a wire file can expect of a link is its own number of the summary, and none where nothing was heard."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from evedrop.results.wire_summary import WireLinkSummary
from evedrop.wire.tallies import WIRE_METRICS

DELAYS: Any = SimpleNamespace(delay_quantile=lambda quantile: quantile)
"""The tally of messages whose delay has the quantile q at q seconds."""


def link(heard: int) -> WireLinkSummary:
    """A link whose numbers all differ."""
    return WireLinkSummary(
        source="robot",
        target="base",
        keys="**",
        heard=heard,
        bytes=500,
        delivered=3,
        again=2,
        lost_by={},
        dropped_by={},
        rate=None,
        expected_rate=None,
        bounds=None,
        within_bounds=None,
        delays={},
        gap_messages=4,
        gap_seconds=0.7,
    )


@pytest.mark.parametrize(("name", "value"), [("delivery", 0.25), ("gap_messages", 4), ("gap_seconds", 0.7)])
def test_a_metric_is_a_number_of_the_summary(name: str, value: float) -> None:
    """None if the link heard nothing."""
    assert WIRE_METRICS[name].value(link(12), DELAYS, None) == value
    assert WIRE_METRICS[name].value(link(0), DELAYS, None) is None


def test_a_latency_is_the_quantile_that_is_asked_for() -> None:
    """By default the median."""
    assert [WIRE_METRICS["latency"].value(link(12), DELAYS, value) for value in (0.9, None)] == [0.9, 0.5]
