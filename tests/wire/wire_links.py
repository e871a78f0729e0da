"""Links of a wire for tests: settings of every registered loss and delay model."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from evedrop.model.slot.link import Change
from evedrop.wire.plan import WireLink
from evedrop.wire.running_link import KeyFates, PerKeyLinks

LOSSES: dict[str, dict[str, Any]] = {
    name: {"model": name, **parameters}
    for name, parameters in tomllib.loads(Path(__file__).with_name("losses.toml").read_text(encoding="utf-8")).items()
}
DELAYS: dict[str, dict[str, Any]] = {
    "constant": {"model": "constant", "value": 0.25},
    "normal": {"model": "normal", "mean": 0.02, "standard_deviation": 0.005},
    "pareto": {"model": "pareto", "least": 0.01, "shape": 1.5},
    "trace": {"model": "trace", "values": [0.5, 2.0, 1.25]},
}


def wire_link(settings: Mapping[str, Any], name: str = "scan", **fields: Any) -> WireLink:
    """A link from robot to base for all keys."""
    return WireLink(
        **{"name": name, "number": 0, "source": "robot", "target": "base", "keys": "**", "settings": settings, **fields}
    )


def key_fates(
    link: WireLink, key: str, kind: str, seed: int, start: int = 0, changes: Iterable[Change] = ()
) -> KeyFates:
    """The fates of a key's messages on a link of a wire with this seed."""
    return KeyFates(PerKeyLinks(link, seed, changes), kind, key, start)
