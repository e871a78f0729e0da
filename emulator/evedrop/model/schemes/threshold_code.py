"""The state where the user has probably lost the reference, or else the state minus it: for flipped acknowledgements."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, final

import numpy as np

from evedrop.model.checks import as_toml, is_number, probability_mistakes
from evedrop.model.process import Process
from evedrop.model.receiver import Flags, Receiver
from evedrop.model.reference import ReferenceReceiver
from evedrop.model.reference_code import ReferenceCode, singular_warnings
from evedrop.model.schemes.mixed_packets import MIXED_HEADER, MixedEncoder
from evedrop.model.schemes.scheme import NoInnovations, Scheme, Shared
from evedrop.model.streams import Batch
from evedrop.model.theory.lost_reference import LostReference, growth_by_phases, most_coded


def forged_fraction(mu: float, flip: float) -> float:
    """P(γ = 0 | an acknowledgement arrives), where each slot's is flipped with probability p; 0 if none ever arrives.

    Source: docs/mathematics.md, flipped acknowledgements.
    """
    forged = (1.0 - mu) * flip
    arrives = mu * (1.0 - flip) + forged
    return forged / arrives if arrives else 0.0


@final
class ThresholdCodeEncoder(MixedEncoder):
    """Sends the state where b > θ, b the probability that the user has lost the reference, as far as the sensor knows."""

    def __init__(self, code: ReferenceCode, n: int, trials: int, threshold: float, forged: float) -> None:
        super().__init__(code, n, trials)
        self._threshold, self._forged = threshold, forged
        self._belief = np.zeros(trials)

    def plain(self, k: int) -> Flags:  # noqa: ARG002 - the belief says it
        """Whether the state is sent, (R,)."""
        flags: Flags = self._belief > self._threshold
        return flags

    def acknowledged(self, k: int, acknowledged: Flags) -> None:
        """An acknowledgement of a state makes b the fraction of forged ones; that of a coded packet adds to b."""
        super().acknowledged(k, acknowledged)
        after = self._forged + np.where(self._sent_plain, 0.0, self._belief * (1.0 - self._forged))
        self._belief = np.where(acknowledged, after, self._belief)


class ThresholdCode(Scheme):
    """The state where the belief that the user has lost the reference exceeds θ, else the state minus the reference.

    The sensor computes its belief from the link's quality and the probability of flips as it is told them.

    Source: Lücke, Lu, Quevedo (2022); docs/mathematics.md, flipped acknowledgements.
    """

    parameters = MappingProxyType({"lost_belief": 0.1, "assumed_quality": 0.8, "assumed_flip": 0.1})
    best_reader = "reference"
    needs_acknowledgements = True
    reads_packets = True
    header = MIXED_HEADER

    def __init__(self, process: Process, lost_belief: float, assumed_quality: float, assumed_flip: float) -> None:
        super().__init__(process)
        self._threshold, self._forged = lost_belief, forged_fraction(assumed_quality, assumed_flip)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Numbers that are not probabilities, and a threshold that no belief exceeds."""
        found = probability_mistakes(given, "lost_belief", "assumed_quality", "assumed_flip")
        if is_number(given.get("lost_belief"), 1.0, 1.0):
            what = f"is {as_toml(given['lost_belief'])}, which no belief exceeds, so the state is never sent again once there is "
            what += "a reference: the first flipped acknowledgement would leave the user behind for good; "
            what += "expected a number below 1"
            found.append(("lost_belief", what))
        return found

    def warnings(self) -> list[str]:
        """That of a singular A."""
        return singular_warnings(self.process)

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """The references; nothing is secret."""
        return NoInnovations(
            self.process,
            batch.trials,
            lambda: ThresholdCodeEncoder(
                ReferenceCode(self.process), self.process.n, batch.trials, self._threshold, self._forged
            ),
            lambda: self.estimator(keys, batch),
        )

    def estimator(self, keys: Mapping[str, bytes], batch: Batch) -> Receiver:  # noqa: ARG002 - there is no secret
        """The filter of the state and the reference."""
        return ReferenceReceiver(self.process, batch.trials)

    def outcomes(self, mu: float) -> None:
        """None: the information in a packet depends on the acknowledgements before it."""

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
