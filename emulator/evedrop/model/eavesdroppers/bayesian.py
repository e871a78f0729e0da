"""The best that an eavesdropper can do: the Bayesian one without the secret, and the genie, which knows every packet's type.

The Bayesian eavesdropper knows the mechanism but not the secret, and weighs every possible history. Its posterior is a mixture
with a component for each slot j that may have brought the last state packet it received: x_j was that packet, and all later
packets were innovations. A packet either starts a new component, or is one more innovation for all others.

The genie uses all information in a packet. No eavesdropper without the secret does better.

Source: docs/mathematics/eavesdroppers.md, bayesian eavesdropper.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from evedrop.model.eavesdroppers.eavesdropper import Knowledge, KnowsSchedule, PacketReader
from evedrop.model.kernels.current import kernels
from evedrop.model.kernels.elementary import cholesky
from evedrop.model.kernels.factored import Factor, Factors
from evedrop.model.kernels.mixtures import Mixture
from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Beliefs, Codes, Flags, Reception, cleared, select
from evedrop.model.schedule import equal_slots, in_slot
from evedrop.model.streams import Batch
from evedrop.model.theory.covariances import Outcomes, OutcomesAt
from evedrop.model.theory.leak import Leaks


class Genie(KnowsSchedule, PacketReader):
    """Exact MMSE given the schedule: an innovation reduces the noise from Q to Q − QΣ_k⁻¹Q.

    Its belief is correct, and its mean error is a lower bound for every eavesdropper behind the same link.

    Source: docs/mathematics/eavesdroppers.md, genie.
    """

    only_against = ("innovation", "uses what innovations leak, and there are none")
    reads_leaks = True

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._leaks = Leaks(knowledge.process)

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


CAPACITY = 12
"""The most components of a trial; beyond it the two least probable ones are merged, with the same mean and covariance."""


class Bayesian(PacketReader):
    """Minimum mean square error, apart from the loss where too many components would have to be kept.

    `Belief.memory` is its `Mixture`.
    """

    only_against = (
        ("innovation", "noise"),
        "weighs states against innovations, and there are none: it is the same as naive here",
    )
    reads_leaks = tests_range = True

    def __init__(self, knowledge: Knowledge, batch: Batch, capacity: int = CAPACITY) -> None:
        super().__init__(knowledge, batch)
        self._mu_d = knowledge.mu_d
        self._capacity = capacity
        self._leaks = Leaks(knowledge.process, knowledge.noise_distribution)
        self._stairs = self._leaks.stairs
        """The coordinates of `Belief.memory`."""

    def prior(self, first: int = 0) -> Belief:
        """One component, without any reception."""
        belief = super().prior(first)
        n, trials = belief.x_hat.shape
        factor = cholesky(self._stairs.inward_covariance(belief.P[:, :, :1])[:, :, 0])
        spread = Factors.alike(Factor.of_triangular(factor.tolist()), (1, trials))
        return belief._replace(memory=Mixture(np.ones((1, trials)), np.zeros((n, 1, trials)), *spread))

    def knowing(self, k: int, x: Floats, belief: Belief) -> Belief:
        """One component with covariance 0."""
        belief, (n, trials) = super().knowing(k, x, belief), x.shape
        nothing = np.zeros((n * (n - 1) // 2, 1, trials)), np.zeros((n, 1, trials))
        return belief._replace(memory=Mixture(np.ones((1, trials)), self._stairs.inward(x)[:, None, :], *nothing))

    def follow(self, slots: range, belief: Belief, gamma: Flags, z: Floats) -> tuple[Beliefs, Belief]:
        """Predict every component, weight it by the packet and add the packet's own; returns common means and covariances."""
        mixture, parts, stairs = belief.memory, [], self._stairs
        z = stairs.inward(z)
        for some in equal_slots(self._mu_d, slots):
            rows = slice(some.start - slots.start, some.stop - slots.start)
            x_hat, P, action, *parted = kernels.follow_mixture(
                stairs.process.A,
                stairs.process.noise_factor,
                self._leaks.block(some),
                self._leaks.rounding(some),
                mixture,
                gamma[rows],
                z[rows],
                in_slot(self._mu_d, some.start),
                self._capacity,
                some.start == 0,
            )
            mixture = Mixture(*parted)
            parts.append(Beliefs(stairs.outward(x_hat), stairs.outward_covariance(P), action))
        beliefs = Beliefs.joined(parts)
        return beliefs, beliefs.last._replace(memory=mixture)
