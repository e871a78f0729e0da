"""The eavesdropper that learns by expectation-maximisation: it knows the mechanism, but neither the process nor μ_d.

It climbs over all slots that it has kept, from several starts at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evedrop.model.checks import whole_number_mistakes
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.eavesdroppers.learner import (
    Known,
    Learner,
    LearnerPosterior,
    Moments,
    Parameters,
    advanced,
    knowing_mistakes,
    scale_of,
    unheard,
)
from evedrop.model.kernels.factored import covariance
from evedrop.model.kernels.mixtures import moments as moments_of
from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Codes, Flags, Reception, read_actions
from evedrop.model.streams import Batch

PASSES = 8
"""Passes over the slots that were kept, whenever they are gone through."""
NARROW = (0.1, 0.01, 1e-4)
"""The starts' Q, over the variance of the first packets, each with A = I."""


class Learned(NamedTuple):
    """The result of a climb."""

    posterior: LearnerPosterior
    theta: Parameters
    moments: Moments
    scale: Floats
    """(R,)."""


def climbed(given: Known, first: int, gamma: Flags, z: Floats, so_far: Parameters | None) -> Learned:
    """The most likely parameters for slots from `first` on, gamma (c, R) and z (c, n, R), 0 where nothing was received.

    so_far: the parameters that were found from fewer slots, which are one more start.
    """
    scale = scale_of(gamma, z)
    # The regression that takes every packet for the state: its A has the right direction, and is too small.
    start = given.start(scale)
    every = start._replace(mu_d=np.ones_like(scale))
    _, moments, _ = _passed(given, every, first, gamma, z, scale)
    regression = moments.most_likely(every, scale, given.names)[1]._replace(mu_d=start.mu_d)
    starts = [regression, *(given.start(fraction * scale) for fraction in NARROW), *([so_far] if so_far else [])]
    several, trials = len(starts), len(scale)
    theta = Parameters(*(np.concatenate(parts, axis=-1) for parts in zip(*starts, strict=True)))
    gamma, z, scales = (np.concatenate([part] * several, axis=-1) for part in (gamma, z, scale))
    for _ in range(PASSES):
        posterior, moments, evidence = _passed(given, theta, first, gamma, z, scales)
        moments, theta = moments.most_likely(theta, scales, given.names)
    best = np.argmax(evidence.reshape(several, trials), axis=0) * trials + np.arange(trials)
    return Learned(
        LearnerPosterior(*(part[..., best] for part in posterior)),
        Parameters(*(part[..., best] for part in theta)),
        Moments(*(part[..., best] for part in moments)),
        scale,
    )


def _passed(
    given: Known, theta: Parameters, first: int, gamma: Flags, z: Floats, scale: Floats
) -> tuple[LearnerPosterior, Moments, Floats]:
    """The posterior after the slots from `first` on, the moments of their transitions, and the logarithm of their density."""
    posterior, moments = unheard(given, scale), Moments.imagined(theta.A, scale)
    evidence = np.zeros(len(scale))
    for k, (heard, packet) in enumerate(zip(gamma, z, strict=True), first):
        posterior, _, density, last = advanced(k, given, theta, posterior, heard, packet)
        evidence = evidence + density
        if k:
            moments = moments.added(theta.A, packet, heard.astype(np.float64), last)
    return posterior, moments, evidence


_MOST_SLOTS = 4096
_EACH = 8  # slots for each state before the first climb


class Memory(NamedTuple):
    """`Belief.memory`."""

    learned: Learned
    largest: Floats
    """The largest |z| of every state so far, (n, R)."""
    first: NDArray[np.int64]
    """The first slot that it listened to, (1, R)."""
    gamma: Flags
    """The slots that it keeps, (c, R)."""
    z: Floats
    """(c, n, R), 0 where nothing was received."""

    def stored(self) -> tuple[NDArray[Any], ...]:
        """The arrays one after the other."""
        posterior, theta, moments, scale = self.learned
        return (*posterior, *theta, *moments, scale, *self[1:])

    @classmethod
    def read(cls, stored: tuple[NDArray[Any], ...]) -> Memory:
        """The memory of these arrays."""
        a, b, c = 7, 11, 18
        learned = Learned(LearnerPosterior(*stored[:a]), Parameters(*stored[a:b]), Moments(*stored[b:c]), stored[c])
        return cls(learned, *stored[c + 1 :])


class LearningEm(Learner):
    """Learns A, Q, μ_d and Σ_k from its own packets, and weighs packets by what it has learned.

    parameters: `knows`, names of what it is given; `keeps`, the slots that it keeps to go through again.
    """

    parameters = MappingProxyType({"knows": [], "keeps": 64})

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._keeps = int(knowledge.parameters["keeps"])
        self._climbs = climbing_slots(knowledge.process.n, self._keeps)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Names that are known, and a number of slots."""
        return knowing_mistakes(given) + whole_number_mistakes(given, "keeps", _EACH, _MOST_SLOTS, "slots")

    def prior(self, first: int = 0) -> Belief:
        """x̂ = 0, and the covariance I for want of Σ0."""
        n, trials = self.process.n, self.trials
        ones, posterior = np.ones(trials), unheard(self.known, np.ones(trials))
        theta = self.known.start(ones)
        learned = Learned(posterior, theta, Moments.imagined(theta.A, ones), ones)
        none = np.zeros((0, trials), np.bool_), np.zeros((0, n, trials))
        memory = Memory(learned, np.zeros((n, trials)), np.full((1, trials), first), *none)
        return self._belief_of(np.zeros(trials, np.uint8), memory)

    def knowing(self, k: int, x: Floats, belief: Belief) -> Belief:
        """One component with covariance 0; its parameters stay."""
        memory = Memory.read(belief.memory)
        posterior = memory.learned.posterior.knowing(x)
        after = super().knowing(k, x, belief)
        return after._replace(memory=memory._replace(learned=memory.learned._replace(posterior=posterior)).stored())

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Weigh the packet by the parameters so far, and learn from it."""
        memory, gamma = Memory.read(belief.memory), heard.gamma
        z = np.where(gamma, heard.z, 0.0)
        first, learned = int(memory.first.flat[0]), memory.learned
        age = k - first + 1
        if age <= self._keeps and not self.known.everything:
            memory = memory._replace(
                gamma=np.concatenate([memory.gamma, gamma[None]]), z=np.concatenate([memory.z, z[None]])
            )
        if age in self._climbs and not self.known.everything:
            so_far = learned.theta if age > self._climbs[0] else None
            state = advanced(k, self.known, learned.theta, learned.posterior, gamma, z).state
            learned = climbed(self.known, first, memory.gamma, memory.z, so_far)
        else:
            learned, state = self._small_step(k, learned, gamma, z, age)
        action = read_actions(gamma, state > 0.5)
        return self._belief_of(action, memory._replace(learned=learned, largest=np.maximum(memory.largest, np.abs(z))))

    def learned(self, belief: Belief) -> Mapping[str, Floats]:
        """Its estimates."""
        theta = Memory.read(belief.memory).learned.theta
        return {"A": theta.A, "Q": covariance(theta.noise), "mu_d": theta.mu_d}

    def _belief_of(self, action: Codes, memory: Memory) -> Belief:
        """The mean and covariance of the posterior, made smaller where they are out of all proportion to the packets."""
        x_hat, P = moments_of(memory.learned.posterior.mixture)
        x_hat, P = self.in_proportion(x_hat, P, memory.largest)
        return Belief(x_hat, P, action, memory.stored())

    def _small_step(self, k: int, learned: Learned, gamma: Flags, z: Floats, age: int) -> tuple[Learned, Floats]:
        """What is known after a slot, and the probability that its packet is the state."""
        posterior, theta, moments, scale = learned
        after = advanced(k, self.known, theta, posterior, gamma, z)
        if age < self._climbs[0]:
            scale = np.where((posterior.packets == 0.0) & gamma, scale_of(gamma[None], z[None]), scale)
            theta = self.known.start(NARROW[0] * scale)
        elif not self.known.everything:
            fraction = np.where(gamma, 1.0 - 1.0 / (age + 1.0), 1.0)
            moments = moments.faded(fraction).added(theta.A, z, gamma.astype(np.float64), after.last)
            moments, theta = moments.most_likely(theta, scale, self.known.names)
        return Learned(after.posterior, theta, moments, scale), after.state


def climbing_slots(n: int, keeps: int) -> list[int]:
    """The numbers of slots after which all of them are gone through again."""
    age = _EACH
    while age < _EACH * n:
        age *= 2
    ages = [min(age, keeps)]
    while 2 * ages[-1] <= keeps:
        ages.append(2 * ages[-1])
    return ages
