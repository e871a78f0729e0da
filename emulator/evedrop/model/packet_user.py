"""Receivers that use a packet as the state or ignore it (the paper's eavesdroppers), and those that read a state from each."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from evedrop.model import update
from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Beliefs, Codes, Flags, Receiver, Reception, complete, needed, outdated


def _use_one(uses_block: Callable[..., Flags | None]) -> Callable[..., Flags | None]:
    def uses(self: PacketUser, k: int) -> Flags | None:
        uses = uses_block(self, range(k, k + 1))
        return None if uses is None else uses[0]

    return uses


class PacketUser(Receiver):
    """Its covariance is its own belief; where it used an innovation as the state, the actual covariance differs.

    Source: Lemma V.1; docs/mathematics/eavesdroppers.md, eavesdroppers.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Complete `uses_block` and `uses`.

        A subclass that changes `uses` takes `follow` from `Receiver` again, where it inherits one that may not ask `uses_block`.
        """
        super().__init_subclass__(**options)
        complete(cls, PacketUser, "uses_block", "uses", _use_one)
        if outdated(cls, "follow", "uses") and cls.follow is not PacketUser.follow:
            setattr(cls, "follow", Receiver.follow)  # noqa: B010 - mypy refuses the assignment

    @needed
    def uses(self, k: int) -> Flags | None:
        """b_k (R,): whether a packet received in slot k is used as the state; None means always."""
        raise NotImplementedError

    def act(self, k: int, gamma: Flags) -> Codes:
        """Lost, used as the state, or discarded."""
        return _actions(gamma, self.uses(k))

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """A x̂ and A P Aᵀ + Q, or z and 0 where a packet is used."""
        action = self.act(k, heard.gamma)
        return update.belief(self.process, k, belief, action, heard.z)

    def uses_block(self, slots: range) -> Flags | None:
        """`uses` of consecutive slots, (c, R); None means always in all of them."""
        uses = [self.uses(k) for k in slots]
        if all(flags is None for flags in uses):
            return None
        return np.array([np.ones(self.trials, np.bool_) if flags is None else flags for flags in uses])

    def follow(self, slots: range, belief: Belief, gamma: Flags, z: Floats) -> tuple[Beliefs, Belief]:
        """`step` for consecutive slots."""
        action = _actions(gamma, self.uses_block(slots))
        beliefs = update.beliefs(self.process, slots.start, belief, action, z)
        return beliefs, beliefs.last


class StateReader(Receiver):
    """Reads the state from every packet that it receives."""

    @abstractmethod
    def read(self, k: int, heard: Reception) -> Floats:
        """The states of slot k as they are read from its packets, (n, R); without meaning where none was received."""

    def act(self, k: int, gamma: Flags) -> Codes:  # noqa: ARG002 - every slot alike
        """The state where a packet arrives: the codes 0 and 1 of `Action` are γ itself."""
        return gamma.astype(np.uint8)

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """(A x̂, A P Aᵀ + Q) if lost, otherwise (the state, 0)."""
        return update.belief(self.process, k, belief, self.act(k, heard.gamma), self.read(k, heard))


def _actions(gamma: Flags, uses: Flags | None) -> Codes:
    """LOST, STATE or DISCARDED, the codes 0, 1 and 3, from flags of any equal shape."""
    if uses is None:
        return gamma.astype(np.uint8)
    received = gamma.view(np.uint8)
    return 3 * received - 2 * (gamma & uses).view(np.uint8)
