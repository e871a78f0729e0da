"""Which acknowledgements reach the sensor: over a lossy way back, and past a jammer that also hears the packets.

Source: docs/mathematics.md, attacks on acknowledgements.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np

from evedrop.model.receiver import Flags
from evedrop.streams import Ahead, Batch, BlockReader

Attack = Callable[[Flags, Flags, Flags], Flags]
"""(γ of the user, γᵉ of the jammer, whether the attacker flips) → the acknowledgements on the air, all (R,)."""


def _none(gamma: Flags, gamma_e: Flags, flips: Flags) -> Flags:  # noqa: ARG001 - what the jammer hears does not matter
    return gamma


def _block_all(gamma: Flags, gamma_e: Flags, flips: Flags) -> Flags:  # noqa: ARG001 - the same
    return np.zeros_like(gamma)


def _block_critical(gamma: Flags, gamma_e: Flags, flips: Flags) -> Flags:  # noqa: ARG001 - the same
    return gamma & gamma_e


def _forge(gamma: Flags, gamma_e: Flags, flips: Flags) -> Flags:  # noqa: ARG001 - the same
    return np.ones_like(gamma)


def _flip(gamma: Flags, gamma_e: Flags, flips: Flags) -> Flags:  # noqa: ARG001 - the same
    return gamma ^ flips


ATTACKS: Mapping[str, Attack] = {
    "none": _none,
    "all": _block_all,
    "critical": _block_critical,
    "forge": _forge,
    "flip": _flip,
    "hijack": _none,
}
"""critical blocks acknowledgements where γ = 1 and γᵉ = 0; forge sends one in the user's name where γ = 0; flip does either.

hijack leaves them as they are, and decides by γᵉ which ones the sensor heeds: see `heeded_shares`.
"""
OVERHEARING = frozenset({"critical", "hijack"})
"""The attacks that depend on what a jammer hears."""
FORGING = frozenset({"forge", "flip"})
"""The attacks that make a reference of a packet that the user has not heard."""


def heeded_shares(attack: str, quality: float, overheard: float) -> tuple[float, float]:
    """The shares of acknowledgements that the sensor heeds: of packets that the jammer heard, and of those that it missed.

    Both are `quality`, but for a hijacked sensor. It heeds as many in all, and those of packets that the jammer, which hears a
    packet with the probability `overheard`, has heard first: (min(1, α/μ_e), max(0, (α − μ_e)/(1 − μ_e))).

    Source: Lu, Quevedo, Gupta, Dey (2020); docs/mathematics.md, the hijacked sensor.
    """
    if attack != "hijack":
        return quality, quality
    if quality <= overheard:
        return (quality / overheard if overheard else 0.0), 0.0
    return 1.0, (quality - overheard) / (1.0 - overheard)


@dataclass(frozen=True)
class WayBackSpec:
    """The way back as the router needs to know it."""

    quality: float
    attack: str
    jammer: str | None
    spans: Sequence[Sequence[int]] | None
    """Slots [from, to) in which the attack is on; None: in all slots."""
    flip: float = 0.0
    """The probability of a flip, for the attack `flip`."""
    overheard: float = 1.0
    """The probability that the jammer hears a packet, for the attack `hijack`."""


@final
class AckChannel:
    """Acknowledgements from user to sensor: each that is on the air arrives with probability `quality`.

    spans: slots [from, to) in which the attack is on; None: in all slots. flip: the probability of a flip; overheard: that the
    jammer hears a packet.
    """

    def __init__(
        self,
        attack: str,
        quality: float,
        key: bytes,
        batch: Batch,
        spans: Sequence[Sequence[int]] | None = None,
        flip: float = 0.0,
        overheard: float = 1.0,
    ) -> None:
        self._attack = ATTACKS[attack]
        self._spans = spans
        # The first of two words is that of a reader of one.
        reader = BlockReader(key, batch, 2)
        words, limits = [0, 1, 0, 0], np.array([quality, flip, *heeded_shares(attack, quality, overheard)])[:, None]
        self._drawn = Ahead(reader.ahead, lambda slots: reader.uniforms(slots)[:, words] < limits)

    @classmethod
    def of(cls, spec: WayBackSpec, key: bytes, batch: Batch) -> AckChannel:
        """The channel of a way back."""
        return cls(spec.attack, spec.quality, key, batch, spec.spans, spec.flip, spec.overheard)

    def arrived(self, k: int, sent: Flags | None, gamma: Flags, gamma_e: Flags) -> Flags:
        """The acknowledgements of slot k that reach the sensor, (R,).

        sent: `Packet.sent`; a packet that was not sent is never acknowledged, even by a forger. gamma: what the user received;
        gamma_e: what the jammer received.
        """
        attacked = self._spans is None or any(start <= k < stop for start, stop in self._spans)
        through, flips, heeded, heeded_missed = self._drawn.at(k)
        arrived: Flags = gamma & through
        if attacked:
            arrived = self._attack(gamma, gamma_e, flips) & np.where(gamma_e, heeded, heeded_missed)
        return arrived if sent is None else arrived & sent


class AcknowledgementRates(NamedTuple):
    """Probabilities, for a packet that is sent."""

    arrives: float
    """Probability that an acknowledgement of it reaches the sensor."""
    user: tuple[float, float]
    """The same jointly with the user having received the packet, and having missed it (forged)."""
    eavesdropper: tuple[float, float]
    """The same jointly with the jammer having received the packet, and having missed it (critical or forged)."""


def rates_of(attack: str, mu: float, mu_e: float, quality: float = 1.0, flip: float = 0.0) -> AcknowledgementRates:
    """The rates under an attack, for independent links of qualities μ and μ_e and an independent way back.

    flip: the probability of a flip.

    Source: docs/mathematics.md, attacks on acknowledgements.
    """
    gamma, gamma_e, flips = (np.arange(8) >> bit & 1 == 0 for bit in range(3))
    chances = np.where(gamma, mu, 1.0 - mu) * np.where(gamma_e, mu_e, 1.0 - mu_e) * np.where(flips, flip, 1.0 - flip)
    heeded = np.where(gamma_e, *heeded_shares(attack, quality, mu_e))
    arrives = heeded * chances * ATTACKS[attack](gamma, gamma_e, flips)

    def split(heard: Flags) -> tuple[float, float]:
        return float(arrives[heard].sum()), float(arrives[~heard].sum())

    return AcknowledgementRates(float(arrives.sum()), split(gamma), split(gamma_e))
