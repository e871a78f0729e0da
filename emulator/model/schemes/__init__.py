"""Schemes by their name in a scenario: one file each, and those of other modules."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from emulator.model.process import Process
from emulator.model.registry import Registry
from emulator.model.schemes.acknowledged import Acknowledged
from emulator.model.schemes.cipher import Cipher
from emulator.model.schemes.encrypted_schedule import EncryptedSchedule
from emulator.model.schemes.innovation import Innovation
from emulator.model.schemes.plain import Plain
from emulator.model.schemes.scheduled import Scheduled
from emulator.model.schemes.scheme import Scheme
from emulator.model.schemes.twin_track import TwinTrack
from emulator.model.schemes.withholding import Withholding

_BUILT_IN: Mapping[str, type[Scheme]] = {
    "acknowledged": Acknowledged,
    "cipher": Cipher,
    "encrypted-schedule": EncryptedSchedule,
    "innovation": Innovation,
    "plain": Plain,
    "scheduled": Scheduled,
    "twin-track": TwinTrack,
    "withholding": Withholding,
}
SCHEMES: Registry[Scheme] = Registry("scheme", Scheme, "evedrop.schemes", _BUILT_IN, ("scheme",))  # type: ignore[type-abstract]


def scheme_of(process: Process, spec: Mapping[str, Any]) -> Scheme:
    """The scheme that a scenario describes: `{"scheme": …, …parameters}`."""
    parameters = {name: value for name, value in spec.items() if name != "scheme"}
    return SCHEMES[spec["scheme"]](process, **parameters)
