"""Plans of wires for tests."""

from __future__ import annotations

from typing import Any

from evedrop.wire.plan import Side, WireLink, WirePlan


def wire_plan(seed: int = 7, **links: Any) -> WirePlan:
    """A wire of two sides and these links from robot to base, name → settings; without any, one that loses 40 %."""
    links = links or {"scan": {"loss": {"model": "bernoulli", "quality": 0.6}}}
    made = [
        WireLink(name, at, "robot", "base", f"{name}/**", settings) for at, (name, settings) in enumerate(links.items())
    ]
    return WirePlan(seed, {"robot": Side("robot"), "base": Side("base")}, tuple(made))
