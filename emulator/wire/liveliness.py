"""Liveliness that crosses: a token of a program at one side is mirrored at the other sides, and is never lost.

A token lives at a side as long as a program there, or at a side joined to it, holds it. Zenoh reports the first token with a key
and the end of the last, among them those of the wire. The administration space of the side's router says who holds a token, so
the wire finds out when programs at two sides hold the same token.

Source: docs/wire.md, liveliness.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any, final

import zenoh

from evedrop.wire.plan import WirePlan
from evedrop.wire.side import SideSession, expressions_of


def joined(plan: WirePlan) -> dict[str, tuple[str, ...]]:
    """Side → the sides at which its tokens are mirrored: those at both ends of a link, and those that a tap leads to."""
    pairs = {(link.source, link.target) for link in plan.links}
    pairs |= {(link.target, link.source) for link in plan.links if not link.tap}
    return {
        side: tuple(other for other in plan.sides if (side, other) in pairs and other != side) for side in plan.sides
    }


@final
class LivelinessRelay:
    """Mirrors the tokens of all sides. `changed` is called, on a thread of Zenoh's, when tokens appear or vanish."""

    def __init__(self, sides: Mapping[str, SideSession], plan: WirePlan, changed: Callable[[], None]) -> None:
        self._sides, self._joined, self._changed = sides, joined(plan), changed
        self._lock = threading.Lock()
        self._events: list[tuple[str, str, bool]] = []
        self._held: dict[str, set[str]] = {name: set() for name in sides}
        self._mirrored: dict[str, dict[str, zenoh.LivelinessToken]] = {name: {} for name in sides}
        self._echoes: dict[str, set[str]] = {name: set() for name in sides}
        self._subscribers = [
            side.session.liveliness().declare_subscriber(
                expression, zenoh.handlers.Callback(self._heard(name), indirect=True), history=True
            )
            for name, side in sides.items()
            for expression in expressions_of(side.side, plan.links)
        ]

    @property
    def tokens(self) -> dict[str, frozenset[str]]:
        """Side → the tokens that its programs hold."""
        with self._lock:
            return {name: frozenset(held) for name, held in self._held.items()}

    def update(self, ask: bool) -> None:
        """Mirror what has changed. ask: whether to ask every router who holds which token."""
        with self._lock:
            events, self._events = self._events, []
            for name, key, alive in events:
                self._note(name, key, alive)
            if ask:
                for name, side in self._sides.items():
                    self._compare(name, side.sources("token"))
            self._mirror()

    def close(self) -> None:
        """End, and give up all mirrored tokens."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        with self._lock:
            for mirrored in self._mirrored.values():
                for token in mirrored.values():
                    token.undeclare()
                mirrored.clear()

    def _heard(self, name: str) -> Callable[[zenoh.Sample], None]:
        def heard(sample: zenoh.Sample) -> None:
            with self._lock:
                self._events.append((name, str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))
            self._changed()

        return heard

    def _note(self, name: str, key: str, alive: bool) -> None:
        """Take an event of Zenoh's into account: it may be an echo of a mirrored token."""
        if not alive:
            self._held[name].discard(key)
            self._echoes[name].discard(key)
        elif key in self._echoes[name]:
            self._echoes[name].discard(key)
        elif key not in self._mirrored[name]:
            self._held[name].add(key)

    def _compare(self, name: str, sources: Mapping[str, Any]) -> None:
        """Replace the tokens that programs hold by those that the router knows, as far as it tells."""
        kept = {key for key in self._held[name] if _is_hidden(key)}
        self._held[name] = kept | set(sources)

    def _mirror(self) -> None:
        for name, side in self._sides.items():
            wanted = set().union(*(self._held[other] for other in self._sides if name in self._joined[other]))
            mirrored = self._mirrored[name]
            for key in mirrored.keys() - wanted:
                mirrored.pop(key).undeclare()
            for key in wanted - mirrored.keys():
                if key not in self._held[name]:
                    self._echoes[name].add(key)
                mirrored[key] = side.session.liveliness().declare_token(key)


def _is_hidden(key: str) -> bool:
    """Whether the administration space does not list a token."""
    return any(chunk.startswith("@") for chunk in key.split("/"))
