"""Integrity of a closed loop: attacks on the sensor's measurements, the watermark of the inputs, and the detector.

Attacks and policies are registered here by their names in a scenario: one file each.

Source: docs/mathematics.md, integrity.
"""

from __future__ import annotations

from collections.abc import Mapping

from evedrop.model.integrity.always import AlwaysMarked
from evedrop.model.integrity.attack import SensorAttack
from evedrop.model.integrity.parsimonious import Parsimonious
from evedrop.model.integrity.policy import WatermarkPolicy
from evedrop.model.integrity.replacement import Replacement
from evedrop.model.integrity.replay import Replay

SENSOR_ATTACKS: Mapping[str, type[SensorAttack]] = {"replace": Replacement, "replay": Replay}
POLICIES: Mapping[str, type[WatermarkPolicy]] = {"always": AlwaysMarked, "parsimonious": Parsimonious}

__all__ = ["POLICIES", "SENSOR_ATTACKS", "SensorAttack", "WatermarkPolicy"]
