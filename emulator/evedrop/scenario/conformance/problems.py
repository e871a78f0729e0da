"""Small problems on which classes are checked: a process, slots, trials, and the packets that are heard."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from evedrop.model.process import Process
from evedrop.model.receiver import Flags
from evedrop.model.streams import Batch, BlockReader
from evedrop.scenario.conformance.rules import key

QUALITY = 0.7
"""The link quality of every problem."""


@dataclass(frozen=True)
class Problem:
    """One small problem."""

    process: Process
    batch: Batch

    def __str__(self) -> str:
        states = "1 state" if self.process.n == 1 else f"{self.process.n} states"
        return f"{states}, spectral radius {self.process.spectral_radius:.2g}, {self.batch.trials} trials"

    def part(self, first: int, trials: int) -> Problem:
        """The problem with only some of its trials; first: counted from the problem's own first trial."""
        return replace(self, batch=Batch(self.batch.slots, trials, self.batch.first_trial + first))

    @property
    def slots(self) -> int:
        """The number of slots."""
        return self.batch.slots

    def coins(self, name: str, quality: float = QUALITY) -> Flags:
        """True with this probability in every slot and trial, (slots, R), independently of which other trials there are."""
        reader = BlockReader(key(f"coins/{name}"), self.batch, 1)
        return np.asarray(reader.uniforms(range(self.slots))[:, 0, :] < quality)

    @cached_property
    def gamma(self) -> Flags:
        """Whether the receiver hears the packet of each slot, (slots, R)."""
        return self.coins("gamma")


def _process(number: int, n: int, radius: float) -> Process:
    """A random process of n states whose A has this spectral radius."""
    random = np.random.default_rng(number)
    A = random.normal(size=(n, n))
    A *= radius / np.max(np.abs(np.linalg.eigvals(A)))
    root, start = random.normal(size=(2, n, n))
    return Process(A, 0.1 * (root @ root.T) + 0.05 * np.eye(n), start @ start.T + 0.2 * np.eye(n))


def small(slots: int = 0) -> list[Problem]:
    """Problems of 1 to 3 states with decaying, constant and growing processes, with at least `slots` slots.

    The last one crosses the ends of blocks in which streams are read ahead, and its trials have large numbers.
    """
    shapes = ((1, 0.8, 9, 4, 0), (2, 1.0, 12, 5, 3), (3, 1.1, 10, 3, 1000), (1, 0.95, 260, 2, 2**40))
    return [
        Problem(_process(number, n, radius), Batch(max(least, slots), trials, first))
        for number, (n, radius, least, trials, first) in enumerate(shapes)
    ]


def large() -> list[Problem]:
    """Problems with many trials, for statements about means."""
    return [Problem(_process(number, n, 0.9), Batch(10, 600)) for number, n in ((10, 1), (11, 2))]
