"""Receivers that use a packet as the state or ignore it: the paper's class of eavesdroppers."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from evedrop.model import update
from evedrop.model.receiver import Action, Belief, Codes, Flags, Receiver, Reception

_ACTIONS = np.array([Action.LOST, Action.DISCARDED, Action.STATE], np.uint8)


class PacketUser(Receiver):
    """Its covariance is its own belief; where it used an innovation as the state, the actual covariance differs.

    Source: Lemma V.1; docs/mathematics.md, eavesdroppers.
    """

    @abstractmethod
    def uses(self, k: int) -> Flags | None:
        """b_k (R,): whether a packet received in slot k is used as the state; None means always."""

    def act(self, k: int, gamma: Flags) -> Codes:
        """Lost, used as the state, or discarded."""
        uses = self.uses(k)
        used = gamma if uses is None else gamma & uses
        return _ACTIONS[gamma.view(np.uint8) + used.view(np.uint8)]

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """A x̂ and A P Aᵀ + Q, or z and 0 where a packet is used."""
        action = self.act(k, heard.gamma)
        return Belief(
            update.estimate(self.process, k, belief.x_hat, action, heard.z),
            update.believed_covariance(self.process, k, belief.P, action),
            action,
        )
