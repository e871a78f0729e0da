"""Integrity of a closed loop: attacks on the sensor's measurements, the watermark of the inputs, and the detector.

Attacks and policies are registered here by their names in a scenario.

Source: docs/mathematics/attacks.md, integrity.
"""

from __future__ import annotations

from collections.abc import Mapping

from evedrop.model.integrity.attacks import Replacement, Replay, SensorAttack
from evedrop.model.integrity.policies import AlwaysMarked, Parsimonious, WatermarkPolicy

SENSOR_ATTACKS: Mapping[str, type[SensorAttack]] = {"replace": Replacement, "replay": Replay}
POLICIES: Mapping[str, type[WatermarkPolicy]] = {"always": AlwaysMarked, "parsimonious": Parsimonious}

__all__ = ["POLICIES", "SENSOR_ATTACKS", "SensorAttack", "WatermarkPolicy"]
