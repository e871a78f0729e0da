"""Encodes and reads messages: msgpack maps whose arrays are little-endian bytes. Errors name the sender of a malformed message.

Every message begins with an envelope, the full key it was put on, and a reader drops messages that name another key: Zenoh may
deliver one key's messages to another key's subscriber after connections flap (docs/maintainers/tests.md). Only the message
itself shows this: the sample shows the key of the subscriber.

Source: docs/protocol.md, messages and envelope.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Collection, Mapping
from reprlib import Repr
from typing import Any, TypeVar, final

import msgpack
import msgspec
import numpy as np
from numpy.typing import NDArray

from evedrop.errors import Gap, MalformedMessage
from evedrop.live.protocol.keys import MOST_PARTS, writer_of
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags, flags_of
from evedrop.system.structs import converted
from evedrop.system.world import world

_LARGEST = 2**62  # the default bound of integers: slots can be added to it without leaving 64 bits
_SMALL_BYTES = 1 << 16  # objects that msgpack unpacks from this few bytes take some megabytes at most

S = TypeVar("S", bound=msgspec.Struct)


def pack(fields: Mapping[str, Any]) -> bytes:
    """Encode a message with these fields."""
    message: bytes = _PACKERS.packer.pack(fields)
    return message


def binary(array: NDArray[Any], dtype: str) -> memoryview:
    """An array's bytes, of this little-endian type, as a field to be packed: a view, where the array is as messages need it."""
    return np.ascontiguousarray(array, dtype).data


class StructMessage(msgspec.Struct, frozen=True):
    """A message whose fields are those of its class."""

    def pack(self) -> bytes:
        """Encode it."""
        return pack(msgspec.to_builtins(self))


class _Packers(threading.local):
    """A packer for each thread: making one takes longer than packing a small message."""

    def __init__(self) -> None:
        self.packer = msgpack.Packer(use_bin_type=True)


_PACKERS = _Packers()


@final
class Reader:
    """Reads the fields of one message. Raises MalformedMessage for a field of another type, size or range."""

    def __init__(
        self, key: str, payload: bytes, fields: Mapping[Any, Any] | None = None, parts: int = MOST_PARTS
    ) -> None:
        """key: on which it came; fields: if it is unpacked already; parts: how many lists and maps a large message may have."""
        self.key = key
        self._parts = parts
        self._payload = payload
        self.fields = self._unpacked() if fields is None else fields
        """All fields, as they were sent: nothing about them is checked yet."""

    def _unpacked(self) -> Mapping[Any, Any]:
        count = None if len(self._payload) <= _SMALL_BYTES else _counter(self._parts)
        try:
            fields = msgpack.unpackb(
                self._payload, raw=False, strict_map_key=False, list_hook=count, object_hook=count, max_ext_len=0
            )
        except Exception as error:
            raise self.malformed(f"not msgpack ({type(error).__name__})", "a msgpack map") from error
        if not isinstance(fields, dict):
            raise self.malformed(f"a {type(fields).__name__}", "a msgpack map")
        return fields

    def malformed(self, got: str, expected: str) -> MalformedMessage:
        """The error for this message, with what was found in it and what was expected."""
        return MalformedMessage(self.key, got, expected, self._payload, writer_of(self.key))

    def has(self, name: str) -> bool:
        """Whether an optional field is present."""
        return name in self.fields

    def read(self, kind: type[S]) -> S:
        """All fields, as an object of this kind, whose declaration says what they may be."""
        try:
            made: S = converted(self.fields, kind)
        except msgspec.ValidationError as error:
            raise self.malformed(str(error), f"the fields of {kind.__name__}") from error
        return made

    def integer(self, name: str, least: int = 0, most: int | None = None) -> int:
        """An integer field, from `least` to `most`."""
        value = self.fields.get(name)
        if type(value) is not int or not least <= value <= (_LARGEST if most is None else most):
            bounds = f"of at least {least}" if most is None else f"from {least} to {most}"
            raise self.malformed(f"{name} = {shown(value)}", f"an integer {name} {bounds}")
        return value

    def text(self, name: str) -> str:
        """A string field."""
        value = self.fields.get(name)
        if not isinstance(value, str):
            raise self.malformed(f"{name} = {shown(value)}", f"a string {name}")
        return value

    def choice(self, name: str, choices: Collection[str]) -> str:
        """A string field that is one of these."""
        value = self.text(name)
        if value not in choices:
            raise self.malformed(f"{name} = {shown(value)}", f"one of {', '.join(choices)}")
        return value

    def array(self, name: str, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """A binary field as a read-only array of this type and shape."""
        value = self.fields.get(name)
        kind = np.dtype(dtype)
        expected = kind.itemsize
        for length in shape:
            expected *= length
        if not isinstance(value, bytes) or len(value) != expected:
            size = f"{len(value)} bytes" if isinstance(value, bytes) else shown(value)
            raise self.malformed(f"{name} of {size}", f"{expected} bytes, {dtype} of shape {shape}")
        return np.frombuffer(value, kind).reshape(shape)

    def flags(self, name: str, shape: tuple[int, ...]) -> Flags:
        """A binary field of bit masks, one bit for each trial: flags of the shape (…, R)."""
        trials = shape[-1]
        masks = self.array(name, "u1", (*shape[:-1], (trials + 7) // 8))
        if trials % 8 and (masks[..., -1] >> trials % 8).any():
            raise self.malformed(f"{name} with a bit beyond trial {trials - 1}", "unused bits that are 0")
        return flags_of(masks, trials)

    def counts(self, name: str, dtype: str, shape: tuple[int, ...], most: int) -> NDArray[Any]:
        """A binary field of unsigned integers, none above `most`."""
        array = self.array(name, dtype, shape)
        if array.size and int(array.max()) > most:
            raise self.malformed(f"{name} of {int(array.max())}", f"numbers from 0 to {most}")
        return array

    def span(self, first: int, slots: int, most: int) -> int:
        """Field c of a message that must begin at slot `first`: how many slots it covers.

        slots: of the run; most: how many slots one message may cover. Raises Gap if the message begins at another slot.
        """
        self.slot(first)
        return self.integer("c", 1, max(1, min(most, slots - first)))

    def map(self, name: str) -> Mapping[Any, Any]:
        """A map field."""
        value = self.fields.get(name)
        if not isinstance(value, dict):
            raise self.malformed(f"{name} = {shown(value)}", f"a map {name}")
        return value

    def maps(self, name: str) -> list[Reader]:
        """A list of maps, each as a reader of its own."""
        value = self.fields.get(name)
        if not isinstance(value, list) or not all(isinstance(element, dict) for element in value):
            raise self.malformed(f"{name} = {shown(value)}", f"a list {name} of maps")
        return [Reader(self.key, self._payload, element) for element in value]

    def nested(self, name: str) -> Reader:
        """A map field, as a reader of its own."""
        return Reader(self.key, self._payload, self.map(name))

    def slot(self, expected: int) -> int:
        """Field k, which must be the expected slot. Raises Gap otherwise."""
        k = self.integer("k")
        if k != expected:
            raise Gap(self.key, expected, k, writer_of(self.key))
        return k

    def finite(self, name: str, shape: tuple[int, ...]) -> Floats:
        """A float64 array without NaN or infinity."""
        array = self.array(name, "<f8", shape)
        if not np.isfinite(array).all():
            raise self.malformed(f"{name} with a NaN or infinity", "finite numbers")
        return array


def shown(value: object) -> str:
    """A field's value in the short form of error messages, however large it is."""
    short = Repr()
    short.maxlevel, short.maxdict, short.maxlist, short.maxstring = 2, 4, 4, 40
    return f"{len(value)} bytes" if isinstance(value, bytes) else short.repr(value)


def _counter(most: int) -> Callable[[Any], Any]:
    """A hook for each list and map of a message while it is unpacked, which raises ValueError when there are too many."""
    left = most

    def count(part: Any) -> Any:
        nonlocal left
        left -= 1
        if left < 0:
            raise ValueError("more lists and maps than any message has")
        return part

    return count


_SHOWN_BYTES = 600  # more than any key of a run has


def head_of(key: str) -> bytes:
    """The beginning of every message on a key: the key as a msgpack string."""
    head: bytes = msgpack.packb(key)
    return head


def enclosed(key: str, payload: bytes) -> bytes:
    """The message that carries a payload on a key."""
    return head_of(key) + payload


def payload_of(key: str, message: bytes) -> bytes | None:
    """The payload of a message that arrived on a key; None if it names another key."""
    head = head_of(key)
    return message[len(head) :] if message.startswith(head) else None


def named_in(message: bytes) -> str | None:
    """The key that a message names, or None."""
    unpacker = msgpack.Unpacker()
    unpacker.feed(message[:_SHOWN_BYTES])
    try:
        key = unpacker.unpack()
    except Exception:  # msgpack raises various errors for bytes that are not a message
        return None
    return key if isinstance(key, str) else None


@final
class Dropped:
    """Counts the messages that a process dropped because they name another key than they arrived on; thread-safe.

    mistaken: called when a message names another key, which means that the connection confuses keys.
    """

    def __init__(self, process: str, mistaken: Callable[[], None] = lambda: None) -> None:
        self._process, self._mistaken = process, mistaken
        self._lock = world().lock()
        self.count = 0

    def add(self, key: str, message: bytes) -> None:
        """Count a dropped message; report the first, the tenth, the hundredth and so on, on standard error."""
        with self._lock:
            self.count += 1
            number = self.count
        named = named_in(message)
        if number == 10 ** (len(str(number)) - 1):
            problem = f"names {named}" if named is not None else "names no key"
            sys.stderr.write(
                f"evedrop: {self._process}: dropped a message that came on {key} and {problem} (number {number}); "
                "if it was needed, it is sent again\n"
            )
            sys.stderr.flush()
        if named is not None:
            self._mistaken()

    def contents(self, key: str, head: bytes, message: bytes) -> bytes | None:
        """The payload of a message that arrived on a key with that head; None if it names another key and was dropped."""
        if message.startswith(head):
            return message[len(head) :]
        self.add(key, message)
        return None
