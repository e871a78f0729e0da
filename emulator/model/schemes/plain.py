"""No scheme at all: every packet is the state. The baseline that keeps nothing secret."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from emulator.model.packet_user import PacketUser
from emulator.model.process import Floats, Process
from emulator.model.receiver import Flags, Receiver
from emulator.model.schemes.scheme import Encoder, Packet, Scheme, Shared
from emulator.streams import Batch


class PlainEncoder(Encoder):
    """z_k = x_k."""

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - the state alone is sent
        """The packet of slot k."""
        return Packet(x, np.zeros(x.shape[1], np.bool_))


class PlainEstimator(PacketUser):
    """Uses every packet it receives: E P → (1−μ) S(μ)."""

    def uses(self, k: int) -> Flags | None:  # noqa: ARG002 - every slot alike
        """Always."""
        return None


class NothingShared(Shared):
    """ν = 0 and χ = 0 always."""

    def __init__(self, process: Process, trials: int) -> None:
        self._process = process
        self._trials = trials

    def nu(self, k: int) -> Flags:  # noqa: ARG002 - every slot alike
        """No innovations, (R,)."""
        return np.zeros(self._trials, np.bool_)

    def chi(self, k: int) -> Floats:  # noqa: ARG002 - every slot alike
        """No noise, (n, R)."""
        return np.zeros((self._process.n, self._trials))

    def encoder(self) -> Encoder:
        """The sensor's side."""
        return PlainEncoder()

    def estimator(self) -> Receiver:
        """The legitimate estimator's side."""
        return PlainEstimator(self._process, self._trials)


class Plain(Scheme):
    """Every packet is the state, μ_d = 1; there is no secret."""

    secret_streams = ()
    mixes = False

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:  # noqa: ARG002 - there is no secret
        """Nothing."""
        return NothingShared(self.process, batch.trials)
