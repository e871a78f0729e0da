"""The keys of a scenario's random streams, including those of the shared secret."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evedrop.errors import UsageError
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.slot.link import LinkSchedule, streams_of
from evedrop.model.streams import root_of_seed, stream_key
from evedrop.names import ACKNOWLEDGEMENTS
from evedrop.scenario.receivers import WireTable
from evedrop.scenario.tables import Scenario
from evedrop.system.files import Unreadable, contents

_SECRET_BYTES = 32
_MOST_SECRET_BYTES = 2**20


def secret_in(file: str) -> bytes:
    """The secret in a file. Raises UsageError if the file cannot be read, or is too short."""
    expected = f"expected a file of {_SECRET_BYTES} or more random bytes"
    try:
        secret = contents(Path(file), _MOST_SECRET_BYTES)
    except Unreadable as error:
        raise UsageError(f"secret_file: {file} cannot be read ({error}); {expected}") from error
    if len(secret) < _SECRET_BYTES:
        raise UsageError(f"secret_file: {file} has {len(secret)} bytes; {expected}")
    return secret


@dataclass(frozen=True)
class StreamKeys:
    """The keys of all streams of a scenario: those from the seed, and those of the secret."""

    seed_root: bytes
    secret_root: bytes
    wire: WireTable | None = None
    """The wire whose random numbers some links draw; None if each draws its own."""

    @classmethod
    def from_scenario(cls, scenario: Scenario) -> StreamKeys:
        """The keys of a scenario: from its seed, and the secret's from a file if it names one. Raises as `secret_in`."""
        root = root_of_seed(scenario.seed)
        if scenario.secret_file is None:
            return cls(root, stream_key(root, "secret"), scenario.wire)
        return cls(root, stream_key(secret_in(scenario.secret_file), "secret"), scenario.wire)

    def secret(self, names: tuple[str, ...]) -> dict[str, bytes]:
        """Stream → its key, for these streams of the shared secret."""
        return {name: stream_key(self.secret_root, name) for name in names}

    @property
    def process(self) -> bytes:
        """The key of the sensor's process noise."""
        return stream_key(self.seed_root, "process")

    def link(self, receiver: str, schedule: LinkSchedule) -> dict[str, bytes]:
        """Stream → its key, for all streams that a receiver's link draws from."""
        streams = streams_of(receiver, schedule)
        own = {name: stream_key(self.seed_root, name) for name in streams}
        return own if self.wire is None else {**own, **self.wire.stream_keys(streams)}

    def links(self, schedules: Mapping[str, LinkSchedule]) -> dict[str, bytes]:
        """Stream → its key, for all links."""
        return {
            name: key for receiver, schedule in schedules.items() for name, key in self.link(receiver, schedule).items()
        }

    @property
    def measurement(self) -> bytes:
        """The key of the sensor's measurement noise."""
        return stream_key(self.seed_root, "measurement")

    @property
    def watermark(self) -> bytes:
        """The key of the watermark that is added to the plant's inputs."""
        return stream_key(self.seed_root, "watermark")

    @property
    def spoofing(self) -> bytes:
        """The key of the values that an attacker makes the sensor report."""
        return stream_key(self.seed_root, "spoofing")

    @property
    def acknowledgements(self) -> bytes:
        """The key of the losses of acknowledgements."""
        return stream_key(self.seed_root, f"link/{ACKNOWLEDGEMENTS}")

    def eavesdropper(self, name: str, strategy: str, parameters: Mapping[str, Any]) -> dict[str, bytes]:
        """The keys that an eavesdropper's strategy must be given: the schedule's, that of its own coin, or none."""
        keys = {}
        for stream in STRATEGIES[strategy].streams(parameters):
            own = stream_key(self.seed_root, f"coin/{name}")
            keys[stream] = own if stream == "coin" else stream_key(self.secret_root, stream)
        return keys
