"""Messages: msgpack maps whose arrays are little-endian bytes. What does not fit is refused with its sender named.

Source: docs/protocol.md, messages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from emulator.errors import Gap, MalformedMessage
from emulator.model.digest import DIGEST_BYTES, Digests
from emulator.model.links.link import Fate
from emulator.model.process import Floats
from emulator.model.receiver import Action, Codes, Flags

_REASONS = frozenset(fate.name.lower() for fate in Fate if fate is not Fate.DELIVERED)


def pack(fields: Mapping[str, Any]) -> bytes:
    """A message of these fields."""
    message: bytes = msgpack.packb(fields, use_bin_type=True)
    return message


def packed_flags(flags: Flags) -> NDArray[np.uint8]:
    """Flags (…, R) as bit masks (…, ⌈R/8⌉), trial 0 in the lowest bit of the first byte."""
    return np.packbits(flags, axis=-1, bitorder="little")


def flags_of(masks: NDArray[np.uint8], trials: int) -> Flags:
    """The flags (…, R) of bit masks (…, ⌈R/8⌉)."""
    return np.unpackbits(masks, axis=-1, count=trials, bitorder="little").view(np.bool_)


class Reader:
    """Reads one message's fields with their types and sizes checked. Final."""

    def __init__(self, key: str, payload: bytes, fields: Mapping[Any, Any] | None = None) -> None:
        self.key = key
        self._payload = payload
        self._fields = self._unpacked() if fields is None else fields

    def _unpacked(self) -> Mapping[Any, Any]:
        try:
            found = msgpack.unpackb(self._payload, raw=False, strict_map_key=False)
        except Exception as error:
            raise self.malformed(f"not msgpack ({type(error).__name__})", "a msgpack map") from error
        if not isinstance(found, dict):
            raise self.malformed(f"a {type(found).__name__}", "a msgpack map")
        return found

    def malformed(self, found: str, expected: str) -> MalformedMessage:
        """The error that says what was found in this message and what was expected."""
        return MalformedMessage(self.key, found, expected, self._payload)

    def has(self, name: str) -> bool:
        """Whether an optional field is there."""
        return name in self._fields

    def integer(self, name: str, least: int = 0) -> int:
        """An integer field."""
        value = self._fields.get(name)
        if type(value) is not int or value < least:
            raise self.malformed(f"{name} = {value!r}", f"an integer {name} of at least {least}")
        return value

    def text(self, name: str) -> str:
        """A string field."""
        value = self._fields.get(name)
        if not isinstance(value, str):
            raise self.malformed(f"{name} = {value!r}", f"a string {name}")
        return value

    def array(self, name: str, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """A binary field as an array of the shape (read-only)."""
        value = self._fields.get(name)
        kind = np.dtype(dtype)
        expected = kind.itemsize
        for length in shape:
            expected *= length
        if not isinstance(value, bytes) or len(value) != expected:
            size = f"{len(value)} bytes" if isinstance(value, bytes) else repr(value)
            raise self.malformed(f"{name} of {size}", f"{expected} bytes, {dtype} of shape {shape}")
        return np.frombuffer(value, kind).reshape(shape)

    def map(self, name: str) -> Mapping[Any, Any]:
        """A map field."""
        value = self._fields.get(name)
        if not isinstance(value, dict):
            raise self.malformed(f"{name} = {value!r}", f"a map {name}")
        return value

    def nested(self, name: str) -> Reader:
        """A map field, as a reader of its own."""
        return Reader(self.key, self._payload, self.map(name))

    def slot(self, expected: int) -> int:
        """Field k, which must be the slot that is due. Raises Gap otherwise."""
        k = self.integer("k")
        if k != expected:
            raise Gap(self.key, expected, k)
        return k

    def finite(self, name: str, shape: tuple[int, ...]) -> Floats:
        """A float64 array without NaN or infinity."""
        array = self.array(name, "<f8", shape)
        if not np.isfinite(array).all():
            raise self.malformed(f"{name} with a NaN or infinity", "finite numbers")
        return array


def uplink(k: int, z: Floats) -> bytes:
    """A packet: slot k, z (n, R)."""
    return pack({"k": k, "z": z.tobytes()})


def read_uplink(key: str, payload: bytes, k: int, shape: tuple[int, int]) -> Floats:
    """Z (n, R) of the packet that must be of slot k."""
    message = Reader(key, payload)
    message.slot(k)
    return message.finite("z", shape)


def delivery(k: int, mask: bytes, z: bytes) -> bytes:
    """A delivery: slot k, γ as a bit mask, and the z of the trials that received, (n, received)."""
    if not z:
        return pack({"k": k, "gamma": mask})
    return pack({"k": k, "gamma": mask, "z": z})


def read_delivery(key: str, payload: bytes, k: int, shape: tuple[int, int]) -> tuple[Flags, Floats]:
    """γ (R,) and z (n, R) of the delivery that must be of slot k; z is 0 where nothing was received."""
    message = Reader(key, payload)
    message.slot(k)
    n, trials = shape
    gamma = flags_of(message.array("gamma", "u1", ((trials + 7) // 8,)), trials)
    received = int(np.count_nonzero(gamma))
    if received == trials:
        return gamma, message.finite("z", shape)
    z = np.zeros(shape)
    if received:
        # Row by row, which numpy does three times as fast as the rows at once.
        for row, values in zip(z, message.finite("z", (n, received)), strict=True):
            row[gamma] = values
    elif message.has("z"):
        raise message.malformed("z although nothing was received", "no z")
    return gamma, z


def progress(k: int) -> bytes:
    """All slots below k are done."""
    return pack({"k": k})


def read_progress(key: str, payload: bytes) -> int:
    """The first slot that is not done."""
    return Reader(key, payload).integer("k")


def control(command: str) -> bytes:
    """A command of the conductor."""
    return pack({"do": command})


def read_control(key: str, payload: bytes) -> str:
    """The command."""
    return Reader(key, payload).text("do")


@dataclass(frozen=True)
class Truth:
    """The sensor's telemetry over c slots."""

    first: int
    x: Floats
    """(c, n, R)."""
    nu: Flags
    """(c, R)."""

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(self.x)

    def pack(self) -> bytes:
        """As a message."""
        return pack({"k": self.first, "c": self.count, "x": self.x.tobytes(), "nu": packed_flags(self.nu).tobytes()})


def read_truth(key: str, payload: bytes, first: int, shape: tuple[int, int]) -> Truth:
    """The sensor's telemetry that must begin at slot `first`."""
    message = Reader(key, payload)
    k, c = message.slot(first), message.integer("c", 1)
    n, trials = shape
    masks = message.array("nu", "u1", (c, (trials + 7) // 8))
    return Truth(k, message.finite("x", (c, n, trials)), flags_of(masks, trials))


@dataclass(frozen=True)
class Report:
    """A receiver's telemetry over c slots."""

    first: int
    x_hat: Floats
    """(c, n, R)."""
    action: Codes
    """(c, R)."""
    P: Floats
    """Believed covariance of the recorded trials, (c, n, n, recorded)."""
    trace: Floats
    """Sum over all trials of tr P and of its square, (c, 2)."""
    digests: Mapping[int, Digests]
    """Block number → digests, (R, 32), of the blocks that ended in these slots."""

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(self.x_hat)

    def pack(self) -> bytes:
        """As a message."""
        return pack(
            {
                "k": self.first,
                "c": self.count,
                "x_hat": self.x_hat.tobytes(),
                "action": self.action.tobytes(),
                "P": self.P.tobytes(),
                "trace": self.trace.tobytes(),
                "digests": {block: digests.tobytes() for block, digests in self.digests.items()},
            }
        )


def read_report(key: str, payload: bytes, first: int, shape: tuple[int, int], recorded: int) -> Report:
    """A receiver's telemetry that must begin at slot `first`."""
    message = Reader(key, payload)
    k, c = message.slot(first), message.integer("c", 1)
    n, trials = shape
    action = message.array("action", "u1", (c, trials))
    if action.size and int(action.max()) > max(Action):
        raise message.malformed(f"action {int(action.max())}", f"actions from 0 to {int(max(Action))}")
    digests: dict[int, Digests] = {}
    for block, value in message.map("digests").items():
        if type(block) is not int or not isinstance(value, bytes) or len(value) != trials * DIGEST_BYTES:
            raise message.malformed(f"digests of block {block!r}", f"{trials * DIGEST_BYTES} bytes a block")
        digests[block] = np.frombuffer(value, np.uint8).reshape(trials, DIGEST_BYTES)
    return Report(
        k,
        message.finite("x_hat", (c, n, trials)),
        action,
        message.finite("P", (c, n, n, recorded)),
        message.finite("trace", (c, 2)),
        digests,
    )


@dataclass(frozen=True)
class Journal:
    """The router's journal over c slots."""

    first: int
    count: int
    delivered: Mapping[str, Flags]
    """Receiver → which trials' packets were passed on, (c, R)."""
    lost: Mapping[str, Mapping[str, NDArray[np.uint32]]]
    """Receiver → reason → packets lost for it, (c,)."""

    def pack(self) -> bytes:
        """As a message."""
        links = {
            name: {
                "delivered": packed_flags(flags).tobytes(),
                "lost": {reason: counts.astype("<u4").tobytes() for reason, counts in self.lost[name].items()},
            }
            for name, flags in self.delivered.items()
        }
        return pack({"k": self.first, "c": self.count, "links": links})


def read_journal(key: str, payload: bytes, first: int, receivers: tuple[str, ...], trials: int) -> Journal:
    """The journal that must begin at slot `first`, with every receiver in it."""
    message = Reader(key, payload)
    k, c = message.slot(first), message.integer("c", 1)
    delivered: dict[str, Flags] = {}
    lost: dict[str, dict[str, NDArray[np.uint32]]] = {}
    for name in receivers:
        link = message.nested("links").nested(name)
        delivered[name] = flags_of(link.array("delivered", "u1", (c, (trials + 7) // 8)), trials)
        reasons = link.nested("lost")
        if set(link.map("lost")) != _REASONS:
            raise message.malformed(f"{name} lost for {list(link.map('lost'))}", f"the reasons {sorted(_REASONS)}")
        lost[name] = {reason: reasons.array(reason, "<u4", (c,)) for reason in sorted(_REASONS)}
    return Journal(k, c, delivered, lost)
