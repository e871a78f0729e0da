"""Links of a wire for tests: settings of every registered loss and delay model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evedrop.wire.plan import WireLink

LOSSES: dict[str, dict[str, Any]] = {
    "bernoulli": {"model": "bernoulli", "quality": 0.8},
    "distance": {
        "model": "distance",
        "sender": [0, 0],
        "receiver": [[0, 60.0, 20.0], [4000, 150.0, 20.0]],
        "reference_snr": 75.0,
        "exponent": 3.0,
        "threshold": 10.0,
        "shadowing": 4.0,
        "shadowing_block": 60,
        "fading_block": 20,
    },
    "gilbert-elliott": {"model": "gilbert-elliott", "p": 0.02, "r": 0.1, "good": 0.01, "bad": 0.9},
    "markov": {
        "model": "markov",
        "transitions": [[0.9, 0.02, 0.08, 0.0], [1.0, 0.0, 0.0, 0.0], [0.3, 0.0, 0.5, 0.2], [0.0, 0.0, 0.4, 0.6]],
        "loss": [0.0, 1.0, 1.0, 0.0],
    },
    "pattern": {"model": "pattern", "outcomes": "1101001"},
    "trace": {"model": "trace", "outcomes": "1" * 300 + "10" * 40 + "0" * 37, "random_start": True},
}
DELAYS: dict[str, dict[str, Any]] = {
    "constant": {"model": "constant", "value": 0.25},
    "normal": {"model": "normal", "mean": 0.02, "deviation": 0.005},
    "pareto": {"model": "pareto", "least": 0.01, "shape": 1.5},
    "trace": {"model": "trace", "values": [0.5, 2.0, 1.25]},
}


def wire_link(settings: Mapping[str, Any], name: str = "scan", **fields: Any) -> WireLink:
    """A link from robot to base for all keys."""
    return WireLink(
        **{"name": name, "number": 0, "source": "robot", "target": "base", "keys": "**", "settings": settings, **fields}
    )
