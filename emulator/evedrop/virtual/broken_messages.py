"""Messages that arrive with a wrong field, as from a program that is not the right one, or that computes wrongly.

Source: docs/protocol.md, messages and envelope.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, final

import msgpack

from evedrop.names import RECORDER
from evedrop.scenario.tables import Scenario
from evedrop.virtual.disturbance import ROUTERS, Disturbance, processes_of
from evedrop.virtual.notes import key_within

if TYPE_CHECKING:
    from evedrop.virtual.run import SimulatedWorld

_UNREAD = frozenset({"digests", "header"})
"""Fields of which no reader can say that they are wrong: it knows only how long they are."""
_WRONG: Sequence[Any] = (None, True, -1, "x", b"", [], {}, [{}, 1], 2**63)
_BEYOND = b"\xff\xff"
"""The last bytes of a number that is none, and of flags of trials that are not there."""
_CHECKED: Mapping[str, frozenset[str]] = {
    "telemetry": frozenset({"x_hat", "P", "action", "late", "trace", "digests", "trace_sums"}),
    "journal": frozenset({"delivered", "lost", "unsent", "late"}),
}
"""Kind of message → fields whose numbers the recorder holds against others, if it records all trials."""
CONTRADICTIONS = ("but the journal says", "and what it reported of these slots", "contradicts")
"""Of which one is in what a run says that has noticed a wrong number."""


@final
class BreakMessage(Disturbance):
    """A field of the next message to a process is wrong."""

    kind, share = "break a message to", 9

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """All that read messages, and rather who reads most kinds."""
        return [*processes_of(scenario), *ROUTERS[:1], *[RECORDER] * 3]

    def strike(self, world: SimulatedWorld) -> bool:
        """Let it be wrong."""
        some = random.Random(self.after)  # noqa: S311 - to be repeated, not to be secret
        scenario = world.scenario
        checked = self.target == RECORDER and scenario is not None and scenario.record_trials == scenario.trials
        return world.zenoh.change(self.target, lambda message: broken(some, message, checked=checked))

    @property
    def blamed(self) -> tuple[str, ...]:
        """The sender, which depends on the message, or the two that contradict each other."""
        return ("broke the protocol", *CONTRADICTIONS)


def broken(some: random.Random, message: bytes, *, checked: bool = False) -> bytes:
    """A message whose envelope is right, and a field of which is wrong, or which is no map.

    checked: whether its reader holds the numbers in it against others, so that they may be wrong, too.
    """
    unpacker = msgpack.Unpacker(strict_map_key=False)
    unpacker.feed(message)
    key = unpacker.unpack()
    head = bytes(message[: unpacker.tell()])
    fields = unpacker.unpack()
    kind, _, name = key_within(key).partition("/")
    numbers = _CHECKED.get(kind, frozenset()) if checked and name not in {"sensor", "controller"} else frozenset()
    if not any(value for name, value in fields.items() if name not in _UNREAD) or some.random() < 0.05:
        return head + bytes(msgpack.packb([1]))
    wrong = fields
    while wrong == fields:
        wrong = _broken_map(some, fields, numbers)
    return head + bytes(msgpack.packb(wrong))


def _broken_map(some: random.Random, fields: Mapping[Any, Any], numbers: frozenset[str]) -> dict[Any, Any]:
    """A map in which an entry is wrong, lacks, or is too many; numbers: the fields in which numbers may be wrong."""
    name = some.choice([name for name, value in fields.items() if name not in _UNREAD or isinstance(value, dict)])
    value, chance = fields[name], some.random()
    if isinstance(value, dict) and value and chance < 0.8:
        within = numbers | frozenset(value) if name in numbers else numbers
        return {**fields, name: _wrong_entries(some, value, within)}
    if isinstance(value, list) and value and chance < 0.8 and isinstance(value[0], dict):
        return {**fields, name: [_wrong_entries(some, value[0], numbers), *value[1:]]}
    return {**fields, name: _wrong_value(some, value, name in numbers)}


def _wrong_entries(some: random.Random, value: Mapping[Any, Any], numbers: frozenset[Any]) -> dict[Any, Any]:
    """A map within a message in which something is wrong."""
    chance, name = some.random(), some.choice([*value])
    if chance < 0.15:
        return {other: entry for other, entry in value.items() if other != name}
    if chance < 0.25:
        return {**value, 2**40: b""}
    if isinstance(value[name], dict) and value[name] and chance < 0.85:
        return {**value, name: _wrong_entries(some, value[name], numbers)}
    return {**value, name: _wrong_value(some, value[name], name in numbers)}


def _wrong_value(some: random.Random, value: Any, numbers: bool) -> Any:
    """Another value; numbers: whether it may be one that its type allows."""
    if isinstance(value, bytes) and value and some.random() < 0.8:
        if numbers and some.random() < 0.7:
            at = some.randrange(len(value))
            return value[:at] + bytes([value[at] ^ 1 << some.randrange(8)]) + value[at + 1 :]
        return some.choice(
            (value[:-1], value + b"\0", value[:-2] + _BEYOND if len(value) > 1 else b"", b"\xff" * len(value))
        )
    if isinstance(value, int) and not isinstance(value, bool) and some.random() < 0.5:
        return some.choice((value + 1, value - 1, value + 1000))
    if isinstance(value, str) and some.random() < 0.5:
        return "x"
    return some.choice(_WRONG)
