"""Strategies of eavesdroppers by their name in a scenario: one file each."""

from __future__ import annotations

from collections.abc import Mapping

from emulator.model.eavesdroppers.eavesdropper import Eavesdropper
from emulator.model.eavesdroppers.naive import Naive
from emulator.model.eavesdroppers.reference import Reference
from emulator.model.eavesdroppers.selective import Selective
from emulator.model.eavesdroppers.smart import Smart
from emulator.model.eavesdroppers.suspicious import Suspicious

STRATEGIES: Mapping[str, type[Eavesdropper]] = {
    "naive": Naive,
    "reference": Reference,
    "selective": Selective,
    "suspicious": Suspicious,
    "smart": Smart,
}
