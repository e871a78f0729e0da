"""The state, by a coin, or else the state minus a reference: for acknowledgements that may be flipped on their way."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, final

from evedrop.model.checks import as_toml, probability_mistakes
from evedrop.model.process import Process
from evedrop.model.receiver import Flags, Receiver
from evedrop.model.reference import ReferenceReceiver
from evedrop.model.reference_code import ReferenceCode, singular_warnings
from evedrop.model.schemes.mixed_packets import MIXED_HEADER, MixedEncoder
from evedrop.model.schemes.scheme import NoInnovations, Scheme, Shared
from evedrop.model.streams import Ahead, Batch, BlockReader
from evedrop.model.theory.covariances import radius
from evedrop.model.theory.lost_reference import LostReference, growth_by_coin


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


class RandomCode(Scheme):
    """With probability α the state, otherwise the state minus a reference, as `acknowledged` sends it.

    A flipped acknowledgement leaves user and sensor with different references; the next state that the user receives, if its
    acknowledgement is not flipped, puts them in step again.

    Source: Lücke, Lu, Quevedo (2022); docs/mathematics.md, flipped acknowledgements.
    """

    parameters = MappingProxyType({"plain_probability": 0.3})
    secret_streams = ("schedule",)
    best_reader = "reference"
    needs_acknowledgements = True
    reads_packets = True
    header = MIXED_HEADER

    def __init__(self, process: Process, plain_probability: float) -> None:
        super().__init__(process)
        self._alpha = plain_probability

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A number that is not a probability, or 0."""
        if given.get("plain_probability") == 0:
            what = f"is {as_toml(given['plain_probability'])}, so the state is never sent again once there is a reference: "
            what += "the first flipped acknowledgement would leave the user behind for good; expected a number above 0, up to 1"
            return [("plain_probability", what)]
        return probability_mistakes(given, "plain_probability")

    def warnings(self) -> list[str]:
        """That of a singular A."""
        return singular_warnings(self.process)

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """The references and the sensor's coin."""
        return NoInnovations(
            self.process,
            batch.trials,
            lambda: RandomCodeEncoder(
                ReferenceCode(self.process), self.process.n, batch, keys["schedule"], self._alpha
            ),
            lambda: self.estimator(keys, batch),
        )

    def estimator(self, keys: Mapping[str, bytes], batch: Batch) -> Receiver:  # noqa: ARG002 - there is no secret
        """The filter of the state and the reference."""
        return ReferenceReceiver(self.process, batch.trials)

    def outcomes(self, mu: float) -> None:
        """None: the information in a packet depends on the acknowledgements before it."""

    def lost_reference(self, received: float, acknowledged: tuple[float, float]) -> LostReference:  # noqa: ARG002 - only states count
        """An unencrypted state ends the growth: ρ²(1 − αμ) a slot."""
        growth = growth_by_coin(self.process, self._alpha, received)
        square = radius(self.process) ** 2
        least = (square - 1.0) / square if square > 1.0 else 0.0
        remedy = f"plain_probability exceeds {least / received:.6g}" if received > least else "the link is better"
        return LostReference(growth, remedy)
