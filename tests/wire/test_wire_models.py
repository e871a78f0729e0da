"""Every loss model on a real wire: what arrives is what the fates say, within its bounds, whatever else flows."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import pytest
import zenoh

from evedrop.model.links.loss_model import Fate
from evedrop.wire.deliveries import KeyDeliveries, bounds
from tests.conftest import wait_until
from tests.wire.wire_at_work import at_work, link, plan_of
from tests.wire.wire_links import LOSSES, key_fates

COUNT = 2000


@pytest.mark.thorough
def test_what_arrives_is_what_the_fates_say(tmp_path: Path) -> None:
    """For each model, between messages of all the others, in order; the rate is within the 99 % bounds of the distribution."""
    plan = plan_of(
        *(link("robot", "base", {"loss": loss}, f"{model}/**", name=model) for model, loss in LOSSES.items())
    )
    due = {}
    for wire_link in plan.links:
        fates = key_fates(wire_link, f"{wire_link.name}/x", "put", plan.seed)
        due[wire_link.name] = [n for n in range(COUNT) if fates.next()[0] == Fate.DELIVERED]
    heard: dict[str, list[int]] = defaultdict(list)

    others: list[str] = []

    def hear(sample: zenoh.Sample) -> None:
        model, _, rest = str(sample.key_expr).partition("/")
        if rest == "x":
            heard[model].append(int(sample.payload.to_string()))
        else:
            others.append(model)

    def other_arrives() -> bool:
        other.put("of another key on the same link")
        return bool(others)

    with at_work(plan, tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        base.declare_subscriber("**", zenoh.handlers.Callback(hear, indirect=False))
        block = zenoh.CongestionControl.BLOCK
        puts = {name: robot.declare_publisher(f"{name}/x", congestion_control=block) for name in due}
        other = robot.declare_publisher("bernoulli/y", congestion_control=block)
        wait_until(other_arrives, "the base hears the robot")
        for n in range(COUNT):
            for name, publisher in puts.items():
                publisher.put(str(n))
                if n % 7 == len(name) % 7:
                    other.put("of another key on the same link")
        wait_until(lambda: sum(map(len, heard.values())) >= sum(map(len, due.values())), "all messages have arrived")
    assert heard == due
    for wire_link in plan.links:
        low, high = bounds([KeyDeliveries(wire_link.settings, [], [range(COUNT)])], COUNT)
        assert low <= len(heard[wire_link.name]) <= high
