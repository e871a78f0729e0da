"""Transmission scheduling: silence while the user still knows enough."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model.checks import count_mistakes
from evedrop.model.holding_time import HoldingTime
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Flags, Receiver
from evedrop.model.schemes.plain import PlainEstimator
from evedrop.model.schemes.scheme import Encoder, NoInnovations, Packet, Scheme, Shared
from evedrop.model.streams import Batch
from evedrop.model.theory.chain_form import ChainForm
from evedrop.model.theory.closed_form import ReceiverConditions
from evedrop.model.theory.closed_forms import hijacked_schedule, scheduled
from evedrop.model.theory.covariances import LARGEST_OPERATOR


class ScheduledEncoder(Encoder):
    """z_k = x_k from `threshold` slots after the last acknowledged slot on; silence before that."""

    def __init__(self, threshold: int, trials: int) -> None:
        self._threshold = threshold
        self._held = HoldingTime(trials)

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - the state alone is sent
        """The packet of slot k."""
        return Packet(x, np.zeros(x.shape[1], np.bool_), sent=self._held.reached(k, self._threshold))

    def acknowledged(self, k: int, acknowledged: Flags) -> None:
        """Begin a new silence where slot k is acknowledged."""
        self._held.acknowledged(k, acknowledged)


def _chain_form(scheme: Scheduled, conditions: ReceiverConditions) -> ChainForm | None:
    """That of a receiver that uses every packet; None if the chain, which has a state for each slot of silence, is too long."""
    received, acknowledged, hijack = conditions.received, conditions.acknowledged, conditions.hijack
    threshold, process = scheme.threshold, scheme.process
    if received is None or acknowledged is None or threshold > LARGEST_OPERATOR:
        return None
    if hijack is None:
        return ChainForm(process, conditions.slots, scheduled(threshold, received, acknowledged))
    if threshold * (hijack.heed_rule.patience + 2) * process.n**2 > LARGEST_OPERATOR:
        return None
    chain = hijacked_schedule(threshold, hijack.mu, hijack.mu_e, hijack.heed_rule, hijack.hears)
    return ChainForm(process, conditions.slots, chain)


class Scheduled(Scheme):
    """Sends from `threshold` slots after the last acknowledged slot until the next acknowledgement; with 1, always.

    There is no secret. An eavesdropper that misses the only packet after a silence knows nothing new until after the next
    silence. Where acknowledgements are blocked, the sensor sends in every slot, as `plain` does.

    Source: Leong, Quevedo, Dolz, Dey (2019); docs/mathematics.md, schedules by holding time.
    """

    closed_forms = MappingProxyType(dict.fromkeys(("legitimate", "naive", "reference", "selective"), _chain_form))
    sends_by_holding_time = True
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
        """A receiver that uses every packet."""
        return PlainEstimator(self.process, batch.trials)

    def outcomes(self, mu: float) -> None:  # noqa: ARG002 - its slots differ behind any link
        """None, because its slots differ: see `closed_forms`."""
        return
