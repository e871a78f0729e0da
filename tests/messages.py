"""Messages with the packets of a single slot, as tests write and read them."""

from __future__ import annotations

import numpy as np

from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.packets import delivery, packet_format, read_uplink, uplink
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags
from evedrop.model.slot.link_core import NOTHING, Arrivals, Late
from evedrop.model.slot.records import I64, PacketSlots


def packet(
    k: int, z: Floats, header: I64 | None = None, sent: Flags | None = None, truth: Floats | None = None
) -> bytes:
    """The sensor's message of slot k: z (n, R), header (h, R), what was sent (R,), and a betrayed state (n, R)."""
    columns = (None if column is None else column[None] for column in (header, sent, truth))
    return uplink(PacketSlots(k, z[None], *columns))  # type: ignore[arg-type]


def read_packet(message: Reader, k: int, shape: tuple[int, int]) -> Floats:
    """Z (n, R) of the sensor's message of slot k."""
    z: Floats = read_uplink(message, k, packet_format(*shape)).z[0]
    return z


def delivered(
    k: int,
    gamma: Flags,
    z: Floats,
    late: tuple[Late, ...] = (),
    header: I64 | None = None,
    truth: Floats | None = None,
) -> bytes:
    """The router's message of slot k: γ (R,), z (n, R) and header (h, R) of all trials, late packets, and a betrayed state."""
    arrivals = Arrivals(
        np.asarray(gamma, np.bool_)[None],
        z[None],
        None if header is None else header[None],
        {0: late} if late else NOTHING,
        NOTHING if truth is None else {0: truth},
    )
    return delivery(range(k, k + 1), arrivals)
