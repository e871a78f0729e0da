"""The genie: knows the type of every packet and uses all information in it. No eavesdropper without the secret does better."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from evedrop.model.eavesdroppers.eavesdropper import Knowledge, PacketReader
from evedrop.model.receiver import Belief, Codes, Flags, Reception, cleared, select
from evedrop.model.schedule import Schedule
from evedrop.model.streams import Batch
from evedrop.model.theory.covariances import Outcomes, OutcomesAt
from evedrop.model.theory.leak import Leaks


class Genie(PacketReader):
    """Exact MMSE given the schedule: an innovation reduces the noise from Q to Q − QΣ_k⁻¹Q.

    Its belief is correct, and its mean error is a lower bound for every eavesdropper behind the same link.

    Source: docs/mathematics.md, genie.
    """

    only_against = ("innovation", "uses what innovations leak, and there are none")
    reads_leaks = True

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._schedule = Schedule(knowledge.keys["schedule"], knowledge.mu_d, batch)
        self._leaks = Leaks(knowledge.process)

    @classmethod
    def streams(cls, parameters: Mapping[str, Any]) -> tuple[str, ...]:  # noqa: ARG003 - alike for all
        """The schedule."""
        return ("schedule",)

    @classmethod
    def outcomes(cls, parameters: Mapping[str, Any], mu_d: float) -> OutcomesAt | None:  # noqa: ARG003 - it has none
        """States used, innovations read for their leak."""
        return lambda mu_e: Outcomes.genie(mu_e, mu_d)

    def act(self, k: int, gamma: Flags) -> Codes:
        """Lost, used as the state, or read as an innovation."""
        return gamma.view(np.uint8) + (gamma & self._schedule.at(k)).view(np.uint8)

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """(A x̂, A P Aᵀ + Q) if lost, (z, 0) for the state, (A x̂ + QΣ⁻¹z, A P Aᵀ + Q − QΣ⁻¹Q) for an innovation."""
        gamma, nu = heard.gamma, self._schedule.at(k)
        state, innovation = gamma & ~nu, gamma & nu
        x_hat, P = belief.x_hat, belief.P
        if k:
            leak, stairs = self._leaks.at(k), self._leaks.stairs
            carried, predicted = self.process.carry(P), self.process.predict(x_hat)
            x_hat = select(
                innovation,
                lambda: predicted + stairs.outward(leak.innovation(leak.white(stairs.inward(heard.z)))),
                lambda: predicted,
            )
            P = select(
                innovation,
                lambda: carried + stairs.outward_covariance(leak.remaining[:, :, None]),
                lambda: self.process.diffuse(carried),
            )
        return Belief(
            select(state, lambda: heard.z, lambda: x_hat), cleared(state, P.shape, lambda: P), self.act(k, gamma)
        )
