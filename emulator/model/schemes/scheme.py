"""What a scheme is: an encoder for the sensor, the estimator that can read it, and what the two of them need and cost."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Flags, Receiver
from evedrop.model.theory.covariances import Outcomes
from evedrop.streams import Batch

_WORD_BITS = 64


class Packet(NamedTuple):
    """What the sensor sends in a slot, for R trials."""

    z: Floats
    """Payload, (n, R)."""
    nu: Flags
    """ν_k, (R,): true for an innovation. Never sent; the sensor's own record."""
    header: NDArray[np.int64] | None = None
    """What is sent in clear beside z, (h, R); None for a scheme that has no header."""
    sent: Flags | None = None
    """Whether anything is sent, (R,); None for a scheme that sends in every slot."""


class Encoder(ABC):
    """Makes packets of states, slot by slot."""

    @abstractmethod
    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """The packet of slot k, from x_k and A x_{k−1}, both (n, R)."""

    def acknowledged(self, k: int, acknowledged: Flags) -> None:  # noqa: B027 - most schemes need none
        """Take the acknowledgements (R,) of the packets of slot k, as they reached the sensor; before slot k + 1 is sent."""


class Shared(ABC):
    """What sensor and legitimate estimator share, and the two sides made from it. Read ahead in blocks; slots in order."""

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


class NoInnovations(Shared):
    """What the two sides of a scheme without innovations share: ν = 0 and χ = 0 always. Final."""

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


class Scheme(ABC):
    """One way to fill packets. The keys of `secret_streams` are the secret; all else about a scheme is public.

    A file of this folder holds one scheme, and its name in a scenario is that of the file with - for _. `parameters` are
    the entries that the scenario's `[encoding]` gives it, each with an example; they are the constructor's arguments.

    Source: docs/schemes.md.
    """

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    secret_streams: ClassVar[tuple[str, ...]] = ()
    """The streams that the sensor draws from."""
    estimator_streams: ClassVar[tuple[str, ...]] = ()
    """Those of them whose keys the legitimate estimator holds as well."""
    needs_acknowledgements: ClassVar[bool] = False
    """Whether the encoder depends on `Encoder.acknowledged`."""
    reads_packets: ClassVar[bool] = False
    """Whether what the estimator does with a slot depends on more than γ and the secret, so that `Receiver.act` cannot
    tell it and only a simulation of packets can follow it."""
    may_be_silent: ClassVar[bool] = False
    """Whether there are slots in which it sends nothing, so that its packets have `Packet.sent`."""
    header: ClassVar[tuple[str, ...]] = ()
    """What each number of the header means."""
    secret_words: ClassVar[tuple[int, int]] = (0, 0)
    """64-bit words of shared secret that a slot uses: so many, and so many more for each state."""
    initial_secret_words: ClassVar[tuple[int, int]] = (0, 0)
    """The same, of what a trial uses once."""
    best_reader: ClassVar[str] = "naive"
    """The strategy that, without the secret, reads its packets best. `evedrop compare` has attackers read with it."""
    sends_states_and_innovations: ClassVar[bool] = False
    """Whether every packet is a state or an innovation, so that no eavesdropper without the secret does better than the genie."""
    decides_initial_state: ClassVar[bool] = False
    """Whether the secret decides x_0 (`initial_state`), so that no filter at the sensor can."""
    closed_forms: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """Receiver (a strategy, or `legitimate`) → the closed form in `evedrop.expected.closed_forms` for slots that differ."""

    def __init__(self, process: Process, state_probability: float = 1.0) -> None:
        self.process = process
        self.state_probability = state_probability
        """Probability that a slot k ≥ 1 holds the state, public: μ_d; 1 for a scheme that has no such parameter."""

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """What is wrong with parameters that are all known, if not all there: (entry, what was found and expected)."""
        del given
        return []

    @abstractmethod
    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """What the two sides share; keys holds those of `secret_streams`."""

    def encoder(self, keys: Mapping[str, bytes], batch: Batch) -> Encoder:
        """The sensor's side alone."""
        return self.shared(keys, batch).encoder()

    def estimator(self, keys: Mapping[str, bytes], batch: Batch) -> Receiver:
        """The legitimate estimator's side alone; keys holds those of `estimator_streams`."""
        return self.shared(keys, batch).estimator()

    def initial_state(self, keys: Mapping[str, bytes], batch: Batch) -> Floats | None:
        """x_0 (n, R), if the secret decides it; None where the process alone does."""
        del keys, batch
        return None

    @property
    def packet_bits(self) -> int:
        """Size of a packet's payload and header."""
        return _WORD_BITS * (self.process.n + len(self.header))

    @property
    def secret_bits(self) -> int:
        """Shared secret that a slot uses up: bits of the streams' words, all of them expanded from 256-bit keys."""
        return self._bits(self.secret_words)

    @property
    def initial_secret_bits(self) -> int:
        """The same, of what a trial uses up once."""
        return self._bits(self.initial_secret_words)

    def _bits(self, words: tuple[int, int]) -> int:
        fixed, per_state = words
        return _WORD_BITS * (fixed + per_state * self.process.n)

    @abstractmethod
    def outcomes(self, mu: float) -> Outcomes | None:
        """What the legitimate estimator does with a slot, behind a link of quality μ; None: its slots are not alike.

        Acknowledgements, where they are needed, may be lost or blocked at will, but not forged.
        """

    def error_floor(self, slots: int) -> tuple[Floats, bool] | None:
        """A lower bound on tr E[e_k e_kᵀ] of every receiver without the secret, (slots,), and whether it grows without bound.

        None: no bound is known, or the genie's is (`sends_states_and_innovations`).
        """
        del slots
        return None

    def eavesdropper_outcomes(self, mu_e: float, use_state: float, use_innovation: float) -> Outcomes | None:
        """What a user of packets, with P(b=1 | ν), does with a slot; None: no such closed form."""
        del mu_e, use_state, use_innovation
        return None
