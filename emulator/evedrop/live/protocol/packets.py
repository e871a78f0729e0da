"""Messages that carry packets: uplink, deliveries, acknowledgements, and the barriers between them.

A message carries the packets of one slot, or of many consecutive ones.

Source: docs/protocol.md, messages.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from evedrop.live.protocol.codec import Reader, binary, pack
from evedrop.live.protocol.record_messages import RecordFormat, packed
from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags, Reception, packed_flags
from evedrop.model.schemes.scheme import PacketBlock
from evedrop.model.slot.link_core import Arrivals, Late
from evedrop.model.slot.records import I64, PacketSlots


def packet_format(n: int, trials: int, header: int = 0) -> RecordFormat[PacketSlots]:
    """How messages carry packets; header: how many rows the header of the scheme's packets has."""
    with_header = ("header",)
    return RecordFormat(
        PacketSlots,
        {"n": n, "h": header, "R": trials},
        absent=() if header else with_header,
        present=with_header if header else (),
    )


def packets_of(first: int, block: PacketBlock, truth: Floats | None = None) -> PacketSlots:
    """The packets of a scheme from slot `first` on, as they are sent; truth: the states, (c, n, R), if they are betrayed."""
    z = block.z if block.sent is None else np.where(block.sent[:, None], block.z, 0.0)
    return PacketSlots(first, z, block.header, block.sent, truth)


def uplink(packets: PacketSlots) -> bytes:
    """Encode packets."""
    return pack({"k": packets.first, "c": packets.count, **packed(packets)})


def read_uplink(message: Reader, k: int, packets: RecordFormat[PacketSlots], most: int = 1) -> PacketSlots:
    """Decode packets, which must begin at slot k; most: of how many slots there may be."""
    message.slot(k)
    return packets.read(message, k, message.integer("c", 1, most))


def acknowledgement(k: int, acknowledged: Flags) -> bytes:
    """Encode the acknowledgements of slot k, (R,), either from the legitimate estimator or as they reach the sensor."""
    return pack({"k": k, "gamma": binary(packed_flags(acknowledged), "u1")})


def read_acknowledgement(message: Reader, k: int, trials: int) -> Flags:
    """Decode acknowledgements (R,), which must be of slot k."""
    message.slot(k)
    return message.flags("gamma", (trials,))


def barrier(k: int) -> bytes:
    """Encode a barrier between slots k − 1 and k, on uplink and downlinks: its readers report all slots below k."""
    return pack({"k": k, "hold": True})


def is_barrier(message: Reader) -> bool:
    """Whether a message of uplink or downlink is a barrier."""
    return message.has("hold")


def resend(number: int, done: int, first: int) -> bytes:
    """Encode the announcement that packets are sent again from slot `first` on, in the conductor's round `number`.

    done: all slots below it are done.
    """
    return pack({"k": first, "again": done, "n": number})


def is_resend(message: Reader) -> bool:
    """Whether a message of the uplink announces that packets are sent again."""
    return message.has("again")


def read_resend(message: Reader, slots: int) -> tuple[int, int, int]:
    """Decode the number of the round, the first slot that is not done, and the first resent slot; slots: of the run."""
    done = message.integer("again", 0, slots)
    return message.integer("n", 1), done, message.integer("k", 0, done)


def delivery(slots: range, arrivals: Arrivals) -> bytes:
    """Encode a delivery of some slots: γ, and z and header of the trials that received."""
    gamma = arrivals.gamma
    fields: dict[str, Any] = {"k": slots.start, "c": len(slots), "gamma": binary(packed_flags(gamma), "u1")}
    if gamma.any():
        fields |= _received(gamma, arrivals.z, arrivals.header)
    if arrivals.truth:
        fields["truth"] = binary(np.stack([arrivals.truth[row] for row in range(len(slots))]), "<f8")
    if arrivals.late:
        fields["late"] = [
            _late(slots.start + row, packets) for row, parts in sorted(arrivals.late.items()) for packets in parts
        ]
    return pack(fields)


def _received(gamma: Flags, z: Floats, header: I64 | None) -> dict[str, memoryview]:
    """Z (c, n, R) and header (c, h, R) of the trials that received, slot by slot."""
    fields = {"z": _gathered(gamma, z)}
    if header is not None:
        fields["header"] = _gathered(gamma, header.view(np.float64))
    return fields


def _gathered(gamma: Flags, values: Floats) -> memoryview:
    """Values (c, m, R) of the trials that received; whole numbers come as the numbers with the same bits."""
    if gamma.all():
        return binary(values, "<f8")
    if gamma.shape[1] == 1:  # a call of the kernel takes longer
        return binary(values[gamma[:, 0]], "<f8")
    return binary(kernels.gather(gamma, values), "<f8")


def _late(at: int, packets: Late) -> dict[str, Any]:
    heard = packets.heard
    header = None if heard.header is None else heard.header[None]
    received = _received(heard.gamma[None], heard.z[None], header)
    return {"at": at, "k": packets.k, "gamma": binary(packed_flags(heard.gamma), "u1"), **received}


def read_delivery(
    message: Reader, k: int, shape: tuple[int, int], header: int = 0, window: int | None = None, most: int = 1
) -> Arrivals:
    """Decode a delivery, which must begin at slot k; z (c, n, R) and header (c, h, R) are 0 where nothing was received.

    window: by how many slots a packet may be late at most; None: any number. most: of how many slots there may be.
    """
    message.slot(k)
    slots = range(k, k + message.integer("c", 1, most))
    n, trials = shape
    gamma, z, headers = _heard(message, (len(slots), n, trials), header)
    truth = message.finite("truth", (len(slots), n, trials)) if message.has("truth") else ()
    late = _read_late(message, slots, shape, header, window) if message.has("late") else {}
    return Arrivals(gamma, z, headers, late, dict(enumerate(truth)))


def _heard(message: Reader, shape: tuple[int, int, int], header: int) -> tuple[Flags, Floats, I64 | None]:
    """γ (c, R), z (c, n, R) and header (c, h, R) of a shape (c, n, R); 0 where nothing was received."""
    c, n, trials = shape
    gamma = message.flags("gamma", (c, trials))
    received = int(np.count_nonzero(gamma))
    headers = np.zeros((c, header, trials), np.int64) if header else None
    if not received:
        if message.has("z"):
            raise message.malformed("z although nothing was received", "no z")
        return gamma, np.zeros(shape), headers
    if headers is not None:
        numbers = message.array("header", "<i8", (header * received,))
        headers = kernels.scatter(gamma, numbers.view(np.float64), header).view(np.int64)
    if received == gamma.size:
        return gamma, message.finite("z", shape), headers
    return gamma, kernels.scatter(gamma, message.finite("z", (n * received,)), n), headers


def _read_late(
    message: Reader, slots: range, shape: tuple[int, int], header: int, window: int | None
) -> Mapping[int, tuple[Late, ...]]:
    """Row → the late packets that arrive in its slot."""
    late: dict[int, list[Late]] = {}
    for packets in message.maps("late"):
        at = packets.integer("at", slots.start, slots[-1])
        slot, oldest = packets.integer("k"), 0 if window is None else max(0, at - window)
        if not oldest <= slot <= at:
            since = "" if oldest == 0 else f", from {oldest} on"
            raise packets.malformed(f"a late packet of slot {slot}", f"one of slot {at} or before{since}")
        gamma, z, headers = _heard(packets, (1, *shape), header)
        parts = late.setdefault(at - slots.start, [])
        if len(parts) == 2 * (at - oldest + 1):  # for each slot, its packets and their second copies
            raise message.malformed(
                f"more than {len(parts)} entries in late of slot {at}",
                f"at most two for each slot from {oldest} to {at}",
            )
        parts.append(Late(slot, Reception(gamma[0], z[0], None if headers is None else headers[0])))
    return {row: tuple(parts) for row, parts in late.items()}
