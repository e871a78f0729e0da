"""Classes as users write them, for drawn scenarios: a scheme, a loss model and an eavesdropper that are not built in.

Each works slot by slot, and a launcher and a recorder ask the eavesdropper's in a process of its own.

Source: docs/your-own/rules.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, final

import numpy as np

from evedrop.model import update
from evedrop.model.checks import probability_mistakes
from evedrop.model.eavesdroppers.eavesdropper import PacketReader
from evedrop.model.links.loss_model import LossModel, fates_of
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Action, Belief, Codes, Reception, trace_of
from evedrop.model.schemes.plain import PlainEstimator
from evedrop.model.schemes.scheme import Encoder, NoInnovations, Packet, Scheme
from evedrop.model.streams import Batch, BlockReader
from evedrop.model.theory.covariances import Outcomes

_Sign = Callable[[int], Floats]


@final
class _FlippedEncoder(Encoder):
    def __init__(self, sign: _Sign) -> None:
        self._sign = sign

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """The state, or its negative."""
        del predicted
        return Packet(self._sign(k) * x, np.zeros(x.shape[1], np.bool_))


@final
class _FlippedEstimator(PlainEstimator):
    def __init__(self, process: Process, trials: int, sign: _Sign) -> None:
        super().__init__(process, trials)
        self._sign = sign

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Take every packet for the state."""
        return super().step(k, belief, heard._replace(z=self._sign(k) * heard.z))


@final
class Flipped(Scheme):
    """The state or its negative, by a coin that sensor and legitimate estimator share."""

    secret_streams = estimator_streams = ("flip",)

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> NoInnovations:
        """Sensor and estimator."""
        coins = BlockReader(keys["flip"], batch, 1)

        def sign(k: int) -> Floats:
            return np.where(coins.uniforms(range(k, k + 1))[0, 0] < 0.5, 1.0, -1.0)

        estimator = _FlippedEstimator(self.process, batch.trials, sign)
        return NoInnovations(self.process, batch.trials, lambda: _FlippedEncoder(sign), lambda: estimator)

    def outcomes(self, mu: float) -> Outcomes:
        """A state with every packet."""
        return Outcomes.plain(mu)


@final
class EverySecond(LossModel):
    """Every second slot is good."""

    parameters: ClassVar = {"good": 0.9}

    def __init__(self, good: float) -> None:
        self._good = good

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """It is a probability."""
        return probability_mistakes(given, "good")

    @property
    def quality(self) -> float:
        """The mean probability of an arrival."""
        return self._good / 2.0

    @property
    def memoryless(self) -> bool:
        """It has no memory."""
        return True

    def quality_at(self, slots: range) -> Floats:
        """In each slot."""
        return np.where(np.arange(slots.start, slots.stop) % 2, 0.0, self._good)

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """Those of consecutive slots."""
        return fates_of(uniforms[:, 0] >= self.quality_at(range(first, first + len(uniforms)))[:, None])


@final
class Gate(PacketReader):
    """Takes a packet for the state if it is near enough to where it expects the state."""

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Read it, or discard it."""
        lost = np.zeros(self.trials, np.uint8)
        expected = update.belief(self.process, k, belief, lost, heard.z)
        near = np.square(heard.z - expected.x_hat).sum(0) <= 9.0 * trace_of(expected.P)
        action = np.where(heard.gamma, np.where(near, Action.STATE, Action.DISCARDED), lost).astype(np.uint8)
        return update.belief(self.process, k, belief, action, heard.z)


SCHEME, LOSS_MODEL, STRATEGY = (f"{__name__}:{own.__name__}" for own in (Flipped, EverySecond, Gate))
"""Their names in a scenario."""
