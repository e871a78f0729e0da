"""Messages that carry packets: uplink, deliveries, acknowledgements, and the barriers between them.

The packets of many consecutive slots are read at once: with the same checks and errors as for one, in a fraction of the time.
Messages that contain nothing but packets, and pass all checks, are read together. All others are read one by one, so that the
first malformed one is refused.

Source: docs/protocol.md, messages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evedrop.live.protocol.codec import Reader, pack
from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags, Reception, flags_of, packed_flags
from evedrop.model.slot.link_core import NOTHING, Arrival, Arrivals, Late

Headers = NDArray[np.int64]


class PacketExtras(NamedTuple):
    """Parts of a packet other than its slot and payload; None if the scheme, or the slot, does not have them."""

    header: Headers | None = None
    """The header, (h, R)."""
    sent: Flags | None = None
    """Whether a packet was sent, (R,); None means in all trials."""
    truth: Floats | None = None
    """x_k (n, R), for the one receiver that learns the true state."""


def uplink(
    k: int, z: Floats, header: Headers | None = None, sent: Flags | None = None, truth: Floats | None = None
) -> bytes:
    """Encode a packet: slot k, z (n, R), and the parts of `PacketExtras`."""
    fields = {"k": k, "z": (z if sent is None else np.where(sent, z, 0.0)).tobytes()}
    if header is not None:
        fields["header"] = header.astype("<i8").tobytes()
    if sent is not None:
        fields["sent"] = packed_flags(sent).tobytes()
    if truth is not None:
        fields["truth"] = truth.tobytes()
    return pack(fields)


def read_uplink(message: Reader, k: int, shape: tuple[int, int]) -> Floats:
    """Decode z (n, R) of a packet, which must be of slot k."""
    message.slot(k)
    return message.finite("z", shape)


def read_extras(message: Reader, shape: tuple[int, int], header: int = 0) -> PacketExtras:
    """Decode the parts of a packet other than z; header: how many rows the header of the scheme's packets has."""
    n, trials = shape
    return PacketExtras(
        message.array("header", "<i8", (header, trials)) if header else None,
        message.flags("sent", (trials,)) if message.has("sent") else None,
        message.finite("truth", (n, trials)) if message.has("truth") else None,
    )


def acknowledgement(k: int, acknowledged: Flags) -> bytes:
    """Encode the acknowledgements of slot k, (R,), either from the legitimate estimator or as they reach the sensor."""
    return pack({"k": k, "gamma": packed_flags(acknowledged).tobytes()})


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


def delivery(
    k: int, mask: bytes, z: bytes, late: tuple[Late, ...] = (), header: bytes = b"", truth: bytes = b""
) -> bytes:
    """Encode a delivery: slot k, γ as a bit mask, z (n, received) and header (h, received) of the trials that received.

    late: late packets that arrive in this slot. truth: x_k (n, R), of all trials, if this receiver learns it.
    """
    fields: dict[str, Any] = {"k": k, "gamma": mask}
    if z:
        fields["z"] = z
    if header:
        fields["header"] = header
    if truth:
        fields["truth"] = truth
    if late:
        fields["late"] = [_packets(packet.k, packet.heard) for packet in late]
    return pack(fields)


def _packets(k: int, heard: Reception) -> dict[str, Any]:
    z = np.compress(heard.gamma, heard.z, axis=1)
    fields = {"k": k, "gamma": packed_flags(heard.gamma).tobytes(), "z": z.tobytes()}
    if heard.header is not None:
        fields["header"] = packed_header(heard.header, heard.gamma)
    return fields


def packed_header(header: Headers, received: Flags) -> bytes:
    """The headers (h, received) of the trials that received, as bytes."""
    return np.compress(received, header, axis=1).astype("<i8").tobytes()


def read_delivery(
    message: Reader, k: int, shape: tuple[int, int], header: int = 0, window: int | None = None
) -> Arrival:
    """Decode a delivery, which must be of slot k; z (n, R) and header (h, R) are 0 where nothing was received.

    window: by how many slots a packet may be late at most; None: any number.
    """
    message.slot(k)
    oldest = 0 if window is None else max(0, k - window)
    late: list[Late] = []
    parts = message.maps("late") if message.has("late") else []
    if len(parts) > 2 * (k - oldest + 1):  # for each slot, its packets and their second copies
        raise message.malformed(f"{len(parts)} entries in late", f"at most two for each slot from {oldest} to {k}")
    for packet in parts:
        slot = packet.integer("k")
        if not oldest <= slot <= k:
            since = "" if oldest == 0 else f", from {oldest} on"
            raise packet.malformed(f"a late packet of slot {slot}", f"one of slot {k} or before{since}")
        late.append(Late(slot, _heard(packet, shape, header)))
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
        # Row by row: three times as fast in numpy as all rows at once.
        for row, values in zip(z, message.finite("z", (n, received)), strict=True):
            row[gamma] = values
    elif message.has("z"):
        raise message.malformed("z although nothing was received", "no z")
    return Reception(gamma, z, header)


_PACKET = {"k", "z"}
_DELIVERY = {"k", "gamma", "z"}


class Uplinked(NamedTuple):
    """The packets of c consecutive slots, as they reach the router."""

    z: Floats
    """(c, n, R)."""
    whole: Sequence[bytes]
    """z of each slot, as it was sent."""
    header: Headers | None = None
    """(c, h, R)."""
    sent: Flags | None = None
    """Whether a packet was sent, (c, R); None means every packet."""
    truth: Mapping[int, Floats] = NOTHING
    """Row → x_k (n, R), for the row whose state one receiver learns."""


def read_uplinks(messages: Sequence[Reader], first: int, shape: tuple[int, int], header: int = 0) -> Uplinked:
    """Decode packets, at least one, which must be of the slots from `first` on; header: how many rows their headers have."""
    plain = not header and all(message.fields.keys() == _PACKET for message in messages)
    if plain and _are_of(messages, first):
        parts = [message.fields["z"] for message in messages]
        z = _finite(parts, [shape[0] * shape[1]] * len(parts))
        if z is not None:
            return Uplinked(z.reshape(len(messages), *shape), parts)
    read = [
        (read_uplink(message, k, shape), read_extras(message, shape, header))
        for k, message in enumerate(messages, first)
    ]
    extras = [extra for _, extra in read]
    return Uplinked(
        np.array([z for z, _ in read]),
        [z.tobytes() for z, _ in read],
        np.array([extra.header for extra in extras]) if header else None,
        None
        if all(extra.sent is None for extra in extras)
        else np.array([np.ones(shape[1], np.bool_) if extra.sent is None else extra.sent for extra in extras]),
        {row: extra.truth for row, extra in enumerate(extras) if extra.truth is not None},
    )


def read_deliveries(
    messages: Sequence[Reader], first: int, shape: tuple[int, int], header: int = 0, window: int | None = None
) -> Arrivals:
    """Decode deliveries, at least one, which must be of the slots from `first` on; the rest as for `read_delivery`."""
    plain = _plain_deliveries(messages, shape) if not header and _are_of(messages, first) else None
    if plain is not None:
        return plain
    read = [read_delivery(message, k, shape, header, window) for k, message in enumerate(messages, first)]
    return Arrivals(
        np.array([delivery_.heard.gamma for delivery_ in read]),
        np.array([delivery_.heard.z for delivery_ in read]),
        np.array([delivery_.heard.header for delivery_ in read]) if header else None,
        {row: delivery_.late for row, delivery_ in enumerate(read) if delivery_.late},
        {row: delivery_.heard.truth for row, delivery_ in enumerate(read) if delivery_.heard.truth is not None},
    )


def _are_of(messages: Sequence[Reader], first: int) -> bool:
    """Whether the messages are of consecutive slots from `first` on."""
    slots = [k for message in messages if type(k := message.fields.get("k")) is int]
    return slots == list(range(first, first + len(messages)))


def _plain_deliveries(messages: Sequence[Reader], shape: tuple[int, int]) -> Arrivals | None:
    """The deliveries, if they have nothing but packets and pass all checks."""
    n, trials = shape
    size = (trials + 7) // 8
    maps = [message.fields for message in messages]
    masks = [mask for fields in maps if isinstance(mask := fields.get("gamma"), bytes) and len(mask) == size]
    if len(masks) < len(maps) or not all(fields.keys() <= _DELIVERY for fields in maps):
        return None
    bits = np.frombuffer(b"".join(masks), np.uint8).reshape(len(masks), size)
    if trials % 8 and (bits[:, -1] >> trials % 8).any():
        return None
    gamma = flags_of(bits, trials)
    counts = np.count_nonzero(gamma, axis=1).tolist()
    packed = _finite([fields.get("z", b"") for fields in maps], [n * count for count in counts])
    return None if packed is None else Arrivals(gamma, kernels.scatter(gamma, packed, n))


def _finite(parts: Sequence[Any], sizes: Sequence[int]) -> Floats | None:
    """Binary fields as one array, if they have these many numbers each, and all of them are finite."""
    if not all(isinstance(part, bytes) and len(part) == 8 * size for part, size in zip(parts, sizes, strict=True)):
        return None
    numbers = np.frombuffer(b"".join(parts), "<f8")
    return numbers if np.isfinite(numbers).all() else None
