"""Schemes by their name in a scenario: one file each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from emulator.model.process import Process
from emulator.model.schemes.acknowledged import Acknowledged
from emulator.model.schemes.cipher import Cipher
from emulator.model.schemes.encrypted_schedule import EncryptedSchedule
from emulator.model.schemes.innovation import Innovation
from emulator.model.schemes.plain import Plain
from emulator.model.schemes.scheduled import Scheduled
from emulator.model.schemes.scheme import Scheme
from emulator.model.schemes.twin_track import TwinTrack
from emulator.model.schemes.withholding import Withholding

SCHEMES: Mapping[str, type[Scheme]] = {
    "acknowledged": Acknowledged,
    "cipher": Cipher,
    "encrypted-schedule": EncryptedSchedule,
    "innovation": Innovation,
    "plain": Plain,
    "scheduled": Scheduled,
    "twin-track": TwinTrack,
    "withholding": Withholding,
}


def scheme_of(process: Process, spec: Mapping[str, Any]) -> Scheme:
    """The scheme that a scenario describes: `{"scheme": …, …parameters}`."""
    parameters = {name: value for name, value in spec.items() if name != "scheme"}
    return SCHEMES[spec["scheme"]](process, **parameters)
