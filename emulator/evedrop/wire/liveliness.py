"""Liveliness that crosses: a token of a program at one side is mirrored at the other sides.

A token lives at a side as long as a program there, or at a side joined to it, holds it. Zenoh reports the first token with a key
and the end of the last, among them those of the wire, and does not say who holds one. So the wire mirrors no token at a side
whose programs hold it already; and when it gives up a mirrored token, it looks whether a program there holds the same one. Until
then, it cannot know of a program that declares a token which is mirrored there.

Source: docs/wire/semantics.md, liveliness.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import final

import zenoh

from evedrop.system.world import world
from evedrop.wire.plan import WirePlan
from evedrop.wire.side import SideSession, expressions_of

_ANSWER_SECONDS = 10.0


def joined(plan: WirePlan) -> dict[str, tuple[str, ...]]:
    """Side → the sides at which its tokens are mirrored: those at both ends of a link, and those that a tap leads to."""
    pairs = {(link.source, link.target) for link in plan.links}
    pairs |= {(link.target, link.source) for link in plan.links if not link.tap}
    return {
        side: tuple(other for other in plan.sides if (side, other) in pairs and other != side) for side in plan.sides
    }


@final
class LivelinessRelay:
    """Mirrors the tokens of all sides.

    `changed` is called, on a thread of Zenoh's, when tokens appear or vanish; `noted` gets side and token of each that is noted.
    """

    def __init__(
        self,
        sides: Mapping[str, SideSession],
        plan: WirePlan,
        changed: Callable[[], None],
        noted: Callable[[str, str], None],
    ) -> None:
        self._sides, self._joined, self._changed, self._noted = sides, joined(plan), changed, noted
        self._lock = world().lock()
        self._events: deque[tuple[str, str, bool]] = deque()
        self._held: dict[str, set[str]] = {name: set() for name in sides}
        self._mirrored: dict[str, dict[str, zenoh.LivelinessToken]] = {name: {} for name in sides}
        self._doubtful: dict[str, set[str]] = {name: set() for name in sides}
        """Side → tokens that the wire mirrored there: what Zenoh reports of them may be the wire's own doing."""
        self._subscribers = [
            (
                name,
                side.session.liveliness().declare_subscriber(
                    expression,
                    world().zenoh.handlers.Callback(partial(self._heard, name), indirect=True),
                    history=True,
                ),
            )
            for name, side in sides.items()
            for expression in expressions_of(side.side, plan.links)
        ]

    @property
    def tokens(self) -> dict[str, frozenset[str]]:
        """Side → the tokens that its programs hold."""
        with self._lock:
            return {name: frozenset(held) for name, held in self._held.items()}

    def note(self) -> None:
        """Take in what Zenoh has reported since the last time."""
        with self._lock:
            for _ in range(len(self._events)):
                name, key, alive = self._events.popleft()
                if not alive:
                    self._held[name].discard(key)
                    self._doubtful[name].discard(key)
                elif key not in self._mirrored[name] and (key not in self._doubtful[name] or self._lives(name, key)):
                    self._held[name].add(key)
                    self._noted(name, key)

    def mirror(self) -> None:
        """Mirror the tokens that were noted, and give up those that are gone; later reports wait for the next `note`."""
        with self._lock:
            for name, side in self._sides.items():
                elsewhere = (self._held[other] for other in self._sides if name in self._joined[other])
                wanted = set[str]().union(*elsewhere) - self._held[name]
                mirrored = self._mirrored[name]
                for key in sorted(mirrored.keys() - wanted):
                    mirrored.pop(key).undeclare()
                    if self._lives(name, key):
                        self._held[name].add(key)
                        self._noted(name, key)
                        self._changed()
                for key in sorted(wanted - mirrored.keys()):
                    self._doubtful[name].add(key)
                    mirrored[key] = side.session.liveliness().declare_token(key)

    def close(self) -> None:
        """End, and give up all mirrored tokens."""
        for name, subscriber in self._subscribers:
            with self._sides[name].duty.busy():
                subscriber.undeclare()
        with self._lock:
            for name, mirrored in self._mirrored.items():
                with self._sides[name].duty.busy():
                    for token in mirrored.values():
                        token.undeclare()
                mirrored.clear()

    def _heard(self, name: str, sample: zenoh.Sample) -> None:
        # Without the lock: a program that declares a token waits until Zenoh has reported it.
        self._events.append((name, str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))
        self._changed()

    def _lives(self, name: str, key: str) -> bool:
        """Whether a token lives at a side at which the wire does not hold it: then a program there does."""
        seen, over = world().event(), world().event()

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                seen.set()

        handler = world().zenoh.handlers.Callback(take, drop=over.set, indirect=False)
        self._sides[name].session.liveliness().get(key, handler, timeout=_ANSWER_SECONDS)
        over.wait(_ANSWER_SECONDS)
        return seen.is_set()
