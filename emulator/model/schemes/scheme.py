"""What a scheme is: an encoder for the sensor and the estimator that can read it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emulator.model.process import Floats, Process
from emulator.model.receiver import Flags, Receiver
from emulator.streams import Batch


class Packet(NamedTuple):
    """What the sensor sends in a slot, for R trials."""

    z: Floats
    """Payload, (n, R)."""
    nu: Flags
    """ν_k, (R,): true for an innovation. Never sent; the sensor's own record."""
    header: NDArray[np.int64] | None = None
    """What is sent in clear beside z, (h, R); None for a scheme that has no header."""
    sent: Flags | None = None
    """Whether anything is sent, (R,); None for a scheme that sends in every slot."""


class Encoder(ABC):
    """Makes packets of states, slot by slot."""

    @abstractmethod
    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """The packet of slot k, from x_k and A x_{k−1}, both (n, R)."""

    def acknowledged(self, k: int, acknowledged: Flags) -> None:  # noqa: B027 - most schemes need none
        """Take the acknowledgements (R,) of the packets of slot k, as they reached the sensor; before slot k + 1 is sent."""


class Shared(ABC):
    """What sensor and legitimate estimator share, and the two sides made from it. Read ahead in blocks; slots in order."""

    @abstractmethod
    def nu(self, k: int) -> Flags:
        """ν_k, (R,): true for an innovation."""

    @abstractmethod
    def chi(self, k: int) -> Floats:
        """χ_k, (n, R): the noise that hides an innovation."""

    @abstractmethod
    def encoder(self) -> Encoder:
        """The sensor's side."""

    @abstractmethod
    def estimator(self) -> Receiver:
        """The legitimate estimator's side."""


class Scheme(ABC):
    """One way to fill packets. `state_probability` is μ_d, public; the keys of `secret_streams` are the secret."""

    secret_streams: ClassVar[tuple[str, ...]]
    mixes: ClassVar[bool]
    """Whether packets are of two types, so that μ_d must be given."""

    def __init__(self, process: Process, state_probability: float) -> None:
        self.process = process
        self.state_probability = state_probability

    @abstractmethod
    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """What the two sides share; keys holds those of `secret_streams`."""

    def encoder(self, keys: Mapping[str, bytes], batch: Batch) -> Encoder:
        """The sensor's side alone."""
        return self.shared(keys, batch).encoder()

    def estimator(self, keys: Mapping[str, bytes], batch: Batch) -> Receiver:
        """The legitimate estimator's side alone."""
        return self.shared(keys, batch).estimator()
