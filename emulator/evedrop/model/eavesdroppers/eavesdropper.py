"""The base classes of eavesdroppers: what they may know, what they must declare, and how they are made."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from evedrop.model.checks import Parametrised
from evedrop.model.packet_user import PacketUser
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Belief, Codes, Flags, Receiver
from evedrop.model.schedule import NoiseDistribution, Schedule, StateProbability
from evedrop.model.streams import Batch
from evedrop.model.theory.covariances import Outcomes, OutcomesAt


@dataclass(frozen=True)
class Knowledge:
    """Everything an eavesdropper may know: the public model, its own parameters, the keys of its streams."""

    process: Process
    state_probability: float
    """μ_d; its mean over the slots if it differs from slot to slot."""
    parameters: Mapping[str, Any]
    keys: Mapping[str, bytes]
    """Keys of the strategy's streams: `schedule`, and `coin` for its own random numbers."""
    state_probabilities: tuple[float, ...] | None = None
    """μ_d(k) for every slot of the run; None if it is the same in all slots."""
    noise_distribution: NoiseDistribution | None = None
    """The distribution of packets that hold noise in place of a state; None if the scheme has none."""

    @property
    def mu_d(self) -> StateProbability:
        """μ_d of each slot."""
        return self.state_probability if self.state_probabilities is None else self.state_probabilities


class Eavesdropper(Parametrised, Receiver):
    """A strategy: how an eavesdropper reads packets.

    `parameters` are the entries that a scenario must give it, each with an example; `Knowledge.parameters` has the values given.
    """

    pools_links: ClassVar[bool] = False
    """Whether it has several links instead of one; it hears what any of them delivers."""
    only_against: ClassVar[tuple[str | tuple[str, ...], str] | None] = None
    """The only scheme, or schemes, that `evedrop compare` sets it against, and what it would be against any other; None: all."""
    costly: ClassVar[bool] = False
    """Whether it takes so long that `evedrop compare` leaves it out, unless it is named or the scenario has it."""
    inverts_noise: ClassVar[bool] = False
    """Whether it uses the inverse of Q, so that Q must not be singular."""
    reads_leaks: ClassVar[bool] = False
    """Whether it uses what innovations leak, so that A and Q must not both be singular."""
    tests_range: ClassVar[bool] = False
    """Whether it tests packets against the range of a singular Q, so that nothing may move the state out of this range."""

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge.process, batch.trials)

    @classmethod
    def streams(cls, parameters: Mapping[str, Any]) -> tuple[str, ...]:
        """The streams whose keys it must be given: streams of the secret, or its own stream `coin`."""
        del parameters
        return ()

    @classmethod
    @abstractmethod
    def outcomes(cls, parameters: Mapping[str, Any], mu_d: float) -> OutcomesAt | None:
        """Its outcomes behind a link of any quality μ_e, for the theory; None if no closed form is known."""

    @classmethod
    @abstractmethod
    def follows_gamma(cls, parameters: Mapping[str, Any]) -> bool:
        """Whether γ alone determines its actions, and its actions, by the table of `model.update`, its covariances."""

    @classmethod
    def betrayed(cls, parameters: Mapping[str, Any]) -> int | None:
        """The slot whose true state must be given to it as `Reception.truth`; None for almost all strategies."""
        del parameters
        return None

    def learned(self, belief: Belief) -> Mapping[str, Floats]:
        """What it has learned of the process: `A` and `Q`, (n, n, R), and `mu_d`, (R,); empty if it does not learn."""
        del belief
        return {}

    def knowing(self, k: int, x: Floats, belief: Belief) -> Belief:  # noqa: ARG002 - overrides use both
        """The belief after slot k once that slot's true state x (n, R) is known as well."""
        n, trials = x.shape
        return Belief(x, np.zeros((n, n, trials)), belief.action)


class KnowsSchedule(Eavesdropper):
    """Knows which packets contain the state."""

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._schedule = Schedule(knowledge.keys["schedule"], knowledge.mu_d, batch)

    @classmethod
    def streams(cls, parameters: Mapping[str, Any]) -> tuple[str, ...]:  # noqa: ARG003 - alike for all
        """The schedule."""
        return ("schedule",)


class PacketTaker(PacketUser, Eavesdropper):
    """The paper's class: uses a packet as the state, or ignores it.

    Source: docs/mathematics/eavesdroppers.md, eavesdroppers.
    """

    @classmethod
    @abstractmethod
    def use_probabilities(cls, parameters: Mapping[str, Any]) -> tuple[float, float]:
        """P(b = 1 given ν = 0) and P(b = 1 given ν = 1), for the theory."""

    @classmethod
    def outcomes(cls, parameters: Mapping[str, Any], mu_d: float) -> OutcomesAt | None:
        """Outcomes from the two probabilities."""
        use_state, use_innovation = cls.use_probabilities(parameters)
        return lambda mu_e: Outcomes.eavesdropper(mu_e, mu_d, use_state, use_innovation)

    @classmethod
    def follows_gamma(cls, parameters: Mapping[str, Any]) -> bool:  # noqa: ARG003 - alike for all
        """True by definition."""
        return True


class PacketReader(Eavesdropper):
    """Looks into the packets, or uses more of them than the state; its covariance is its own affair."""

    def act(self, k: int, gamma: Flags) -> Codes:
        """Unknown. Raises NotImplementedError; studies that need it refuse the strategy before."""
        raise NotImplementedError(
            f"{type(self).__name__} reads the packet of slot {k}: γ alone does not tell its action"
        )

    @classmethod
    def outcomes(cls, parameters: Mapping[str, Any], mu_d: float) -> OutcomesAt | None:  # noqa: ARG003 - alike for all
        """No closed form."""
        return None

    @classmethod
    def follows_gamma(cls, parameters: Mapping[str, Any]) -> bool:  # noqa: ARG003 - alike for all
        """False by definition."""
        return False
