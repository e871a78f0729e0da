"""Strategies of eavesdroppers by their name in a scenario: one file each."""

from __future__ import annotations

from collections.abc import Mapping

from emulator.model.eavesdroppers.colluding import Colluding
from emulator.model.eavesdroppers.eavesdropper import Eavesdropper
from emulator.model.eavesdroppers.readers import READERS
from emulator.model.eavesdroppers.replay_informed import ReplayInformed

STRATEGIES: Mapping[str, type[Eavesdropper]] = {
    **READERS,
    "colluding": Colluding,
    "replay-informed": ReplayInformed,
}

__all__ = ["READERS", "STRATEGIES"]
