"""The base of every receiver: its belief, its action in a slot, and the prediction between packets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats, Process

Flags = NDArray[np.bool_]
Codes = NDArray[np.uint8]


class Action(IntEnum):
    """What a receiver did in a slot, as far as the receiver knows."""

    LOST = 0
    """Nothing was received: γ = 0."""
    STATE = 1
    """The packet was used as the state."""
    INNOVATION = 2
    """The packet was read as an innovation: decoded with the secret, or used without it for the little that it leaks."""
    DISCARDED = 3
    """The packet was received and not used."""


class Reception(NamedTuple):
    """What a receiver heard in a slot, for R trials."""

    gamma: Flags
    """γ_k: received or not, (R,)."""
    z: Floats
    """The packets, (n, R); undefined where nothing was received."""
    header: NDArray[np.int64] | None = None
    """The unencrypted header that the scheme sends with each packet, (h, R); None for a scheme without a header."""
    truth: Floats | None = None
    """x_k itself, (n, R), in the one slot whose state is betrayed to this receiver, received or not; otherwise None."""


class Belief(NamedTuple):
    """A receiver's knowledge after a slot, for R trials. Immutable: a slot makes a new one."""

    x_hat: Floats
    """Estimate, (n, R)."""
    P: Floats
    """Error covariance the receiver believes, (n, n, R)."""
    action: Codes
    """`Action` of the slot, (R,)."""
    memory: tuple[NDArray[Any], ...] = ()
    """Further knowledge of a receiver: arrays whose last axis is the trials."""


def select(flags: Flags, yes: Callable[[], Floats], no: Callable[[], Floats]) -> Floats:
    """`yes()` in the trials where flags (R,) is true, `no()` in the others; neither is called without need."""
    count = np.count_nonzero(flags)
    if count == flags.size:
        return yes()
    if count == 0:
        return no()
    return np.where(flags, yes(), no())


def cleared(flags: Flags, shape: tuple[int, ...], value: Callable[[], Floats]) -> Floats:
    """0 in the trials where flags (R,) is true, `value()`, with shape (…, R), in the others."""
    count = np.count_nonzero(flags)
    if count == flags.size:
        return np.zeros(shape)
    return np.where(flags, 0.0, value()) if count else value()


def trace_of(P: Floats) -> Floats:
    """Tr P of every trial: P (n, n, R) → (R,)."""
    trace: Floats = P[0, 0].copy()
    for i in range(1, P.shape[0]):
        trace += P[i, i]
    return trace


def prior(process: Process, trials: int, first: int = 0) -> Belief:
    """Belief of a receiver before slot `first` if it has heard nothing: x̂ = 0, P = Σ_{first−1}, and Σ0 before slot 0.

    Source: docs/mathematics.md, legitimate estimator.
    """
    sigma = process.initial_covariance[:, :, None]
    for _ in range(first - 1):
        sigma = process.diffuse(process.carry(sigma))
    return Belief(np.zeros((process.n, trials)), np.repeat(sigma, trials, axis=2), np.zeros(trials, np.uint8))


class Receiver(ABC):
    """Turns deliveries into beliefs, slot by slot. It keeps no state except what its secret streams read ahead."""

    def __init__(self, process: Process, trials: int) -> None:
        self.process = process
        self.trials = trials

    def prior(self, first: int = 0) -> Belief:
        """Belief of this receiver before slot `first` if it has heard nothing."""
        return prior(self.process, self.trials, first)

    @abstractmethod
    def act(self, k: int, gamma: Flags) -> Codes:
        """`Action` of slot k in every trial, (R,), from γ (R,) alone: no scheme of this kind looks at the packet first."""

    @abstractmethod
    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Belief after slot k, from the belief before it and the reception in it. Any slot may be asked for again."""
