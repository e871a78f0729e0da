"""Messages that arrive with a wrong field, as from a program that is not the right one, or that computes wrongly.

Source: docs/protocol.md, messages and envelope.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, final

import msgpack

from evedrop.model.receiver import Action
from evedrop.names import CONTROLLER, RECORDER, SENSOR
from evedrop.scenario.tables import Scenario
from evedrop.virtual.disturbance import ROUTERS, Disturbance, processes_of
from evedrop.virtual.notes import key_within

if TYPE_CHECKING:
    from evedrop.virtual.run import SimulatedWorld

_UNREAD = frozenset({"digests", "header"})
"""Fields of which no reader can say that they are wrong: it knows only how long they are."""
_SUMS = frozenset({"seconds", "trace", "trace_sums"})
"""Fields with numbers that are never below 0."""
_WRONG: Sequence[Any] = (None, True, -1, "x", b"", [], {}, [{}, 1], [{}] * 70_000, 2**63)
"""What stands in place of any value; the longest list has more maps than any message."""
_MANY = 100
_BEYOND, _BELOW, _LARGE = b"\xff\xff", struct.pack("<d", -1.0), struct.pack("<d", 1e9)
"""The last bytes of a number that is none, and of flags of trials that are not there; a number below 0, and a large one."""
_CHECKED: Mapping[str, frozenset[str]] = {
    "telemetry": frozenset({"x_hat", "P", "action", "late", "digests"}),
    "journal": frozenset({"delivered", "lost", "unsent", "late"}),
}
"""Kind of message → fields whose numbers the recorder holds against others, if it records all trials."""
_OF_SENSOR = frozenset({"sent"})
"""The same, of the sensor's telemetry."""
_WANTED = ("journal", "telemetry", "telemetry")
"""The messages to the recorder of which one is wrong, by how their keys begin."""
_COMMON = frozenset({"k", "c", "n", "do"})
"""What nearly all messages have: it is wrong less often than what few have."""
_CHANGES = frozenset({"changes", "links"})
"""Fields with changes of links."""
_OF_LINK = frozenset({"link", "loss", "model", "quality"})
"""What each change of a link has. Anything else in it may be left out, or be another value that is right."""
_Place = tuple[Any, ...]
"""The names, and the numbers in lists, that lead to a value in a message."""
CONTRADICTIONS = ("but the journal says", "and what it reported of these slots", "contradicts")
"""Of which one is in what a run says that has noticed a wrong number."""


@final
class BreakMessage(Disturbance):
    """A field of the next message to a process is wrong."""

    kind, share = "break a message to", 14

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """All that read messages, and rather who reads most kinds."""
        return [*processes_of(scenario), *ROUTERS[:1], *[RECORDER] * 6]

    def strike(self, world: SimulatedWorld) -> bool:
        """Let it be wrong."""
        some = random.Random(f"{world.scheduler.seed} {self}")  # noqa: S311 - to be repeated, whatever happened before it
        scenario = world.scenario
        checked = self.target == RECORDER and scenario is not None and scenario.record_trials == scenario.trials
        wanted = some.choice(_WANTED) if self.target == RECORDER else ""

        def change(message: bytes) -> bytes | None:
            return broken(some, message, checked=checked) if _unpacked(message)[0].startswith(wanted) else None

        return world.zenoh.change(self.target, change)

    @property
    def blamed(self) -> tuple[str, ...]:
        """The sender, which depends on the message, the two that contradict each other, or who was told to leave."""
        return ("broke the protocol", *CONTRADICTIONS, *super().blamed)


def broken(some: random.Random, message: bytes, *, checked: bool = False, harmless: bool = False) -> bytes:
    """A message whose envelope is right, and a field of which is wrong, or which is no map.

    checked: whether its reader holds the numbers in it against others, so that they may be wrong, too; harmless: whether all
    numbers may be wrong, since nobody uses them.
    """
    key, head, fields = _unpacked(message)
    kind, _, name = key.partition("/")
    if name == CONTROLLER or (isinstance(fields, dict) and "leaves" in fields and fields["k"] == 0):
        checked = False  # of a receiver that is away from the beginning, no report tells of its belief
    numbers: frozenset[object] = _CHECKED.get(kind, frozenset()) if checked else frozenset()
    if name == SENSOR:
        numbers &= _OF_SENSOR
    places = [*_places(fields)]
    if harmless:
        numbers = frozenset(name for place in places for name in place)
    else:
        places = [place for place in places if not _is_plausible(kind, place)]
    rarer = [place for place in places if place[-1] not in _COMMON]
    if rarer and some.random() < 0.8:
        places = rarer
    if not places or some.random() < 0.05:
        return head + bytes(msgpack.packb([1]))
    wrong = fields
    while wrong == fields:
        wrong = _changed(some, fields, some.choice(places), numbers)
    return head + bytes(msgpack.packb(wrong))


def _is_plausible(kind: str, place: _Place) -> bool:
    """Whether another value there may be one that the sender could have meant."""
    if kind == "downlink":
        return (place[0], place[-1]) == ("late", "k")  # a late packet of another slot
    return kind == "control" and not _CHANGES.isdisjoint(place) and place[-1] not in _OF_LINK


def _unpacked(message: bytes) -> tuple[str, bytes, Any]:
    """The key of a message within its run, its envelope, and its fields."""
    unpacker = msgpack.Unpacker(strict_map_key=False)
    unpacker.feed(message)
    key, at = unpacker.unpack(), unpacker.tell()
    return key_within(key), bytes(message[:at]), unpacker.unpack()


def _places(value: Any) -> Iterator[_Place]:
    """All places in a message at which something can be wrong; of a list, the first map stands for all."""
    entries = value.items() if isinstance(value, dict) else [(0, value[0])] if _has_maps(value) else ()
    for name, entry in entries:
        if name not in _UNREAD or isinstance(entry, dict):
            yield (name,)
        for rest in _places(entry):
            yield (name, *rest)
    if isinstance(value, dict) and "gamma" in value:  # if nobody has received anything, there is no state
        yield ("z",)


def _has_maps(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def _changed(some: random.Random, value: Any, place: _Place, numbers: frozenset[object], within: _Place = ()) -> Any:
    """The same map or list with something wrong at a place; numbers: the fields in which numbers may be wrong."""
    (name, *rest), copy = place, value.copy()
    if rest:
        copy[name] = _changed(some, value[name], tuple(rest), numbers, (*within, name))
    elif isinstance(value, dict) and some.random() < 0.15:
        copy.pop(name, None)
    else:
        before = value.get(name) if isinstance(value, dict) else value[name]
        copy[name] = _wrong_value(some, before, {*within, name}, numbers)
    return copy


def _wrong_value(some: random.Random, value: Any, names: Collection[str], numbers: frozenset[object]) -> Any:
    """Another value of the fields with these names, within each other."""
    others = [*_WRONG]
    if some.random() < 0.8:
        if isinstance(value, bytes) and value:
            others = _wrong_bytes(some, value, names, numbers)
        elif isinstance(value, list):
            others = [value * _MANY, [*value, "x"]]
        elif isinstance(value, dict) and not any(isinstance(name, str) for name in value):
            others = [{**value, 2**40: b""}]
        elif isinstance(value, int) and not isinstance(value, bool):
            others = [value + 1, value - 1, value + 1000, -1]
        elif isinstance(value, str):
            others = ["x", "end"]  # as a command, it is not due
    return some.choice(others)


def _wrong_bytes(some: random.Random, value: bytes, names: Collection[str], numbers: frozenset[object]) -> list[bytes]:
    """Other bytes for those of an array."""
    at = some.randrange(len(value))
    if not numbers.isdisjoint(names) and some.random() < 0.7:
        if "P" in names:  # below the diagonal, a reader notices only what is no rounding
            return [value[: at // 8 * 8] + _LARGE + value[at // 8 * 8 + 8 :]]
        if "action" in names:  # what was done with a packet that arrived is the receiver's own affair
            return [value[:at] + bytes([Action.STATE if value[at] == Action.LOST else Action.LOST]) + value[at + 1 :]]
        bit = min(some.randrange(8), some.randrange(8))  # flags have only the lower ones
        return [value[:at] + bytes([value[at] ^ 1 << bit]) + value[at + 1 :]]
    if not _SUMS.isdisjoint(names) and some.random() < 0.5:
        return [value[:-8] + _BELOW]
    beyond = [value[:-2] + _BEYOND if len(value) > 1 else b"", b"\xff" * len(value)]
    return [value[:-1], value + b"\0", *(beyond if _UNREAD.isdisjoint(names) else [])]
