"""The energy that a sensor spends on its packets.

Source: docs/mathematics/schemes.md, energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar, final

from evedrop.model.process import Floats


class _Bits(Protocol):
    @property
    def packet_bits(self) -> int: ...


_Count = TypeVar("_Count", float, Floats)


@final
@dataclass(frozen=True)
class EnergyModel:
    """What sending and encrypting cost, in any unit of energy."""

    packet: float = 1.0
    """Energy of sending a packet, whatever its size."""
    bit: float = 0.0
    """Energy of each bit of a packet's payload and header, in addition."""
    encryption: float = 1.0
    """Energy of encrypting a packet, in addition."""

    def sent(self, scheme: _Bits) -> float:
        """Energy of a packet of a scheme that is sent unencrypted."""
        return self.packet + self.bit * scheme.packet_bits

    def spent(self, scheme: _Bits, sent: _Count, encrypted: _Count) -> _Count:
        """Energy of as many packets of a scheme, and of those among them that are encrypted: counts, or fractions of slots."""
        return self.sent(scheme) * sent + self.encryption * encrypted
