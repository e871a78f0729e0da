"""Eavesdroppers that decide every packet's type at once by a test, and never revise it.

The likelihood eavesdropper decides by a likelihood ratio; `power-test` tells noise from states by the size of a packet alone.
"""

from __future__ import annotations

import numpy as np

from evedrop.model import update
from evedrop.model.eavesdroppers.eavesdropper import Knowledge, PacketReader
from evedrop.model.kernels.elementary import cholesky, log
from evedrop.model.kernels.factored import Factor, Factors, covariance, grown, squared_length
from evedrop.model.process import Floats
from evedrop.model.receiver import Action, Belief, Flags, Reception, read_actions
from evedrop.model.schedule import PACKETS, NoiseDistribution, in_slot
from evedrop.model.streams import Batch
from evedrop.model.theory.leak import Leaks

# A packet in the range of a singular covariance is the state, unless it is 20 standard deviations away.
_NO_VARIANCE = 1e-300


class Likelihood(PacketReader):
    """A packet is the state if μ_d(k) N(z; A x̂, A P Aᵀ + Q) > (1−μ_d(k)) N(z; 0, Σ_k), and otherwise an innovation.

    `Belief.memory` is P's factors, (n (n−1)/2, R) and (n, R).
    """

    only_against = (
        ("innovation", "noise"),
        "tests states against innovations, and there are none: it is the same as naive here",
    )
    reads_leaks = tests_range = True

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._mu_d = knowledge.mu_d
        self._leaks = Leaks(knowledge.process, knowledge.noise_distribution)
        self._stairs = self._leaks.stairs
        self._noise = Factor.of_triangular(self._stairs.process.noise_factor.tolist())

    def prior(self, first: int = 0) -> Belief:
        """The belief without any reception."""
        belief = super().prior(first)
        factor = Factor.of_triangular(cholesky(self._stairs.inward_covariance(belief.P[:, :, :1])[:, :, 0]).tolist())
        return belief._replace(memory=Factors.alike(factor, (self.trials,)))

    def knowing(self, k: int, x: Floats, belief: Belief) -> Belief:
        """A track without error."""
        n, trials = x.shape
        nothing = np.zeros((n * (n - 1) // 2, trials)), np.zeros((n, trials))
        return super().knowing(k, x, belief)._replace(memory=nothing)

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """(A x̂, A P Aᵀ + Q) if lost, (z, 0) for a state, (A x̂ + QΣ⁻¹z, A P Aᵀ + Q − QΣ⁻¹Q) for an innovation."""
        gamma, received, stairs = heard.gamma, np.where(heard.gamma, heard.z, 0.0), self._stairs
        z, x_hat = stairs.inward(received), stairs.inward(belief.x_hat)
        P, state = Factors(*belief.memory), gamma
        if k:
            leak = self._leaks.at(k)
            white, x_hat = leak.white(z), stairs.process.predict(x_hat)
            predicted, informed = grown(stairs.process.A, P, self._noise, leak.remaining_factor)
            state = gamma & self._is_state(k, z - x_hat, predicted, white)
            innovation = gamma & ~state
            x_hat = np.where(innovation, x_hat + leak.innovation(white), x_hat)
            P = Factors(*(np.where(innovation, *pair) for pair in zip(informed, predicted, strict=True)))
        P = Factors(np.where(state, 0.0, P.lower), np.where(state, 0.0, P.diagonal))
        action = read_actions(gamma, state)
        estimate = np.where(state, received, stairs.outward(x_hat))
        return Belief(estimate, stairs.outward_covariance(covariance(P)), action, P)

    def _is_state(self, k: int, d: Floats, P: Factors, white: Floats) -> Flags:
        mu_d = in_slot(self._mu_d, k)
        if mu_d in {0.0, 1.0}:
            return np.full(self.trials, mu_d == 1.0)
        odds = mu_d / (1.0 - mu_d)
        seen = P.rounded(self._leaks.rounding(range(k, k + 1))[0])
        evidence = -squared_length(seen, d)
        diagonal = np.where(P.diagonal > 0.0, seen.diagonal, _NO_VARIANCE)
        for row, D, state in zip(white, diagonal, self._leaks.at(k).state_diagonal, strict=True):
            evidence = evidence + row * row - log(D / state)
        return evidence > -2.0 * float(log(np.array([odds]))[0])


class PowerTest(PacketReader):
    """A packet is the state if μ_d N(z; 0, Σ_k) > (1−μ_d) N(z; 0, N_k), whatever came before; otherwise it is ignored.

    It unmasks noise whose covariance is not that of the states. Where the two are equal it uses all packets if μ_d > ½, and
    otherwise none.
    """

    only_against = ("noise", "compares the power of noise packets with that of states, and there are no noise packets")
    reads_leaks = True

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._mu_d = knowledge.mu_d
        states = NoiseDistribution(PACKETS)
        self._states = Leaks(knowledge.process, states)
        self._noise = Leaks(knowledge.process, knowledge.noise_distribution or states)

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """(A x̂, A P Aᵀ + Q), or (z, 0) where the packet passes the test."""
        used = heard.gamma
        if k:
            used = used & self._passes(k, np.where(heard.gamma, heard.z, 0.0))
        unused = np.where(heard.gamma, np.uint8(Action.DISCARDED), np.uint8(Action.LOST))
        return update.belief(self.process, k, belief, np.where(used, np.uint8(Action.STATE), unused), heard.z)

    def _passes(self, k: int, z: Floats) -> Flags:
        mu_d = in_slot(self._mu_d, k)
        if mu_d in {0.0, 1.0}:
            return np.full(self.trials, mu_d == 1.0)
        states, noise, z = self._states.at(k), self._noise.at(k), self._states.stairs.inward(z)
        evidence = np.full(self.trials, 2.0 * float(log(np.array([mu_d / (1.0 - mu_d)]))[0]))
        for a, b in zip(noise.white(z), states.white(z), strict=True):
            evidence = evidence + (a * a - b * b)
        ratios = zip(noise.state_diagonal, states.state_diagonal, strict=True)
        for first, second in ratios:
            evidence = evidence + log(np.array([first / second]))
        return evidence > 0.0
