"""Schemes that are silent in some slots.

Withholding sends the state with probability p, and otherwise nothing. Transmission scheduling is silent while the legitimate
estimator still knows enough.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model.acknowledgements import HoldingTime
from evedrop.model.checks import MOST_SLOTS, as_toml, is_number, probability_mistakes, whole_number_mistakes
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Flags, Receiver
from evedrop.model.schedule import Schedule
from evedrop.model.schemes.plain import PlainEstimator
from evedrop.model.schemes.scheme import Encoder, Packet, PublicScheme
from evedrop.model.streams import Batch
from evedrop.model.theory.closed_forms import ChainForm, ReceiverConditions, hijacked_schedule, scheduled
from evedrop.model.theory.covariances import LARGEST_OPERATOR, Outcomes
from evedrop.model.theory.leaked_bits import RevealedBits


class WithholdingEncoder(Encoder):
    """z_k = x_k where the schedule says so, and silence in the other slots."""

    def __init__(self, schedule: Schedule) -> None:
        self._schedule = schedule

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - the state alone is sent
        """The packet of slot k."""
        return Packet(x, np.zeros(x.shape[1], np.bool_), sent=~self._schedule.at(k))


class _Silent(PublicScheme):
    """Sends the state, or nothing: a receiver of a packet has the state."""

    sent_words = ("state",)
    may_be_silent = True

    def estimator(self, keys: Mapping[str, bytes], batch: Batch) -> Receiver:  # noqa: ARG002 - there is no secret
        """A receiver that uses every packet."""
        return PlainEstimator(self.process, batch.trials)


class Withholding(_Silent):
    """Sends in slot 0 and then with probability p = `state_probability`, by a coin that only the sensor needs.

    A receiver of a packet has the state, so receivers differ only in their rates. There is no secret: the estimator needs none,
    and an eavesdropper that knew the schedule would gain nothing.

    Source: Tsiamis, Gatsis, Pappas (2017); docs/mathematics/schemes.md, withholding.
    """

    parameters = MappingProxyType({"state_probability": 0.6})
    secret_streams = ("schedule",)

    def __init__(self, process: Process, state_probability: float) -> None:
        super().__init__(process, state_probability)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A number that is not a probability, or 0."""
        if is_number(given.get("state_probability"), 0.0, 0.0):
            why = f"is {as_toml(given['state_probability'])}, so nothing is sent after slot 0, and no receiver knows more than "
            why += "an eavesdropper that hears nothing; expected a number above 0, up to 1"
            return [("state_probability", why)]
        return probability_mistakes(given, "state_probability")

    def encoder(self, keys: Mapping[str, bytes], batch: Batch) -> Encoder:
        """The sensor's side, with the schedule."""
        return WithholdingEncoder(Schedule(keys["schedule"], self.state_probability, batch))

    def outcomes(self, mu: float) -> Outcomes:
        """A state with probability μp: E P → (1−μp) S(μp)."""
        return self.eavesdropper_outcomes(mu, 1.0, 1.0)

    def revealed_bits(self) -> RevealedBits:
        """The state; silence, by a coin that does not depend on the state, reveals nothing."""
        return RevealedBits(math.inf, 0.0)

    def eavesdropper_outcomes(self, mu_e: float, use_state: float, use_innovation: float) -> Outcomes:
        """Silent slots mislead no receiver."""
        del use_innovation
        return Outcomes.eavesdropper(mu_e, self.state_probability, use_state, 0.0)


class HoldingTimeEncoder(Encoder):
    """Follows the holding time; a subclass writes the packets."""

    def __init__(self, trials: int) -> None:
        self._held = HoldingTime(trials)

    def acknowledged(self, k: int, acknowledged: Flags) -> None:
        """Begin a new holding time where slot k is acknowledged."""
        self._held.acknowledged(k, acknowledged)


class ScheduledEncoder(HoldingTimeEncoder):
    """z_k = x_k from `threshold` slots after the last acknowledged slot on; silence before that."""

    def __init__(self, threshold: int, trials: int) -> None:
        super().__init__(trials)
        self._threshold = threshold

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - the state alone is sent
        """The packet of slot k."""
        return Packet(x, np.zeros(x.shape[1], np.bool_), sent=self._held.reached(k, self._threshold))


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


class Scheduled(_Silent):
    """Sends from `threshold` slots after the last acknowledged slot until the next acknowledgement; with 1, always.

    There is no secret. An eavesdropper that misses the only packet after a silence knows nothing new until after the next
    silence. Where acknowledgements are blocked, the sensor sends in every slot, as `plain` does.

    Source: Leong, Quevedo, Dolz, Dey (2019); docs/mathematics/schemes.md, schedules by holding time.
    """

    closed_forms = MappingProxyType(dict.fromkeys(("legitimate", "naive", "reference", "selective"), _chain_form))
    sends_by_holding_time = True
    parameters = MappingProxyType({"threshold": 4})
    needs_acknowledgements = True

    def __init__(self, process: Process, threshold: int) -> None:
        super().__init__(process)
        self.threshold = threshold

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A threshold is a number of slots."""
        return whole_number_mistakes(given, "threshold", 1, MOST_SLOTS)

    def encoder(self, keys: Mapping[str, bytes], batch: Batch) -> Encoder:  # noqa: ARG002 - there is no secret
        """The sensor's side."""
        return ScheduledEncoder(self.threshold, batch.trials)

    def outcomes(self, mu: float) -> None:  # noqa: ARG002 - its slots differ behind any link
        """None, because its slots differ: see `closed_forms`."""
        return
