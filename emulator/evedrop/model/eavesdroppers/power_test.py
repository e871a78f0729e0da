"""The eavesdropper `power-test`: tells noise from states by the size of a packet alone.

Source: docs/mathematics.md, noise packets.
"""

from __future__ import annotations

import numpy as np

from evedrop.model import update
from evedrop.model.eavesdroppers.eavesdropper import Knowledge, PacketReader
from evedrop.model.kernels.elementary import log
from evedrop.model.noise_distribution import PACKETS, NoiseDistribution
from evedrop.model.process import Floats
from evedrop.model.receiver import Action, Belief, Flags, Reception
from evedrop.model.schedule import in_slot
from evedrop.model.streams import Batch
from evedrop.model.theory.leak import Leaks


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
        for one, other in ratios:
            evidence = evidence + log(np.array([one / other]))
        flags: Flags = evidence > 0.0
        return flags
