"""Schemes by their name in a scenario: one file each, and those of other modules."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evedrop.model.process import Process
from evedrop.model.registry import Registry
from evedrop.model.schemes.acknowledged import Acknowledged
from evedrop.model.schemes.cipher import Cipher
from evedrop.model.schemes.encrypted_schedule import EncryptedSchedule
from evedrop.model.schemes.innovation import Innovation
from evedrop.model.schemes.noise import Noise
from evedrop.model.schemes.open_loop import OpenLoop
from evedrop.model.schemes.partial_encryption import PartialEncryption
from evedrop.model.schemes.plain import Plain
from evedrop.model.schemes.quantised_schedule import QuantisedSchedule
from evedrop.model.schemes.random_code import RandomCode
from evedrop.model.schemes.scheduled import Scheduled
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.schemes.threshold_code import ThresholdCode
from evedrop.model.schemes.twin_track import TwinTrack
from evedrop.model.schemes.withholding import Withholding

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
