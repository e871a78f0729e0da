"""Programs that are connected to several sides, and routers that join sides outside the wire.

A program at two sides gets a message from each. Routers that join two sides pass messages between them by themselves, and every
message that the wire passed on would come back to it: the links between such sides carry nothing. Where routers are connected to
several sides, the wire finds this out with messages of its own. Each has a random number that was never sent before, so that a
program at one side cannot pretend that one of them came from another side: neither by a guess, nor with an old one.

Source: docs/wire.md, no loops.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import final

import zenoh

from evedrop.wire.bypasses import Bypasses
from evedrop.wire.lanes import LinkState
from evedrop.wire.side import PROBES, SideSession

_PROBE_SECONDS = 2.0  # after which a probe that was sent, or heard, says nothing any more
_NONCE_BYTES = 16


@final
class Neighbours:
    """Watches which programs are connected to the sides, and reports changes."""

    def __init__(
        self,
        sides: Mapping[str, SideSession],
        states: Sequence[LinkState],
        tell: Callable[[str], None],
        bypasses: Bypasses,
    ) -> None:
        self._sides, self._states, self._tell, self._bypasses = sides, states, tell, bypasses
        self._told: set[tuple[str, str, str]] = set()
        self._heard: dict[tuple[str, str], float] = {}
        self._probes = {name: f"@evedrop/{secrets.token_hex(8)}/{at}" for at, name in enumerate(sides)}
        self._sent: dict[bytes, tuple[str, float]] = {}
        """Number in a probe → the side at which it was sent, and when."""
        self._subscribers = [
            side.session.declare_subscriber(PROBES, self._listener(name), allowed_origin=zenoh.Locality.REMOTE)
            for name, side in sides.items()
        ]

    def update(self) -> None:
        """Look again; cut the links between sides that are joined outside the wire, and restore those no longer joined."""
        programs, routers = {}, {}
        for name, side in self._sides.items():
            transports = side.session.info.transports()
            programs[name] = {str(one.zid) for one in transports if one.whatami != zenoh.WhatAmI.ROUTER}
            routers[name] = {str(one.zid) for one in transports if one.whatami == zenoh.WhatAmI.ROUTER}
        if sum(map(bool, routers.values())) > 1:
            self._probe()
        found = set()
        for one, other in combinations(self._sides, 2):
            ends = {self._sides[one].zid, self._sides[other].zid}
            joined = (routers[one] | ends) & routers[other] | routers[one] & ends
            if not joined and routers[one] and routers[other] and self._passes(one, other):
                joined = routers[one] | routers[other]
            for state in self._states:
                if {state.link.source, state.link.target} == {one, other}:
                    state.looped = bool(joined)
            if joined:
                found.add((f"router{'s' if len(joined) > 1 else ''} {', '.join(sorted(joined))}", one, other))
            found |= {(f"program {zid}", one, other) for zid in programs[one] & programs[other]}
        for who, one, other in sorted(found - self._told):
            (self._bypasses.add if who.startswith("router") else self._tell)(_sentence(who, one, other))
        for who, one, other in sorted(self._told - found):
            self._tell(
                f"messages no longer pass between the sides {one} and {other} through the {who}; the links between them go on"
                if who.startswith("router")
                else f"the {who} is no longer connected to the sides {one} and {other}"
            )
        self._told = found

    def _probe(self) -> None:
        """Send a probe at each side. Those of the last seconds still count: on a busy machine they are slow."""
        now = time.monotonic()
        self._sent = {nonce: sent for nonce, sent in self._sent.items() if sent[1] > now - _PROBE_SECONDS}
        for name, side in self._sides.items():
            nonce = secrets.token_bytes(_NONCE_BYTES)
            self._sent[nonce] = (name, now)
            side.session.put(self._probes[name], nonce)

    def _listener(self, name: str) -> Callable[[zenoh.Sample], None]:
        def heard(sample: zenoh.Sample) -> None:
            if len(sample.payload) != _NONCE_BYTES:
                return
            source, _ = self._sent.get(sample.payload.to_bytes(), (name, 0.0))
            if source != name:
                self._heard[source, name] = time.monotonic()

        return heard

    def _passes(self, one: str, other: str) -> bool:
        """Whether messages pass between two sides outside the wire, in either direction."""
        since = time.monotonic() - _PROBE_SECONDS
        return any(self._heard.get(way, 0.0) > since for way in ((one, other), (other, one)))


def _sentence(who: str, one: str, other: str) -> str:
    if who.startswith("router"):
        return (
            f"messages pass between the sides {one} and {other} outside the wire, through the {who}, so they would go round; the "
            "links between these sides carry nothing (dropped as looped) until this way is gone"
        )
    return (
        f"the {who} is connected to the sides {one} and {other}: it gets a message from both, and its own messages come back to "
        "it; connect it to one side"
    )
