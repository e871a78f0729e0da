"""Messages that carry packets: uplink, deliveries, acknowledgements, and the marks between them.

Source: docs/protocol.md, messages.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evedrop.live.protocol.codec import Reader, pack
from evedrop.model.flag_bits import packed_flags
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags, Reception
from evedrop.model.slot.transit import Arrival, Late

Headers = NDArray[np.int64]


class PacketExtras(NamedTuple):
    """What a packet has beside its slot and payload; None where a scheme, or a slot, has no such thing."""

    header: Headers | None = None
    """(h, R)."""
    sent: Flags | None = None
    """Whether there is a packet at all, (R,); None is everywhere."""
    truth: Floats | None = None
    """x_k (n, R), for the one receiver that it is betrayed to."""

    @property
    def given(self) -> dict[str, NDArray[Any]]:
        """What there is."""
        return {name: value for name, value in self._asdict().items() if value is not None}


def uplink(
    k: int, z: Floats, header: Headers | None = None, sent: Flags | None = None, truth: Floats | None = None
) -> bytes:
    """A packet: slot k, z (n, R), and what is beside it, as in `PacketExtras`."""
    fields = {"k": k, "z": (z if sent is None else np.where(sent, z, 0.0)).tobytes()}
    if header is not None:
        fields["header"] = header.astype("<i8").tobytes()
    if sent is not None:
        fields["sent"] = packed_flags(sent).tobytes()
    if truth is not None:
        fields["truth"] = truth.tobytes()
    return pack(fields)


def read_uplink(message: Reader, k: int, shape: tuple[int, int]) -> Floats:
    """Z (n, R) of the packet that must be of slot k."""
    message.slot(k)
    return message.finite("z", shape)


def read_beside(message: Reader, shape: tuple[int, int], header: int = 0) -> PacketExtras:
    """What a packet has beside z; header: rows that the scheme's packets have."""
    n, trials = shape
    return PacketExtras(
        message.array("header", "<i8", (header, trials)) if header else None,
        message.flags("sent", (trials,)) if message.has("sent") else None,
        message.finite("truth", (n, trials)) if message.has("truth") else None,
    )


def acknowledgement(k: int, acknowledged: Flags) -> bytes:
    """The acknowledgements of slot k, (R,): from the legitimate estimator, and as they reach the sensor."""
    return pack({"k": k, "gamma": packed_flags(acknowledged).tobytes()})


def read_acknowledgement(message: Reader, k: int, trials: int) -> Flags:
    """The acknowledgements (R,) that must be of slot k."""
    message.slot(k)
    return message.flags("gamma", (trials,))


def barrier(k: int) -> bytes:
    """A mark between slots k − 1 and k, on uplink and downlinks: everybody reports all slots below k."""
    return pack({"k": k, "hold": True})


def is_barrier(message: Reader) -> bool:
    """Whether a message of uplink or downlink is such a mark."""
    return message.has("hold")


def resend(number: int, done: int, first: int) -> bytes:
    """What goes before packets that are sent once more, in the conductor's round of that number: from slot `first` on.

    done: every slot below this one is done.
    """
    return pack({"k": first, "again": done, "n": number})


def is_resend(message: Reader) -> bool:
    """Whether a message of the uplink says that packets are sent once more."""
    return message.has("again")


def read_resend(message: Reader, slots: int) -> tuple[int, int, int]:
    """Number of the round, first slot that is not done, and first slot that follows, of a run of so many."""
    done = message.integer("again", 0, slots)
    return message.integer("n", 1), done, message.integer("k", 0, done)


def delivery(
    k: int, mask: bytes, z: bytes, late: tuple[Late, ...] = (), header: bytes = b"", truth: bytes = b""
) -> bytes:
    """A delivery: slot k, γ as a bit mask, z (n, received) and header (h, received) of the trials that received, late ones.

    truth: x_k (n, R), of all trials, where it is betrayed to this receiver.
    """
    fields: dict[str, Any] = {"k": k, "gamma": mask}
    if z:
        fields["z"] = z
    if header:
        fields["header"] = header
    if truth:
        fields["truth"] = truth
    if late:
        fields["late"] = [_packets(one.k, one.heard) for one in late]
    return pack(fields)


def _packets(k: int, heard: Reception) -> dict[str, Any]:
    z = np.compress(heard.gamma, heard.z, axis=1)
    fields = {"k": k, "gamma": packed_flags(heard.gamma).tobytes(), "z": z.tobytes()}
    if heard.header is not None:
        fields["header"] = packed_header(heard.header, heard.gamma)
    return fields


def packed_header(header: Headers, received: Flags) -> bytes:
    """The headers (h, received) of the trials that received."""
    return np.compress(received, header, axis=1).astype("<i8").tobytes()


def read_delivery(
    message: Reader, k: int, shape: tuple[int, int], header: int = 0, window: int | None = None
) -> Arrival:
    """What arrives in slot k, of which the delivery must be; z (n, R) and header (h, R) are 0 where nothing was received.

    window: how many slots late a packet may be at most; None is any number.
    """
    message.slot(k)
    oldest = 0 if window is None else max(0, k - window)
    late: list[Late] = []
    parts = message.maps("late") if message.has("late") else []
    if len(parts) > 2 * (k - oldest + 1):  # of each slot its packets and second copies
        raise message.malformed(f"{len(parts)} times late packets", f"two times a slot from {oldest} to {k} at most")
    for one in parts:
        slot = one.integer("k")
        if not oldest <= slot <= k:
            since = "" if oldest == 0 else f", from {oldest} on"
            raise one.malformed(f"a late packet of slot {slot}", f"one of slot {k} or before{since}")
        late.append(Late(slot, _heard(one, shape, header)))
    heard = _heard(message, shape, header)
    if message.has("truth"):
        heard = heard._replace(truth=message.finite("truth", shape))
    return Arrival(heard, tuple(late))


def _heard(message: Reader, shape: tuple[int, int], rows: int) -> Reception:
    n, trials = shape
    gamma = message.flags("gamma", (trials,))
    received = int(np.count_nonzero(gamma))
    header = None
    if rows:
        header = np.zeros((rows, trials), np.int64)
        if received:
            header[:, gamma] = message.array("header", "<i8", (rows, received))
    if received == trials:
        return Reception(gamma, message.finite("z", shape), header)
    z = np.zeros(shape)
    if received:
        # Row by row, which numpy does three times as fast as the rows at once.
        for row, values in zip(z, message.finite("z", (n, received)), strict=True):
            row[gamma] = values
    elif message.has("z"):
        raise message.malformed("z although nothing was received", "no z")
    return Reception(gamma, z, header)
