"""Strategies of eavesdroppers by their name in a scenario, and those of other modules."""

from __future__ import annotations

from collections.abc import Mapping

from evedrop.model.eavesdroppers.delegates import Colluding, ReplayInformed
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper
from evedrop.model.eavesdroppers.readers import GROUP, READERS, REMOTE_CALLS, RESERVED
from evedrop.model.eavesdroppers.remote_class import RemoteClasses
from evedrop.model.registry import Registry

_BUILT_IN: Mapping[str, type[Eavesdropper]] = {
    **READERS,
    "colluding": Colluding,
    "replay-informed": ReplayInformed,
}
STRATEGIES: Registry[Eavesdropper] = Registry(
    "eavesdropper",
    Eavesdropper,  # type: ignore[type-abstract]
    GROUP,
    _BUILT_IN,
    RESERVED,
    RemoteClasses(REMOTE_CALLS, "STRATEGIES"),
)

__all__ = ["READERS", "REMOTE_CALLS", "STRATEGIES"]
