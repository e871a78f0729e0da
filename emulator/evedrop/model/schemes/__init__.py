"""Schemes by their name in a scenario, and those of other modules."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evedrop.model.process import Process
from evedrop.model.registry import Registry
from evedrop.model.schemes.acknowledged import Acknowledged, OpenLoop
from evedrop.model.schemes.cipher import Cipher
from evedrop.model.schemes.encrypted_schedule import EncryptedSchedule, QuantisedSchedule
from evedrop.model.schemes.innovation import Innovation
from evedrop.model.schemes.mixed_packets import RandomCode, ThresholdCode
from evedrop.model.schemes.noise import Noise
from evedrop.model.schemes.partial_encryption import PartialEncryption
from evedrop.model.schemes.plain import Plain
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.schemes.silent import Scheduled, Withholding
from evedrop.model.schemes.twin_track import TwinTrack

_BUILT_IN: Mapping[str, type[Scheme]] = {
    "acknowledged": Acknowledged,
    "cipher": Cipher,
    "encrypted-schedule": EncryptedSchedule,
    "innovation": Innovation,
    "noise": Noise,
    "open-loop": OpenLoop,
    "partial-encryption": PartialEncryption,
    "plain": Plain,
    "quantised-schedule": QuantisedSchedule,
    "random-code": RandomCode,
    "scheduled": Scheduled,
    "threshold-code": ThresholdCode,
    "twin-track": TwinTrack,
    "withholding": Withholding,
}
SCHEMES: Registry[Scheme] = Registry("scheme", Scheme, "evedrop.schemes", _BUILT_IN, ("scheme",))  # type: ignore[type-abstract]
PAPERS_SCHEME = "innovation"
"""The scheme that is meant where none is named."""


def scheme_of(process: Process, spec: Mapping[str, Any]) -> Scheme:
    """The scheme that a scenario describes: `{"scheme": …, …parameters}`."""
    parameters = {name: value for name, value in spec.items() if name != "scheme"}
    return SCHEMES[spec["scheme"]](process, **parameters)
