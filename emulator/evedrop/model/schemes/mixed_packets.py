"""Schemes for acknowledgements that may be flipped on their way: packets of states and of coded states, with the reference named.

The random code sends the state, by a coin, or else the state minus a reference. The threshold code sends the state where the
legitimate estimator has probably lost the reference.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, final

import numpy as np

from evedrop.model.checks import as_toml, is_number, probability_mistakes
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Flags
from evedrop.model.reference_code import NONE, Content, ReferenceCode, singular_warnings
from evedrop.model.schemes.acknowledged import AcknowledgedEncoder, ReferenceScheme
from evedrop.model.schemes.scheme import Encoder, Packet
from evedrop.model.streams import Ahead, Batch, BlockReader
from evedrop.model.theory.closed_forms import LostReference, growth_by_coin, growth_by_phases, most_coded
from evedrop.model.theory.covariances import radius


class MixedEncoder(AcknowledgedEncoder):
    """z_k = x_k where a policy says so or there is no reference, else x_k − L_{t,k} x_t, t the last acknowledged slot."""

    @abstractmethod
    def plain(self, k: int) -> Flags:
        """Whether the state is sent in slot k, (R,), if there is a reference."""

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """The packet of slot k, which must follow the slot before."""
        packet = super().encode(k, x, predicted)
        self._sent_plain = self.plain(k) | (self._slot == NONE)
        self._read = np.where(self._sent_plain, x, self._read)
        content = np.where(self._sent_plain, Content.STATE, Content.CODED)
        return packet._replace(z=np.where(self._sent_plain, x, packet.z), header=np.array([self._slot, content]))


class _MixedCode(ReferenceScheme):
    """Subtracts the reference in some slots. A packet with the state names the reference too, so that receivers follow it."""

    sent_words = ("packet",)
    header = ("slot t of the reference; −1: no reference", "0: z is the state; 1: z is the state minus L_{t,k} x_t")

    def warnings(self) -> list[str]:
        """That of a singular A."""
        return singular_warnings(self.process)

    def outcomes(self, mu: float) -> None:
        """None: the information in a packet depends on the acknowledgements before it."""


@final
class RandomCodeEncoder(MixedEncoder):
    """Sends the state where the uniform number of the stream `schedule` is below α."""

    def __init__(self, code: ReferenceCode, n: int, batch: Batch, key: bytes, alpha: float) -> None:
        super().__init__(code, n, batch.trials)
        reader = BlockReader(key, batch, 1)
        self._plain = Ahead(reader.ahead, lambda slots: reader.uniforms(slots)[:, 0, :] < alpha)

    def plain(self, k: int) -> Flags:
        """Whether the state is sent in slot k, (R,)."""
        return self._plain.at(k)


class RandomCode(_MixedCode):
    """With probability α the state, otherwise the state minus a reference, as `acknowledged` sends it.

    A flipped acknowledgement leaves sensor and estimator with different references; the next state that it receives, if its
    acknowledgement is not flipped, synchronises them again.

    Source: Lücke, Lu, Quevedo (2022); docs/mathematics/attacks.md, flipped acknowledgements.
    """

    parameters = MappingProxyType({"plain_probability": 0.3})
    secret_streams = ("schedule",)

    def __init__(self, process: Process, plain_probability: float) -> None:
        super().__init__(process)
        self._alpha = plain_probability

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A number that is not a probability, or 0."""
        if given.get("plain_probability") == 0:
            why = f"is {as_toml(given['plain_probability'])}, so the state is never sent again once there is a reference: "
            why += "one flipped acknowledgement would leave the estimator behind for good; expected a number above 0, up to 1"
            return [("plain_probability", why)]
        return probability_mistakes(given, "plain_probability")

    def encoder(self, keys: Mapping[str, bytes], batch: Batch) -> Encoder:
        """The sensor's side, with its coin."""
        return RandomCodeEncoder(ReferenceCode(self.process), self.process.n, batch, keys["schedule"], self._alpha)

    def lost_reference(self, received: float, acknowledged: tuple[float, float]) -> LostReference:  # noqa: ARG002 - only states count
        """An unencrypted state ends the growth: ρ²(1 − αμ) a slot."""
        growth = growth_by_coin(self.process, self._alpha, received)
        square = radius(self.process) ** 2
        least = (square - 1.0) / square if square > 1.0 else 0.0
        remedy = f"plain_probability exceeds {least / received:.6g}" if received > least else "the link is better"
        return LostReference(growth, remedy)


def forged_fraction(mu: float, flip: float) -> float:
    """P(γ = 0 | an acknowledgement arrives), where each slot's is flipped with probability p; 0 if none ever arrives.

    Source: docs/mathematics/attacks.md, flipped acknowledgements.
    """
    forged = (1.0 - mu) * flip
    arrives = mu * (1.0 - flip) + forged
    return forged / arrives if arrives else 0.0


@final
class ThresholdCodeEncoder(MixedEncoder):
    """Sends the state where b > θ, b the probability that the estimator has lost the reference, as far as the sensor knows."""

    def __init__(self, code: ReferenceCode, n: int, trials: int, threshold: float, forged: float) -> None:
        super().__init__(code, n, trials)
        self._threshold, self._forged = threshold, forged
        self._belief = np.zeros(trials)

    def plain(self, k: int) -> Flags:  # noqa: ARG002 - the belief says it
        """Whether the state is sent, (R,)."""
        return self._belief > self._threshold

    def acknowledged(self, k: int, acknowledged: Flags) -> None:
        """An acknowledgement of a state makes b the fraction of forged ones; that of a coded packet adds to b."""
        super().acknowledged(k, acknowledged)
        after = self._forged + np.where(self._sent_plain, 0.0, self._belief * (1.0 - self._forged))
        self._belief = np.where(acknowledged, after, self._belief)


class ThresholdCode(_MixedCode):
    """The state where the belief that the estimator has lost the reference exceeds θ, else the state minus the reference.

    The sensor computes its belief from the link's quality and the probability of flips as it is told them.

    Source: Lücke, Lu, Quevedo (2022); docs/mathematics/attacks.md, flipped acknowledgements.
    """

    parameters = MappingProxyType({"lost_belief": 0.1, "assumed_quality": 0.8, "assumed_flip": 0.1})

    def __init__(self, process: Process, lost_belief: float, assumed_quality: float, assumed_flip: float) -> None:
        super().__init__(process)
        self._threshold, self._forged = lost_belief, forged_fraction(assumed_quality, assumed_flip)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Numbers that are not probabilities, and a threshold that no belief exceeds."""
        mistakes = probability_mistakes(given, "lost_belief", "assumed_quality", "assumed_flip")
        if is_number(given.get("lost_belief"), 1.0, 1.0):
            why = f"is {as_toml(given['lost_belief'])}, which no belief exceeds, so the state is never sent again once there is "
            why += "a reference: one flipped acknowledgement would leave the estimator behind for good; "
            why += "expected a number below 1"
            mistakes.append(("lost_belief", why))
        return mistakes

    def encoder(self, keys: Mapping[str, bytes], batch: Batch) -> Encoder:  # noqa: ARG002 - there is no secret
        """The sensor's side."""
        code = ReferenceCode(self.process)
        return ThresholdCodeEncoder(code, self.process.n, batch.trials, self._threshold, self._forged)

    def lost_reference(self, received: float, acknowledged: tuple[float, float]) -> LostReference:
        """The sensor sends states until one is acknowledged, then m acknowledged coded packets until b exceeds θ again."""
        if self._forged == 0.0:
            coded, remedy = math.inf, "assumed_flip is above 0: the sensor never expects a lost reference"
        else:
            # b is 1 − (1−c)^{j+1} after the j-th of them.
            coded = math.floor(math.log1p(-self._threshold) / math.log1p(-self._forged)) if self._forged < 1.0 else 0
            below = 1.0 - (1.0 - self._forged) ** (most_coded(self.process, received, acknowledged) + 1.0)
            remedy = f"lost_belief is below {below:.6g}" if below > 0.0 else "the link is better"
        return LostReference(growth_by_phases(self.process, coded, received, acknowledged), remedy)
