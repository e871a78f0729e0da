"""What the packets that an eavesdropper received reveal without the secret: unencrypted states, and bits of other packets.

Source: docs/mathematics/eavesdroppers.md, leak in bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, final

import numpy as np

from evedrop.model.digest import added_in_order
from evedrop.model.kernels.current import kernels
from evedrop.model.metrics.standard_error import standard_error, z_of
from evedrop.model.process import Floats
from evedrop.model.receiver import Action, Codes, Flags
from evedrop.model.schedule import StateProbability, in_slots
from evedrop.model.slot.link_distribution import distribution_of
from evedrop.model.theory.leaked_bits import RevealedBits
from evedrop.names import LEGITIMATE
from evedrop.scenario.tables import Scenario
from evedrop.score.summary import LeakSummary


class PacketBits(NamedTuple):
    """What the packets of c slots reveal without the secret."""

    by_type: Floats
    """Bits of a packet with ν = 0, and of one with ν = 1, (c, 2); inf for the state itself."""
    clear: Floats
    """The probability that it is the state itself, (c,)."""
    hidden_bits: Floats
    """The expected bits of a packet that is not, times the probability of such a packet, (c,)."""


class HeardBits(NamedTuple):
    """What the packets of c slots reveal to the receiver behind one link."""

    by_type: Floats
    """Bits of a packet with ν = 0, and of one with ν = 1, (c, 2); inf for the state itself."""
    expected: Floats | None
    """Theory: bits that packets other than states reveal, (c,); None if theory does not cover the link."""


@final
class LeakTally:
    """The bits, and the unencrypted states, that R trials received, summed over slots from slot 0 on."""

    def __init__(self, trials: int) -> None:
        self._sums = np.zeros((2, trials))  # bits, and unencrypted states
        self._expected = np.zeros(1)  # NaN without theory
        self.slots = 0
        """The number of slots so far; 0 in a mode without packets."""

    def add_slots(self, action: Codes, nu: Flags, revealed: HeardBits) -> None:
        """Add the next slots: the receiver's actions, and the packets' types, (c, R) each."""
        self.slots += len(action)
        kernels.add_leaked(self._sums, action != int(Action.LOST), nu, revealed.by_type)
        expected = np.full(len(action), math.nan) if revealed.expected is None else revealed.expected
        self._expected = added_in_order(self._expected, expected[:, None])

    @classmethod
    def merged(cls, parts: Sequence[LeakTally]) -> LeakTally:
        """The sums of disjoint sets of trials, in their order; of no slots if the trials were cut short at different slots."""
        whole = cls(0)
        whole._sums = np.concatenate([part._sums for part in parts], axis=1)
        whole._expected = parts[0]._expected
        whole.slots = parts[0].slots if len({part.slots for part in parts}) == 1 else 0
        return whole

    @property
    def summary(self) -> LeakSummary | None:
        """The entry of the summary; None without slots."""
        if not self.slots:
            return None
        means = self._sums[0] / self.slots
        bits, error = float(np.mean(means)), standard_error(means)
        total = float(self._expected[0])
        expected = None if math.isnan(total) else total / self.slots
        clear = float(np.mean(self._sums[1])) / self.slots
        return LeakSummary(clear, bits, error, expected, z_of(means, expected))


def leak_is_known(scenario: Scenario, receiver: str) -> bool:
    """Whether it is known what the packets that a receiver hears reveal.

    Not for the legitimate estimator, which has the secret, for schemes that do not say what their packets reveal, for packets
    that may come late, and for a plant, whose noise is not the one that theory describes.
    """
    if receiver == LEGITIMATE or scenario.of_model or scenario.window(receiver):
        return False
    return scenario.make_scheme().revealed_bits() is not None


@final
class PacketBitsStream:
    """What a scenario's packets reveal, a number of slots at a time from slot 0 on."""

    def __init__(self, mu_d: StateProbability, revealed: RevealedBits) -> None:
        """mu_d: the probability of ν = 0."""
        self._mu_d, self._revealed, self._first = mu_d, revealed, 0

    def next(self, slots: int) -> PacketBits:
        """What those of the next slots reveal."""
        revealed, some = self._revealed.next(slots), range(self._first, self._first + slots)
        self._first = some.stop
        state = np.where(np.arange(some.start, some.stop) == 0, 1.0, in_slots(self._mu_d, some))
        clear, hidden = np.zeros(slots), np.zeros(slots)
        for odds, bits in zip((state, 1.0 - state), revealed, strict=True):
            clear += np.where(np.isinf(bits), odds, 0.0)
            hidden += np.where(np.isinf(bits), 0.0, bits) * odds
        return PacketBits(np.stack(revealed, axis=1), clear, hidden)


def revealed_by_packets(scenario: Scenario) -> PacketBitsStream | None:
    """What the scenario's packets reveal; None if its scheme does not say."""
    scheme = scenario.make_scheme()
    revealed = scheme.revealed_bits()
    return None if revealed is None else PacketBitsStream(scheme.mu_d, revealed)


@final
class HeardBitsStream:
    """What packets reveal to each receiver for which it is known, some slots at a time from slot 0 on.

    Several keepers, each of some of the trials, may share it.
    """

    def __init__(self, scenario: Scenario) -> None:
        names = [name for name in scenario.receivers if leak_is_known(scenario, name)]
        self._packets = revealed_by_packets(scenario) if names else None
        self._distributions = {name: distribution_of(scenario.schedule(name)) for name in names}
        self._slots = range(0)
        self._heard: dict[str, HeardBits] = {}

    def of(self, slots: range) -> dict[str, HeardBits]:
        """Receiver → what the packets of these slots reveal to it: the next ones, or those of the last call again."""
        if self._packets is None or slots == self._slots:
            return self._heard
        packets = self._packets.next(len(slots))
        self._slots = slots
        self._heard = {
            name: HeardBits(
                packets.by_type, None if distribution is None else distribution.rates(slots) * packets.hidden_bits
            )
            for name, distribution in self._distributions.items()
        }
        return self._heard
