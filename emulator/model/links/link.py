"""What a link model is: from random numbers to the fate of every packet. The router only carries fates out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from emulator.model.process import Floats
from emulator.model.receiver import Codes, Flags
from emulator.streams import Batch, BlockReader


class Fate(IntEnum):
    """What becomes of a packet on a link."""

    DELIVERED = 0
    LOST = 1
    """Erased by the link's loss model."""


def losses(fates: Codes) -> dict[str, NDArray[np.uint32]]:
    """Reason → packets lost for it in each slot, (slots,), from fates (slots, R)."""
    reasons = [reason for reason in Fate if reason is not Fate.DELIVERED]
    return {reason.name.lower(): np.asarray((fates == reason).sum(axis=1), np.uint32) for reason in reasons}


def fates_of(lost: Flags) -> Codes:
    """`Fate` codes from what is lost."""
    codes: Codes = lost.view(np.uint8)
    return codes


@dataclass(frozen=True)
class Chain:
    """A Markov chain of link states, at slot 0 in its stationary law."""

    transitions: Floats
    """Row: from, column: to, (states, states)."""
    law: Floats
    """Stationary, (states,)."""
    quality: Floats
    """Probability that a packet is delivered in each state, (states,)."""

    @property
    def independent(self) -> bool:
        """Whether every packet's fate is independent of all others' and alike: a single state, as in the paper."""
        return len(self.law) == 1


class LossModel(ABC):
    """Decides fates from uniform numbers, for all trials at once, slot after slot.

    A file of this folder holds one model, and its name in a scenario is that of the file. `parameters` are the entries
    that the scenario gives it, each with an example.
    """

    parameters: ClassVar[Mapping[str, Any]]
    optional: ClassVar[frozenset[str]] = frozenset()
    uniforms_per_slot: int = 1

    @classmethod
    @abstractmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """What is wrong with parameters that are all known, if not all there: (entry, what was found and expected)."""

    @property
    @abstractmethod
    def quality(self) -> float:
        """Mean probability that a packet is delivered."""

    @property
    def chain(self) -> Chain | None:
        """The Markov chain that the losses follow, from which theory can reckon; None if there is none."""
        return None

    @abstractmethod
    def fates(self, first: int, uniforms: Floats) -> Codes:
        """`Fate` of each packet of the next slots, (slots, R), from uniforms (slots, uniforms_per_slot, R).

        first: the first of the slots, which follow on those of the call before.
        """


class Link:
    """The way from the router to one receiver: a loss model and its own random stream.

    Final. Must be read in order, any number of slots at a time.
    """

    def __init__(self, loss: LossModel, key: bytes, batch: Batch) -> None:
        self._loss = loss
        self._reader = BlockReader(key, batch, loss.uniforms_per_slot)

    def fates(self, slots: range) -> Codes:
        """`Fate` of the packets of the next slots in every trial, (slots, R)."""
        return self._loss.fates(slots.start, self._reader.uniforms(slots))
