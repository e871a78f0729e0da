"""Messages that arrive with a wrong field, as from a program that is not the right one.

Source: docs/protocol.md, messages and envelope.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, final

import msgpack

from evedrop.scenario.tables import Scenario
from evedrop.virtual.disturbance import ROUTERS, Disturbance, processes_of

if TYPE_CHECKING:
    from evedrop.virtual.run import SimulatedWorld

_UNREAD = frozenset({"digests", "header"})
"""Fields of which no reader can say that they are wrong: it knows only how long they are."""
_WRONG: Sequence[Any] = (None, True, -1, "x", b"", [], {}, [{}, 1], 2**63)
_BEYOND = b"\xff\xff"
"""The last bytes of a number that is none, and of flags of trials that are not there."""


@final
class BreakMessage(Disturbance):
    """A field of the next message to a process is wrong."""

    kind, share = "break a message to", 4

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """All that read messages."""
        return [*processes_of(scenario), *ROUTERS[:1]]

    def strike(self, world: SimulatedWorld) -> bool:
        """Let it be wrong."""
        some = random.Random(self.after)  # noqa: S311 - to be repeated, not to be secret
        return world.zenoh.change(self.target, lambda message: broken(some, message))

    @property
    def blamed(self) -> tuple[str, ...]:
        """The sender, which depends on the message."""
        return ("broke the protocol",)


def broken(some: random.Random, message: bytes) -> bytes:
    """A message whose envelope is right, and a field of which is wrong, or which is no map."""
    unpacker = msgpack.Unpacker(strict_map_key=False)
    unpacker.feed(message)
    unpacker.skip()
    head = bytes(message[: unpacker.tell()])
    fields = unpacker.unpack()
    names = [name for name, value in fields.items() if name not in _UNREAD or isinstance(value, dict)]
    if not names or some.random() < 0.05:
        return head + bytes(msgpack.packb([1]))
    name = some.choice(names)
    value = fields[name]
    if isinstance(value, bytes) and some.random() < 0.7:
        wrong: Any = some.choice((value[:-1], value + b"\0", value[:-2] + _BEYOND if len(value) > 1 else b""))
    elif isinstance(value, dict) and value and some.random() < 0.8:
        wrong = _broken_map(some, value)
    elif isinstance(value, str) and some.random() < 0.5:
        wrong = "x"
    else:
        wrong = some.choice(_WRONG)
    return head + bytes(msgpack.packb({**fields, name: wrong}))


def _broken_map(some: random.Random, value: dict[Any, Any]) -> dict[Any, Any]:
    """A map in which an entry is wrong, lacks, or is too many."""
    key = some.choice([*value])
    chance = some.random()
    if chance < 0.2:
        return {name: entry for name, entry in value.items() if name != key}
    if chance < 0.3:
        return {**value, 2**40: b""}
    if isinstance(value[key], bytes) and chance < 0.7:
        return {**value, key: value[key][:-1]}
    return {**value, key: some.choice(_WRONG)}
