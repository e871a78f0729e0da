"""Withholding: send the state with probability p, and otherwise nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model.checks import as_toml, is_number, probability_mistakes
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Receiver
from evedrop.model.schedule import Schedule
from evedrop.model.schemes.plain import PlainEstimator
from evedrop.model.schemes.scheme import Encoder, NoInnovations, Packet, Scheme, Shared
from evedrop.model.streams import Batch
from evedrop.model.theory.covariances import Outcomes
from evedrop.model.theory.leaked_bits import RevealedBits


class WithholdingEncoder(Encoder):
    """z_k = x_k where the schedule says so, and silence in the other slots."""

    def __init__(self, schedule: Schedule) -> None:
        self._schedule = schedule

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - the state alone is sent
        """The packet of slot k."""
        return Packet(x, np.zeros(x.shape[1], np.bool_), sent=~self._schedule.at(k))


class Withholding(Scheme):
    """Sends in slot 0 and then with probability p = `state_probability`, by a coin that only the sensor needs.

    A receiver of a packet has the state, so receivers differ only in their rates. There is no secret: the estimator needs none,
    and an eavesdropper that knew the schedule would gain nothing.

    Source: Tsiamis, Gatsis, Pappas (2017); docs/mathematics.md, withholding.
    """

    parameters = MappingProxyType({"state_probability": 0.6})
    secret_streams = ("schedule",)
    may_be_silent = True

    def __init__(self, process: Process, state_probability: float) -> None:
        super().__init__(process, state_probability)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A number that is not a probability, or 0."""
        if is_number(given.get("state_probability"), 0.0, 0.0):
            what = f"is {as_toml(given['state_probability'])}, so nothing is sent after slot 0, and the user knows no more than "
            what += "an eavesdropper that hears nothing; expected a number above 0, up to 1"
            return [("state_probability", what)]
        return probability_mistakes(given, "state_probability")

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """The sensor's schedule, and nothing for the estimator."""
        schedule = Schedule(keys["schedule"], self.state_probability, batch)
        return NoInnovations(
            self.process, batch.trials, lambda: WithholdingEncoder(schedule), lambda: self.estimator({}, batch)
        )

    def estimator(self, keys: Mapping[str, bytes], batch: Batch) -> Receiver:  # noqa: ARG002 - there is no secret
        """A receiver that uses every packet."""
        return PlainEstimator(self.process, batch.trials)

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
