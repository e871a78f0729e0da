"""Transmission scheduling: stay silent while the user still knows enough."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model.holding_time import HoldingTime
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Flags, Receiver
from evedrop.model.schemes.checks import count_mistakes
from evedrop.model.schemes.plain import PlainEstimator
from evedrop.model.schemes.scheme import Encoder, NoInnovations, Packet, Scheme, Shared
from evedrop.streams import Batch


class ScheduledEncoder(Encoder):
    """z_k = x_k from `threshold` slots after the last acknowledged one; silence before."""

    def __init__(self, threshold: int, trials: int) -> None:
        self._threshold = threshold
        self._held = HoldingTime(trials)

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - the state alone is sent
        """The packet of slot k."""
        return Packet(x, np.zeros(x.shape[1], np.bool_), sent=self._held.reached(k, self._threshold))

    def acknowledged(self, k: int, acknowledged: Flags) -> None:
        """Begin a new silence where slot k is acknowledged."""
        self._held.acknowledged(k, acknowledged)


class Scheduled(Scheme):
    """Sends from `threshold` slots after the last acknowledged one until the next acknowledgement; 1 is always.

    There is no secret. An eavesdropper that misses the one packet after a silence stays blind through the next. Where
    acknowledgements are blocked the sensor sends in every slot, as `plain` does.

    Source: Leong, Quevedo, Dolz, Dey (2019); docs/mathematics.md, schedules by holding time.
    """

    closed_forms = MappingProxyType(dict.fromkeys(("legitimate", "naive", "reference", "selective"), "scheduled"))
    parameters = MappingProxyType({"threshold": 4})
    needs_acknowledgements = True
    may_be_silent = True

    def __init__(self, process: Process, threshold: int) -> None:
        super().__init__(process)
        self.threshold = threshold

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A threshold is a number of slots."""
        return count_mistakes(given, "threshold")

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """Nothing."""
        return NoInnovations(
            self.process,
            batch.trials,
            lambda: ScheduledEncoder(self.threshold, batch.trials),
            lambda: self.estimator(keys, batch),
        )

    def estimator(self, keys: Mapping[str, bytes], batch: Batch) -> Receiver:  # noqa: ARG002 - there is no secret
        """Uses whatever arrives."""
        return PlainEstimator(self.process, batch.trials)

    def outcomes(self, mu: float) -> None:  # noqa: ARG002 - no link makes its slots alike
        """Its slots are not alike: see `closed_forms.scheduled`."""
        return
