"""Messages: msgpack maps whose arrays are little-endian bytes. What does not fit is refused with its sender named.

Source: docs/protocol.md, messages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgpack
import numpy as np
from numpy.typing import NDArray

from emulator.errors import Gap, MalformedMessage
from emulator.model.account import COUNTED_BURSTS, Account
from emulator.model.digest import DIGEST_BYTES, Digests
from emulator.model.links.link import REASONS
from emulator.model.process import Floats
from emulator.model.receiver import Action, Belief, Codes, Flags, Heard
from emulator.model.transit import Arrival, Late

Headers = NDArray[np.int64]


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

    def flag(self, name: str) -> bool:
        """A boolean field."""
        value = self._fields.get(name)
        if type(value) is not bool:
            raise self.malformed(f"{name} = {value!r}", f"a boolean {name}")
        return value

    def names(self, name: str) -> tuple[str, ...]:
        """A list of strings."""
        value = self._fields.get(name)
        if not isinstance(value, list) or not all(isinstance(one, str) for one in value):
            raise self.malformed(f"{name} = {value!r}", f"a list {name} of strings")
        return tuple(value)

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

    def maps(self, name: str) -> list[Reader]:
        """A list of maps, each as a reader of its own."""
        value = self._fields.get(name)
        if not isinstance(value, list) or not all(isinstance(one, dict) for one in value):
            raise self.malformed(f"{name} = {value!r:.60}", f"a list {name} of maps")
        return [Reader(self.key, self._payload, one) for one in value]

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


class Beside(NamedTuple):
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
    """A packet: slot k, z (n, R), and what is beside it, as in `Beside`."""
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


def read_beside(message: Reader, shape: tuple[int, int], header: int = 0) -> Beside:
    """What a packet has beside z; header: rows that the scheme's packets have."""
    n, trials = shape
    return Beside(
        message.array("header", "<i8", (header, trials)) if header else None,
        flags_of(message.array("sent", "u1", ((trials + 7) // 8,)), trials) if message.has("sent") else None,
        message.finite("truth", (n, trials)) if message.has("truth") else None,
    )


def acknowledgement(k: int, acknowledged: Flags) -> bytes:
    """The acknowledgements of slot k, (R,): from the legitimate estimator, and as they reach the sensor."""
    return pack({"k": k, "gamma": packed_flags(acknowledged).tobytes()})


def read_acknowledgement(message: Reader, k: int, trials: int) -> Flags:
    """The acknowledgements (R,) that must be of slot k."""
    message.slot(k)
    return flags_of(message.array("gamma", "u1", ((trials + 7) // 8,)), trials)


def read_failed(message: Reader, shape: tuple[int, ...]) -> Flags:
    """Where decisions failed, (…, R): nowhere, unless it is said."""
    if not message.has("failed"):
        return np.zeros(shape, np.bool_)
    return flags_of(message.array("failed", "u1", (*shape[:-1], (shape[-1] + 7) // 8)), shape[-1])


def hold(k: int) -> bytes:
    """A mark between slots k − 1 and k, on uplink and downlinks: everybody reports all slots below k."""
    return pack({"k": k, "hold": True})


def is_hold(message: Reader) -> bool:
    """Whether a message of uplink or downlink is such a mark."""
    return message.has("hold")


def once_more(number: int, done: int, first: int) -> bytes:
    """What goes before packets that are sent once more, in the conductor's round of that number: from slot `first` on.

    done: every slot below this one is done.
    """
    return pack({"k": first, "again": done, "n": number})


def is_once_more(message: Reader) -> bool:
    """Whether a message of the uplink says that packets are sent once more."""
    return message.has("again")


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


def _packets(k: int, heard: Heard) -> dict[str, Any]:
    z = np.compress(heard.gamma, heard.z, axis=1)
    fields = {"k": k, "gamma": packed_flags(heard.gamma).tobytes(), "z": z.tobytes()}
    if heard.header is not None:
        fields["header"] = packed_header(heard.header, heard.gamma)
    return fields


def packed_header(header: Headers, received: Flags) -> bytes:
    """The headers (h, received) of the trials that received."""
    return np.compress(received, header, axis=1).astype("<i8").tobytes()


def read_delivery(message: Reader, k: int, shape: tuple[int, int], header: int = 0) -> Arrival:
    """What arrives in slot k, of which the delivery must be; z (n, R) and header (h, R) are 0 where nothing was received."""
    message.slot(k)
    late = []
    for one in message.maps("late") if message.has("late") else ():
        slot = one.integer("k")
        if slot > k:
            raise one.malformed(f"a late packet of slot {slot}", f"one of slot {k} or before")
        late.append(Late(slot, _heard(one, shape, header)))
    heard = _heard(message, shape, header)
    if message.has("truth"):
        heard = heard._replace(truth=message.finite("truth", shape))
    return Arrival(heard, tuple(late))


def _heard(message: Reader, shape: tuple[int, int], rows: int) -> Heard:
    n, trials = shape
    gamma = flags_of(message.array("gamma", "u1", ((trials + 7) // 8,)), trials)
    received = int(np.count_nonzero(gamma))
    header = None
    if rows:
        header = np.zeros((rows, trials), np.int64)
        if received:
            header[:, gamma] = message.array("header", "<i8", (rows, received))
    if received == trials:
        return Heard(gamma, message.finite("z", shape), header)
    z = np.zeros(shape)
    if received:
        # Row by row, which numpy does three times as fast as the rows at once.
        for row, values in zip(z, message.finite("z", (n, received)), strict=True):
            row[gamma] = values
    elif message.has("z"):
        raise message.malformed("z although nothing was received", "no z")
    return Heard(gamma, z, header)


def held(k: int) -> bytes:
    """The sensor's telemetry when it holds before slot k."""
    return pack({"k": k, "held": True})


def is_held(message: Reader) -> bool:
    """Whether the sensor's telemetry says that it holds."""
    return message.has("held")


def progress(k: int) -> bytes:
    """All slots below k are done."""
    return pack({"k": k})


def read_progress(key: str, payload: bytes) -> int:
    """The first slot that is not done."""
    return Reader(key, payload).integer("k")


def control(command: str, **fields: Any) -> bytes:
    """A command of the conductor: `start`, `end`, `hold`, `change`, `go` or `again`, and what goes with it."""
    return pack({"do": command, **fields})


@dataclass(frozen=True)
class Truth:
    """The sensor's telemetry over c slots."""

    first: int
    x: Floats
    """(c, n, R)."""
    nu: Flags
    """(c, R)."""
    sent: Flags | None = None
    """Whether there was a packet, (c, R); None of a scheme that sends in every slot."""
    alarms: Flags | None = None
    """Whether the sensor has become sure that its acknowledgements are attacked, (c, R); None where it does not watch them."""
    u: Floats | None = None
    """The inputs as they were decided, (c, m, R); None without a controller."""
    failed: Flags | None = None
    """Where their decision failed, (c, R)."""
    true: Floats | None = None
    """The true states, (c, n, R), of a sensor that filters: x is what it makes of them; None where they are x."""

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(self.x)

    def pack(self) -> bytes:
        """As a message."""
        fields = {"k": self.first, "c": self.count, "x": self.x.tobytes(), "nu": packed_flags(self.nu).tobytes()}
        if self.sent is not None:
            fields["sent"] = packed_flags(self.sent).tobytes()
        if self.alarms is not None:
            fields["alarms"] = packed_flags(self.alarms).tobytes()
        if self.u is not None:
            fields["u"] = self.u.tobytes()
        if self.failed is not None and self.failed.any():
            fields["failed"] = packed_flags(self.failed).tobytes()
        if self.true is not None:
            fields["true"] = self.true.tobytes()
        return pack(fields)


def read_truth(message: Reader, first: int, shape: tuple[int, int], inputs: int = 0, measures: bool = False) -> Truth:
    """The sensor's telemetry that must begin at slot `first`, with so many inputs, and of one that filters or not."""
    k, c = message.slot(first), message.integer("c", 1)
    n, trials = shape
    flags = {
        name: flags_of(message.array(name, "u1", (c, (trials + 7) // 8)), trials) if message.has(name) else None
        for name in ("sent", "alarms")
    }
    masks = message.array("nu", "u1", (c, (trials + 7) // 8))
    return Truth(
        k,
        message.finite("x", (c, n, trials)),
        flags_of(masks, trials),
        flags["sent"],
        flags["alarms"],
        message.finite("u", (c, inputs, trials)) if inputs else None,
        read_failed(message, (c, trials)) if inputs else None,
        message.finite("true", (c, n, trials)) if measures else None,
    )


def read_digests(message: Reader, trials: int) -> dict[int, Digests]:
    """Block, by its first slot → digests, (R, 32)."""
    digests: dict[int, Digests] = {}
    for block, value in message.map("digests").items():
        if type(block) is not int or not isinstance(value, bytes) or len(value) != trials * DIGEST_BYTES:
            raise message.malformed(f"digests of block {block!r}", f"{trials * DIGEST_BYTES} bytes a block")
        digests[block] = np.frombuffer(value, np.uint8).reshape(trials, DIGEST_BYTES)
    return digests


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
    late: NDArray[np.uint16] | None
    """Packets of earlier slots that arrived within the window, (c, R); None of who has none."""
    digests: Mapping[int, Digests]
    """Block, by its first slot → digests, (R, 32), of the blocks that ended in these slots."""
    late_used: NDArray[np.uint16] | None = None
    """Those of `late` that were used, and not discarded, (c, R)."""

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
                **({} if self.late is None else {"late": self.late.astype("<u2").tobytes()}),
                **({} if self.late_used is None else {"late_used": self.late_used.astype("<u2").tobytes()}),
                "digests": {block: digests.tobytes() for block, digests in self.digests.items()},
            }
        )


def read_report(message: Reader, first: int, shape: tuple[int, int], recorded: int) -> Report:
    """A receiver's telemetry that must begin at slot `first`."""
    k, c = message.slot(first), message.integer("c", 1)
    n, trials = shape
    action = message.array("action", "u1", (c, trials))
    if action.size and int(action.max()) > max(Action):
        raise message.malformed(f"action {int(action.max())}", f"actions from 0 to {int(max(Action))}")
    return Report(
        k,
        message.finite("x_hat", (c, n, trials)),
        action,
        message.finite("P", (c, n, n, recorded)),
        message.finite("trace", (c, 2)),
        message.array("late", "<u2", (c, trials)) if message.has("late") else None,
        read_digests(message, trials),
        message.array("late_used", "<u2", (c, trials)) if message.has("late_used") else None,
    )


def leaving(k: int, belief: Belief) -> bytes:
    """A receiver's last word before an outage that begins with slot k: what it believes."""
    return pack({"k": k, "leaves": True, "x_hat": belief.x_hat.tobytes(), "P": belief.P.tobytes()})


def is_leaving(message: Reader) -> bool:
    """Whether a receiver's telemetry is such a word."""
    return message.has("leaves")


def read_leaving(message: Reader, shape: tuple[int, int]) -> tuple[int, Belief]:
    """The slot before which a receiver leaves, and what it believes."""
    n, trials = shape
    x_hat, P = message.finite("x_hat", shape), message.finite("P", (n, n, trials))
    return message.integer("k"), Belief(x_hat, P, np.zeros(trials, np.uint8))


@dataclass(frozen=True)
class Journal:
    """The router's journal over c slots."""

    first: int
    count: int
    links: Mapping[str, Account]

    def pack(self) -> bytes:
        """As a message."""
        links = {name: _account(link) for name, link in self.links.items()}
        return pack({"k": self.first, "c": self.count, "links": links})


def _account(link: Account) -> dict[str, Any]:
    return {
        "delivered": packed_flags(link.delivered).tobytes(),
        "lost": {reason: counts.astype("<u4").tobytes() for reason, counts in link.lost.items()},
        **({} if link.late is None else {"late": link.late.astype("<u2").tobytes()}),
        "bursts": link.bursts.astype("<u4").tobytes(),
        "delays": link.delays.astype("<u4").tobytes(),
        **({} if link.unsent is None else {"unsent": link.unsent.astype("<u4").tobytes()}),
    }


def read_journal(message: Reader, first: int, windows: Mapping[str, int], trials: int) -> Journal:
    """The journal that must begin at slot `first`, with every receiver in it; windows: receiver → its window."""
    k, c = message.slot(first), message.integer("c", 1)
    links: dict[str, Account] = {}
    for name, window in windows.items():
        link = message.nested("links").nested(name)
        reasons = link.nested("lost")
        if set(link.map("lost")) != set(REASONS):
            raise message.malformed(f"{name} lost for {list(link.map('lost'))}", f"the reasons {sorted(REASONS)}")
        links[name] = Account(
            flags_of(link.array("delivered", "u1", (c, (trials + 7) // 8)), trials),
            {reason: reasons.array(reason, "<u4", (c,)) for reason in REASONS},
            link.array("late", "<u2", (c, trials)) if link.has("late") else None,
            link.array("bursts", "<u4", (COUNTED_BURSTS,)),
            link.array("delays", "<u4", (window + 2,)),
            link.array("unsent", "<u4", (c,)) if link.has("unsent") else None,
        )
    return Journal(k, c, links)
