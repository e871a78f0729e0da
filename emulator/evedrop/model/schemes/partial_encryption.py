"""Partial encryption: some states of a state packet under a pad, as by `cipher`, the others and all innovations unencrypted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, final

import numpy as np

from evedrop.model import update
from evedrop.model.checks import as_toml, probability_mistakes
from evedrop.model.number_codes import Mask
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Action, Belief, Codes, Flags, Receiver, Reception
from evedrop.model.schedule import Schedule
from evedrop.model.schemes.scheme import Encoder, NoInnovations, Packet, PacketBlock, Scheme, Shared
from evedrop.model.streams import Batch
from evedrop.model.theory.closed_forms import ClearStatesForm
from evedrop.model.theory.covariances import Outcomes, radius

UNENCRYPTED_INNOVATION = -1
"""The header of an innovation; that of a state packet has bit i for each encrypted state i."""
_LAST = 62  # the last bit of a header that is not negative
_WORD_BITS = 64


def hidden_states(encrypted: Sequence[int], n: int) -> Flags:
    """Whether each of n states is encrypted, (n,)."""
    return np.isin(np.arange(n), np.array(encrypted, np.int64))


@final
class PartialEncryptionEncoder(Encoder):
    """z_k = x_k with some states masked, or w_{k−1} unencrypted; the header says which."""

    def __init__(self, schedule: Schedule, mask: Mask, hidden: Flags) -> None:
        self._schedule, self._mask, self._hidden = schedule, mask, hidden
        self._header = sum(1 << i for i in np.flatnonzero(hidden).tolist())

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """The packet of slot k."""
        nu = self._schedule.at(k)
        state = np.where(self._hidden[:, None], self._mask.hide(k, x), x) if self._hidden.any() else x
        header = np.where(nu, UNENCRYPTED_INNOVATION, np.int64(self._header))
        return Packet(np.where(nu, x - predicted, state), nu, header[None])


@final
class PartialEncryptionEstimator(Receiver):
    """Unmasks what is masked, and knows the types: the state, or the innovation, with every packet."""

    def __init__(self, process: Process, trials: int, schedule: Schedule, mask: Mask, hidden: Flags) -> None:
        super().__init__(process, trials)
        self._schedule, self._mask, self._hidden = schedule, mask, hidden

    def act(self, k: int, gamma: Flags) -> Codes:
        """Lost, used as the state, or used as an innovation: the codes 0, 1 and 2 of `Action`."""
        return gamma.view(np.uint8) + (gamma & self._schedule.at(k)).view(np.uint8)

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """(A x̂, A P Aᵀ + Q) if lost, (the state, 0), or (A x̂ + w, A P Aᵀ)."""
        action = self.act(k, heard.gamma)
        z = heard.z
        if self._hidden.any():
            masked = self._hidden[:, None] & (action == int(Action.STATE))
            z = np.where(masked, self._mask.reveal(k, np.where(masked, z, 0.0)), z)
        return update.belief(self.process, k, belief, action, z, np.zeros_like(z))


class PartialEncryption(Scheme):
    """Encrypts some states of the state packets, which have probability μ_d = `state_probability`; innovations are unencrypted.

    For a sensor that can encrypt only few numbers. With μ_d = 0 only the packet of slot 0 is encrypted: an eavesdropper that
    reads everything else has the error A^k e_0, which grows without bound if A is unstable.

    Source: after arXiv 2406.10677; docs/mathematics/schemes.md, partial encryption.
    """

    best_reader = "clear-states"
    parameters = MappingProxyType({"encrypted": [0], "state_probability": 1.0})
    secret_streams = ("schedule", "mask")
    estimator_streams = ("schedule", "mask")
    header = ("the sum of 2^i for the encrypted states i; -1 for an innovation",)

    def __init__(self, process: Process, encrypted: Sequence[int], state_probability: float) -> None:
        super().__init__(process, state_probability)
        self._hidden = hidden_states(encrypted, process.n)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A probability, and numbers of states, each once."""
        mistakes = probability_mistakes(given, "state_probability")
        states = given.get("encrypted", [])
        valid = isinstance(states, list) and all(type(state) is int and 0 <= state <= _LAST for state in states)
        if not valid or len(set(states)) < len(states):
            numbers = (
                f"different numbers of states from 0, for the first, to {_LAST}, the last that a header has a bit for"
            )
            sentence = f"is {as_toml(states)}; expected a list of {numbers}, such as [0]"
            mistakes.append(("encrypted", sentence))
        return mistakes

    @classmethod
    def mistakes_with(cls, process: Process, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """States that the process does not have."""
        beyond = [state for state in given["encrypted"] if state >= process.n]
        if not beyond:
            return []
        return [("encrypted", f"has {beyond[0]}, but the states are 0 to {process.n - 1}; remove it")]

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """The schedule, and the pads."""
        schedule = Schedule(keys["schedule"], self.mu_d, batch)
        mask = Mask(self.process, keys["mask"], batch)
        return NoInnovations(
            self.process,
            batch.trials,
            lambda: PartialEncryptionEncoder(schedule, mask, self._hidden),
            lambda: PartialEncryptionEstimator(self.process, batch.trials, schedule, mask, self._hidden),
        )

    def encrypted(self, packets: PacketBlock) -> Flags:
        """The state packets, (c, R), if any state is encrypted."""
        return ~packets.nu & bool(self._hidden.any())

    @property
    def secret_bits(self) -> int:
        """The pads of the encrypted states. The schedule is not secret: the header says the type."""
        return _WORD_BITS * int(self._hidden.sum())

    def outcomes(self, mu: float) -> Outcomes:
        """Theorem IV.1: neither the noise nor its absence makes a difference to the legitimate estimator."""
        return Outcomes.legitimate(mu, self.state_probability)

    def reader_outcomes(self, reader: str, mu_e: float) -> Outcomes | None:
        """Those of `clear-states`, if either all states are encrypted or none."""
        if reader != "clear-states":
            return None
        if not self._hidden.any():
            return Outcomes.legitimate(mu_e, self.state_probability)
        # Without any noise a marginal error neither grows nor vanishes, and no outcomes say so.
        if not self._hidden.all() or (self.state_probability == 0.0 and radius(self.process) == 1.0):
            return None
        decoded = mu_e * (1.0 - self.state_probability)
        return Outcomes(predicted=1.0 - decoded, state=0.0, misled=0.0, decoded=decoded, initial=1.0)

    def closed_form(self, reader: str, received: float | None, slots: int) -> ClearStatesForm | None:
        """The error of `clear-states`: exact for a perfect link and packets of one type, else a lower bound."""
        if reader != "clear-states" or self.reader_outcomes(reader, 0.5) is not None:
            return None
        return ClearStatesForm(self.process, self._hidden, self.state_probability, received, slots)

    def error_floor(self, slots: int) -> tuple[Floats, bool]:
        """The error of a receiver that hears all that is unencrypted, and knows every innovation if there are any, (slots,)."""
        form = ClearStatesForm(self.process, self._hidden, self.state_probability, None, slots)
        return form.traces, form.limit == np.inf
