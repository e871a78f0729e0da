"""Reads the packets of many consecutive slots at once: the same checks and errors as for one, in a fraction of the time.

Messages that contain nothing but packets, and pass all checks, are read together. All others are read one by one, so that the
first malformed one is refused.

Source: docs/protocol.md, messages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.packets import Headers, read_delivery, read_extras, read_uplink
from evedrop.model.flag_bits import flags_of
from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags
from evedrop.model.slot.transit import NOTHING, Arrivals

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
    extras = [one for _, one in read]
    return Uplinked(
        np.array([z for z, _ in read]),
        [z.tobytes() for z, _ in read],
        np.array([one.header for one in extras]) if header else None,
        None
        if all(one.sent is None for one in extras)
        else np.array([np.ones(shape[1], np.bool_) if one.sent is None else one.sent for one in extras]),
        {row: one.truth for row, one in enumerate(extras) if one.truth is not None},
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
        np.array([one.heard.gamma for one in read]),
        np.array([one.heard.z for one in read]),
        np.array([one.heard.header for one in read]) if header else None,
        {row: one.late for row, one in enumerate(read) if one.late},
        {row: one.heard.truth for row, one in enumerate(read) if one.heard.truth is not None},
    )


def _are_of(messages: Sequence[Reader], first: int) -> bool:
    """Whether the messages are of consecutive slots from `first` on."""
    slots = [k for message in messages if type(k := message.fields.get("k")) is int]
    return slots == list(range(first, first + len(messages)))


def _plain_deliveries(messages: Sequence[Reader], shape: tuple[int, int]) -> Arrivals | None:
    """The deliveries, if they have nothing but packets and pass all checks."""
    n, trials = shape
    size = (trials + 7) // 8
    found = [message.fields for message in messages]
    masks = [mask for one in found if isinstance(mask := one.get("gamma"), bytes) and len(mask) == size]
    if len(masks) < len(found) or not all(one.keys() <= _DELIVERY for one in found):
        return None
    bits = np.frombuffer(b"".join(masks), np.uint8).reshape(len(masks), size)
    if trials % 8 and (bits[:, -1] >> trials % 8).any():
        return None
    gamma = flags_of(bits, trials)
    counts = np.count_nonzero(gamma, axis=1).tolist()
    packed = _finite([one.get("z", b"") for one in found], [n * count for count in counts])
    return None if packed is None else Arrivals(gamma, kernels.scatter(gamma, packed, n))


def _finite(parts: Sequence[Any], sizes: Sequence[int]) -> Floats | None:
    """Binary fields as one array, if they have these many numbers each, and all of them are finite."""
    if not all(isinstance(part, bytes) and len(part) == 8 * size for part, size in zip(parts, sizes, strict=True)):
        return None
    numbers = np.frombuffer(b"".join(parts), "<f8")
    return numbers if np.isfinite(numbers).all() else None
