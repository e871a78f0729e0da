"""Drawn scenarios have measurements, detectors, disturbances, applications, betrayed states, and shards with two routers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import pytest

from evedrop.scenario.tables import Scenario
from evedrop.virtual.drawn_scenarios import scenario_of


def parts_of(scenario: Scenario) -> Iterator[str]:
    """What there is in a scenario."""
    tables = scenario.as_tables()
    integrity, plant = tables.get("integrity", {}), tables.get("plant", {})
    yield from {"comfort", "output_matrix", "disturbances"} & {*tables, *plant}
    yield from (f"integrity.{name}" for name in ("policy", "watermark", "attack") if name in integrity)
    if scenario.leaks:
        yield "leaks"
    if scenario.shards > 1 and scenario.relayed:
        yield "shards with two routers"


@pytest.mark.campaign
def test_all_are_drawn() -> None:
    """Each in some of the first scenarios, and none of them in most."""
    counts = Counter(part for number in range(500) for part in parts_of(scenario_of(number)))
    expected = ("comfort", "output_matrix", "disturbances", "leaks", "shards with two routers")
    for name in (*expected, "integrity.policy", "integrity.watermark", "integrity.attack"):
        assert 2 <= counts[name] <= 100, (name, counts)
