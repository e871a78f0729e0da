"""The base class of schemes: an encoder for the sensor, the estimator that can read it, and what both need and cost."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.checks import Parametrised
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Flags, Receiver, complete, needed
from evedrop.model.schedule import NoiseDistribution, StateProbability, in_slot, mean_of
from evedrop.model.streams import Batch
from evedrop.model.theory.closed_forms import ClosedForm, ClosedFormMaker, LostReference, QuantisationError
from evedrop.model.theory.covariances import Outcomes
from evedrop.model.theory.leaked_bits import RevealedBits

_WORD_BITS = 64
_THEORY = (
    "sends_states_and_innovations",
    "closed_forms",
    "sends_by_holding_time",
    "meets_energy_budget",
    "error_floor",
    "revealed_bits",
    "bound_outcomes",
    "reader_outcomes",
    "closed_form",
    "lost_reference",
)


class Packet(NamedTuple):
    """What the sensor sends in a slot, for R trials."""

    z: Floats
    """Payload, (n, R)."""
    nu: Flags
    """ν_k, (R,): true for an innovation, or for noise in its place. Never sent; the sensor's own record."""
    header: NDArray[np.int64] | None = None
    """Sent unencrypted with z, (h, R); None for a scheme without a header."""
    sent: Flags | None = None
    """Whether a packet is sent, (R,); None for a scheme that sends in every slot."""


class PacketBlock(NamedTuple):
    """What the sensor sends in c consecutive slots; as `Packet`, with the slots as first axis."""

    z: Floats
    """(c, n, R)."""
    nu: Flags
    """(c, R)."""
    header: NDArray[np.int64] | None = None
    """(c, h, R)."""
    sent: Flags | None = None
    """(c, R)."""

    @classmethod
    def of(cls, packets: Sequence[Packet]) -> PacketBlock:
        """The packets of single slots, at least one, as one."""
        columns = zip(*packets, strict=True)
        return cls(*(None if column[0] is None else np.array(column) for column in columns))  # type: ignore[arg-type]

    @classmethod
    def joined(cls, parts: Sequence[PacketBlock]) -> PacketBlock:
        """Consecutive packets, at least one, as one."""
        columns = zip(*parts, strict=True)
        return cls(*(None if column[0] is None else np.concatenate(column) for column in columns))  # type: ignore[arg-type]

    def rows(self, some: slice) -> PacketBlock:
        """The packets of some of the slots."""
        return PacketBlock(*(None if column is None else column[some] for column in self))  # type: ignore[arg-type]

    def at(self, row: int) -> Packet:
        """The packet of one of the slots."""
        return Packet(*(None if column is None else column[row] for column in self))  # type: ignore[arg-type]


def _encode_one(encode_block: Callable[..., PacketBlock]) -> Callable[..., Packet]:
    return lambda self, k, x, predicted: encode_block(self, range(k, k + 1), x[None], predicted[None]).at(0)


class Encoder(ABC):  # noqa: B024 - `encode` is abstract
    """Makes packets from states. A subclass writes `encode_block`, or `encode`."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Complete the pair of methods."""
        super().__init_subclass__(**options)
        complete(cls, Encoder, "encode_block", "encode", _encode_one)

    @needed
    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """The packet of slot k, from x_k and A x_{k−1}, both (n, R)."""
        raise NotImplementedError

    def encode_block(self, slots: range, x: Floats, predicted: Floats) -> PacketBlock:
        """The packets of consecutive slots, from x and A x of the slots before, both (c, n, R).

        A scheme may override this to make many packets at once; the numbers must be those of `encode`, slot by slot.
        """
        return PacketBlock.of([self.encode(k, x[row], predicted[row]) for row, k in enumerate(slots)])

    def acknowledged(self, k: int, acknowledged: Flags) -> None:  # noqa: B027 - most schemes need none
        """Receive the acknowledgements (R,) of slot k that reached the sensor; called before slot k + 1 is sent."""


class Shared(ABC):
    """The secret that sensor and legitimate estimator share, and both sides made from it. Slots must be read in order."""

    @abstractmethod
    def nu(self, k: int) -> Flags:
        """ν_k, (R,): true for an innovation."""

    @abstractmethod
    def chi(self, k: int) -> Floats:
        """χ_k, (n, R): the noise that hides an innovation."""

    @abstractmethod
    def encoder(self) -> Encoder:
        """The sensor's side."""

    @abstractmethod
    def estimator(self) -> Receiver:
        """The legitimate estimator's side."""


@final
class NoInnovations(Shared):
    """The shared part of a scheme without innovations: ν = 0 and χ = 0 always."""

    def __init__(
        self, process: Process, trials: int, encoder: Callable[[], Encoder], estimator: Callable[[], Receiver]
    ) -> None:
        self._process = process
        self._trials = trials
        self._encoder = encoder
        self._estimator = estimator

    def nu(self, k: int) -> Flags:  # noqa: ARG002 - every slot alike
        """No innovations, (R,)."""
        return np.zeros(self._trials, np.bool_)

    def chi(self, k: int) -> Floats:  # noqa: ARG002 - every slot alike
        """No noise, (n, R)."""
        return np.zeros((self._process.n, self._trials))

    def encoder(self) -> Encoder:
        """The sensor's side."""
        return self._encoder()

    def estimator(self) -> Receiver:
        """The legitimate estimator's side."""
        return self._estimator()


class Scheme(Parametrised, ABC):
    """One way to fill packets. The keys of `secret_streams` are the secret; everything else about a scheme is public.

    `parameters` are the entries in the scenario's `[encoding]`, each with an example; they are the constructor's arguments.

    Source: docs/schemes.md.
    """

    secret_streams: ClassVar[tuple[str, ...]] = ()
    """The streams that the sensor draws from."""
    estimator_streams: ClassVar[tuple[str, ...]] = ()
    """The streams among these whose keys the legitimate estimator has as well."""
    needs_acknowledgements: ClassVar[bool] = False
    """Whether the encoder depends on `Encoder.acknowledged`."""
    reads_packets: ClassVar[bool] = False
    """Whether the estimator's action depends on more than γ and the secret, so that `Receiver.act` cannot know it and only a
    simulation of packets can follow it."""
    sent_words: ClassVar[tuple[str, ...]] = ("state", "innovation")
    """What pictures call its packets with ν = 0 and those with ν = 1; the first alone if ν is never 1."""
    may_be_silent: ClassVar[bool] = False
    """Whether it sends nothing in some slots, so that its packets have `Packet.sent`."""
    header: ClassVar[tuple[str, ...]] = ()
    """The meaning of each number of the header."""
    secret_words: ClassVar[tuple[int, int]] = (0, 0)
    """64-bit words of shared secret that a slot uses: a fixed number, and a number per state."""
    initial_secret_words: ClassVar[tuple[int, int]] = (0, 0)
    """The same for the words that a trial uses once."""
    best_reader: ClassVar[str] = "naive"
    """The strategy that, without the secret, reads its packets best. `evedrop compare` has attackers read with it."""
    sends_states_and_innovations: ClassVar[bool] = False
    """Whether every packet is a state or an innovation, so that no eavesdropper without the secret does better than the genie."""
    closed_forms: ClassVar[Mapping[str, ClosedFormMaker]] = MappingProxyType({})
    """Receiver (a strategy, or `legitimate`) → the function that makes its closed form for slots that differ."""
    sends_by_holding_time: ClassVar[bool] = False
    """Whether the slots since the last acknowledged packet decide when it sends.
    `evedrop design --policy` is for such schemes."""
    meets_energy_budget: ClassVar[bool] = False
    """Whether it encrypts from its parameter `threshold` on, any number of at least 1, as `quantised-schedule` does.
    `evedrop design --budget` is for such schemes."""
    mu_d: StateProbability = 1.0
    """μ_d, or μ_d(k) of each slot."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Reset the theory of the packets: a subclass may send others, and has to state again what holds of them."""
        super().__init_subclass__(**options)
        for name in _THEORY:
            if name not in vars(cls):
                setattr(cls, name, getattr(Scheme, name))

    def __init__(self, process: Process, state_probability: float | Sequence[float] = 1.0) -> None:
        self.process = process
        if isinstance(state_probability, Sequence):
            self.mu_d = tuple(map(float, state_probability))
        else:
            self.mu_d = state_probability
        self.state_probability = mean_of(self.mu_d)
        """Probability that the packet of a slot k ≥ 1 contains the state, which is public: μ_d; 1 without such a parameter.

        Its mean over the slots if it differs from slot to slot.
        """

    def in_slot(self, k: int) -> Scheme:
        """The scheme with μ_d(k) in all slots: itself, unless μ_d differs from slot to slot."""
        if not isinstance(self.mu_d, tuple):
            return self
        scheme = copy(self)
        scheme.mu_d = scheme.state_probability = in_slot(self.mu_d, k)
        return scheme

    @classmethod
    def decides_initial_state(cls) -> bool:
        """Whether the secret decides x_0, so that no filter at the sensor can."""
        return cls.initial_state is not Scheme.initial_state

    @classmethod
    def mistakes_with(cls, process: Process, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Mistakes in parameters, otherwise valid, that show only with the process: as `mistakes`."""
        del process, given
        return []

    @abstractmethod
    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """The shared part of both sides; keys: those of `secret_streams`."""

    def encoder(self, keys: Mapping[str, bytes], batch: Batch) -> Encoder:
        """The sensor's side alone."""
        return self.shared(keys, batch).encoder()

    def estimator(self, keys: Mapping[str, bytes], batch: Batch) -> Receiver:
        """The legitimate estimator's side alone; keys: those of `estimator_streams`."""
        return self.shared(keys, batch).estimator()

    def initial_state(self, keys: Mapping[str, bytes], batch: Batch) -> Floats | None:
        """x_0 (n, R), if the secret decides it; None if the process alone does."""
        del keys, batch
        return None

    def warnings(self) -> list[str]:
        """What the user should know about the scheme with this process before a run."""
        return []

    @property
    def noise_distribution(self) -> NoiseDistribution | None:
        """The public distribution of packets that hold noise in place of a state; None if there are none."""
        return None

    @property
    def payload_bits(self) -> int:
        """Size of a packet's payload."""
        return _WORD_BITS * self.process.n

    @property
    def header_bits(self) -> int:
        """Size of a packet's header."""
        return _WORD_BITS * len(self.header)

    @final
    @property
    def packet_bits(self) -> int:
        """Size of a packet's payload and header."""
        return self.payload_bits + self.header_bits

    @property
    def quantisation(self) -> QuantisationError | None:
        """The error of a state that is read from a packet; None if there is none."""
        return None

    def encrypted(self, packets: PacketBlock) -> Flags:
        """Whether the sensor has encrypted each packet, (c, R); by default none. Encryption costs it energy."""
        return np.zeros(packets.nu.shape, np.bool_)

    @property
    def secret_bits(self) -> int:
        """Shared secret that a slot uses up: bits of the streams' words, all expanded from 256-bit keys."""
        return self._bits(self.secret_words)

    @property
    def initial_secret_bits(self) -> int:
        """The same for the bits that a trial uses up once."""
        return self._bits(self.initial_secret_words)

    def _bits(self, words: tuple[int, int]) -> int:
        fixed, per_state = words
        return _WORD_BITS * (fixed + per_state * self.process.n)

    @abstractmethod
    def outcomes(self, mu: float) -> Outcomes | None:
        """The outcomes at the legitimate estimator behind a link of quality μ; None if its slots differ.

        Acknowledgements, where they are needed, may be lost or blocked in any way, but not forged.
        """

    def lost_reference(self, received: float, acknowledged: tuple[float, float]) -> LostReference | None:
        """The growth of the expected error of a receiver that lacks the reference; None for a scheme without references.

        received: the probability that it hears a packet; acknowledged: the probabilities that the packet is acknowledged to the
        sensor and was heard by the receiver, and that it is acknowledged and was not heard.
        """
        del received, acknowledged
        return None

    def error_floor(self, slots: int) -> tuple[Floats, bool] | None:
        """A lower bound on tr E[e_k e_kᵀ] of every receiver without the secret, (slots,), and whether it grows without bound.

        None: no bound is known, or the genie's is (`sends_states_and_innovations`).
        """
        del slots
        return None

    def revealed_bits(self) -> RevealedBits | None:
        """The bits about the path of states that a packet with ν = 0, and one with ν = 1, reveals in each slot.

        To a receiver without the secret that knows ν, beyond what all earlier packets revealed; inf: the packet is the state
        itself. The probability of ν = 0 must be `mu_d`. None: unknown.

        Source: docs/mathematics/eavesdroppers.md, leak in bits.
        """
        return None

    def bound_outcomes(self, mu_e: float) -> Outcomes | None:
        """The outcomes at the best receiver without the secret but with the types of packets; None if no bound is known."""
        return Outcomes.genie(mu_e, self.state_probability) if self.sends_states_and_innovations else None

    def reader_outcomes(self, reader: str, mu_e: float) -> Outcomes | None:
        """The outcomes at a receiver that reads packets as this strategy does; None if there is no such closed form."""
        del reader, mu_e
        return None

    def closed_form(self, reader: str, received: float | None, slots: int) -> ClosedForm | None:
        """Theory of a strategy whose slots differ, over slots 0 … slots−1; None if there is none.

        received: the probability that a packet is received, if it is the same and independent in all slots; else None.
        """
        del reader, received, slots
        return None

    def eavesdropper_outcomes(self, mu_e: float, use_state: float, use_innovation: float) -> Outcomes | None:
        """The outcomes at a receiver that uses packets with P(b=1 | ν); None if there is no closed form."""
        del mu_e, use_state, use_innovation
        return None


class PublicScheme(Scheme):
    """A scheme without innovations whose receivers need no secret: a subclass writes `encoder` and `estimator`."""

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """Both sides, made each by itself."""
        return NoInnovations(
            self.process,
            batch.trials,
            lambda: self.encoder(keys, batch),
            lambda: self.estimator(keys, batch),
        )

    @abstractmethod
    def encoder(self, keys: Mapping[str, bytes], batch: Batch) -> Encoder:
        """The sensor's side."""

    @abstractmethod
    def estimator(self, keys: Mapping[str, bytes], batch: Batch) -> Receiver:
        """The legitimate estimator's side, which reads as every receiver can."""
