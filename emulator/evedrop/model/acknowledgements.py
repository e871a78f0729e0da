"""What the sensor learns from acknowledgements, over a lossy channel and past a jammer that also hears the packets.

From them follows the holding time: the time since the legitimate estimator last had the state, as far as the sensor knows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.checks import expect_slots, is_probability
from evedrop.model.receiver import Codes, Flags
from evedrop.model.streams import Ahead, Batch, BlockReader

Attack = Callable[[Flags, Flags, Flags], Flags]
"""(γ of the legitimate estimator, γᵉ of the jammer, whether the attacker flips) → the acknowledgements on the air, all (R,)."""


ATTACKS: Mapping[str, Attack] = {
    "none": lambda gamma, _heard, _flips: gamma,
    "all": lambda gamma, _heard, _flips: np.zeros_like(gamma),
    "critical": lambda gamma, gamma_e, _flips: gamma & gamma_e,
    "forge": lambda gamma, _heard, _flips: np.ones_like(gamma),
    "flip": lambda gamma, _heard, flips: gamma ^ flips,
    "hijack": lambda gamma, _heard, _flips: gamma,
}
"""critical blocks acknowledgements where γ = 1 and γᵉ = 0; forge sends one in the estimator's name where γ = 0; flip does either.

hijack leaves them as they are, and decides which ones the sensor heeds: see `HeedRule`.
"""
OVERHEARING = frozenset({"critical", "hijack"})
"""The attacks that depend on what a jammer hears."""
FORGING = frozenset({"forge", "flip"})
"""The attacks that make a reference of a packet that the legitimate estimator has not heard."""


class AckFate(IntEnum):
    """What became of the acknowledgement of a packet."""

    NONE = 0
    """The legitimate estimator acknowledged nothing."""
    ARRIVED = 1
    """It reached the sensor, which heeded it."""
    LOST = 2
    """It was lost on the way."""
    BLOCKED = 3
    """The attacker blocked it."""
    FORGED = 4
    """The attacker sent it in the name of the legitimate estimator, which had not received the packet."""
    IGNORED = 5
    """It came, and the hijacked sensor did not heed it."""


ACTS: Mapping[str, tuple[AckFate, ...]] = {
    "none": (),
    "all": (AckFate.BLOCKED,),
    "critical": (AckFate.BLOCKED,),
    "forge": (AckFate.FORGED,),
    "flip": (AckFate.BLOCKED, AckFate.FORGED),
    "hijack": (AckFate.IGNORED,),
}
"""Attack → the fates that are the attacker's doing."""


class HeedRule(NamedTuple):
    """Which acknowledgements a hijacked sensor heeds, by how many packets in a row its eavesdropper has missed."""

    patience: int
    """Those of packets after fewer misses than this are heeded, those after more are not."""
    fraction: float
    """The fraction that is heeded of those after exactly this many misses."""

    @classmethod
    def of(cls, quality: float, overheard: float) -> HeedRule | None:
        """The rule that heeds a fraction `quality` of all, if the eavesdropper hears packets with the probability `overheard`.

        1 − (1−μ_e)^J (1 − μ_e a) = α, with the patience J and the fraction a. None if there is no choice: where no
        acknowledgement is lost, and where nothing is overheard.

        Source: after Lu, Quevedo, Gupta, Dey (2020); docs/mathematics/attacks.md, the hijacked sensor.
        """
        if quality >= 1.0 or 1.0 - overheard == 1.0:
            return None
        patience = 0 if overheard >= 1.0 else max(0, int(math.log1p(-quality) / math.log1p(-overheard)) - 1)
        # From here on only elementary operations, so that the fraction has the same bits on every machine.
        while _power(1.0 - overheard, patience + 1) > 1.0 - quality:
            patience += 1
        left = _power(1.0 - overheard, patience)
        return cls(patience, min(max((quality - (1.0 - left)) / (overheard * left), 0.0), 1.0))

    def fraction_of(self, missed: int) -> float:
        """The fraction that is heeded after this many misses."""
        return 1.0 if missed < self.patience else self.fraction if missed == self.patience else 0.0


def _power(base: float, exponent: int) -> float:
    """A power by squaring."""
    power = 1.0
    while exponent:
        if exponent & 1:
            power *= base
        base *= base
        exponent >>= 1
    return power


def heed_rule_of(attack: str, quality: float, overheard: float) -> HeedRule | None:
    """What the sensor heeds under an attack; None if it heeds all that reach it."""
    return HeedRule.of(quality, overheard) if attack == "hijack" else None


@dataclass(frozen=True)
class AckChannelSpec:
    """The acknowledgement channel as the router needs to know it."""

    quality: float
    attack: str
    jammer: str | None
    spans: Sequence[tuple[int, int]] | None
    """Slots [from, to) in which the attack is on; None: in all slots."""
    flip: float = 0.0
    """The probability of a flip, for the attack `flip`."""
    overheard: float = 1.0
    """The probability that the jammer hears a packet, for the attack `hijack`."""

    def __post_init__(self) -> None:
        expect_slots(*(slot for span in self.spans or () for slot in span))
        for name in ("quality", "flip", "overheard"):
            if not is_probability(getattr(self, name)):
                raise ValueError(f"{name} is {getattr(self, name)}, expected a number from 0 to 1")

    @property
    def heed_rule(self) -> HeedRule | None:
        """What the sensor heeds under the attack; None if it heeds all that reach it."""
        return heed_rule_of(self.attack, self.quality, self.overheard)

    @property
    def memory(self) -> int:
        """How many packets before its own decide on an acknowledgement: those that the jammer may have missed in a row."""
        rule = self.heed_rule
        return 0 if rule is None else rule.patience


@final
class AckChannel:
    """Acknowledgements from legitimate estimator to sensor: each that is on the air arrives with probability `quality`."""

    def __init__(self, spec: AckChannelSpec, key: bytes, batch: Batch) -> None:
        self._attack = ATTACKS[spec.attack]
        self._spans = spec.spans
        # The first of two words is that of a reader of one.
        reader = BlockReader(key, batch, 2)
        self._heed_rule = spec.heed_rule
        fraction = 0.0 if self._heed_rule is None else self._heed_rule.fraction
        words, limits = [0, 1, 0], np.array([spec.quality, spec.flip, fraction])[:, None]
        self._drawn = Ahead(reader.ahead, lambda slots: reader.uniforms(slots)[:, words] < limits)
        self._missed: NDArray[np.int64] = np.zeros(batch.trials, np.int64)
        self._counted = -1

    def arrived(self, k: int, sent: Flags | None, gamma: Flags, gamma_e: Flags) -> Flags:
        """The acknowledgements of slot k that reach the sensor, (R,).

        sent: `Packet.sent`; a packet that was not sent is never acknowledged, even if forged. gamma: what the estimator received;
        gamma_e: what the jammer received.
        """
        on_the_air, heeded, _ = self._passed(k, sent, gamma, gamma_e)
        arrived: Flags = on_the_air & heeded
        return arrived if sent is None else arrived & sent

    def fates(self, k: int, sent: Flags | None, gamma: Flags, gamma_e: Flags) -> Codes:
        """What becomes of the acknowledgements of slot k, `AckFate`, (R,); in place of `arrived`, with the same arguments."""
        on_the_air, heeded, chosen = self._passed(k, sent, gamma, gamma_e)
        kept = AckFate.IGNORED if chosen else AckFate.LOST
        heard = np.where(on_the_air, np.where(heeded, AckFate.ARRIVED, kept), AckFate.BLOCKED)
        missed = np.where(on_the_air & heeded, AckFate.FORGED, AckFate.NONE)
        fates = np.where(gamma, heard, missed)
        return (fates if sent is None else np.where(sent, fates, AckFate.NONE)).astype(np.uint8)

    def _passed(self, k: int, sent: Flags | None, gamma: Flags, gamma_e: Flags) -> tuple[Flags, Flags, bool]:
        """The acknowledgements on the air, those that the sensor heeds if they are, (R,), and whether it is hijacked."""
        attacked = self._spans is None or any(start <= k < stop for start, stop in self._spans)
        through, flips, shared = self._drawn.at(k)
        on_the_air = self._attack(gamma, gamma_e, flips) if attacked else gamma
        if self._heed_rule is None:
            return on_the_air, through, False
        self.count(k, sent, gamma_e)
        if not attacked:
            return on_the_air, through, False
        few, as_many = self._missed < self._heed_rule.patience, self._missed == self._heed_rule.patience
        return on_the_air, few | (as_many & shared), True

    def count(self, k: int, sent: Flags | None, gamma_e: Flags) -> None:
        """Count the packets in a row that the jammer has missed; arguments as for `arrived`, which counts, too.

        A slot counts once, so this is for slots whose acknowledgements another channel has passed on.
        """
        if k > self._counted:
            self._counted = k
            missed = np.where(gamma_e, 0, self._missed + 1)
            self._missed = missed if sent is None else np.where(sent, missed, self._missed)


class AcknowledgementRates(NamedTuple):
    """Probabilities, for a packet that is sent."""

    arrives: float
    """Probability that an acknowledgement of it reaches the sensor."""
    legitimate: tuple[float, float]
    """The same jointly with the legitimate estimator having received the packet, and having missed it (forged)."""
    eavesdropper: tuple[float, float]
    """The same jointly with the jammer having received the packet, and having missed it (critical or forged)."""


def rates_of(attack: str, mu: float, mu_e: float, quality: float = 1.0, flip: float = 0.0) -> AcknowledgementRates:
    """The rates under an attack, for independent links of qualities μ and μ_e and an independent acknowledgement channel.

    Under `hijack` those of a packet alone: what the sensor heeds then depends on earlier packets as well.

    flip: the probability of a flip.

    Source: docs/mathematics/attacks.md, attacks on acknowledgements.
    """
    gamma, gamma_e, flips = (np.arange(8) >> bit & 1 == 0 for bit in range(3))
    chances = np.where(gamma, mu, 1.0 - mu) * np.where(gamma_e, mu_e, 1.0 - mu_e) * np.where(flips, flip, 1.0 - flip)
    heed_rule, heeded = heed_rule_of(attack, quality, mu_e), np.full(8, quality)
    if heed_rule is not None:
        fraction = heed_rule.fraction_of(0)
        heeded = np.where(
            gamma_e, fraction, max(0.0, quality - mu_e * fraction) / max(1.0 - mu_e, np.finfo(float).tiny)
        )
    arrives = heeded * chances * ATTACKS[attack](gamma, gamma_e, flips)

    def split(heard: Flags) -> tuple[float, float]:
        return float(arrives[heard].sum()), float(arrives[~heard].sum())

    return AcknowledgementRates(float(arrives.sum()), split(gamma), split(gamma_e))


_NEVER = -(2**62)


@final
class HoldingTime:
    """h_k = k − t with the last acknowledged slot t, for every trial; infinite before the first acknowledgement.

    Acknowledgements that are blocked or lost make h too large, never too small.

    Source: docs/mathematics/schemes.md, schedules by holding time.
    """

    def __init__(self, trials: int) -> None:
        self._slot: NDArray[np.int64] = np.full(trials, _NEVER, np.int64)

    def reached(self, k: int, threshold: float) -> Flags:
        """Whether h_k ≥ threshold, (R,)."""
        return k - self._slot >= threshold

    def acknowledged(self, k: int, acknowledged: Flags) -> None:
        """Add the acknowledgements (R,) of slot k; slots may come in any order."""
        self._slot = np.where(acknowledged, np.maximum(self._slot, k), self._slot)
