"""Notices ways past a wire: programs that are connected to several sides or find each other, and routers that join sides.

Programs in mode peer find each other without the wire. A wire past which programs could have spoken has no verdict, because its
journal does not show which messages they received. A program at two sides gets a message from each. Routers that join two sides
pass messages between them by themselves, and every message that the wire passed on would come back to it: the links between such
sides carry nothing. Where routers are connected to several sides, the wire finds this out with messages of its own. Each has a
random number that was never sent before, so that a program at one side cannot pretend that one of them came from another side:
neither by a guess, nor with an old one.

Source: docs/wire/semantics.md, loops, and what programs need.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import combinations
from typing import Any, final

import zenoh

from evedrop.system.world import world
from evedrop.wire.departures import FewLines
from evedrop.wire.running_link import RunningLink
from evedrop.wire.side import PROBES, SideSession

_MULTICAST: Mapping[str, Any] = {"enabled": True}
_SCOUT_SECONDS = 4.0  # Zenoh asks at once, after one second, and after two more


@final
class Bypasses:
    """The bypasses of a running wire. Threads may call its methods at the same time."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        """tell: for a line about each bypass."""
        self._lines = FewLines(tell, "ways past the wire")
        self.add = self._lines.add
        """Tells a bypass; of many, only that there are more."""
        self._programs: set[tuple[str, str]] = set()
        self._allowed: dict[str, str] = {}  # program that may be a peer, and has not been heard by multicast → its side
        self._new = False  # whether one has come since the last scouting began
        self._scout: zenoh.Scout[None] | None = None
        self._until = 0.0
        self._listeners: list[object] = []  # Zenoh undeclares those that nobody holds

    def watch(self, sides: Iterable[SideSession]) -> None:
        """Notice programs in mode peer from now on, and those that are there."""
        self._listeners += [
            side.session.info.declare_transport_events_listener(
                partial(self._scouted if side.side.peers else self._connected, side.name), history=True
            )
            for side in sides
        ]

    def update(self) -> None:
        """Look by multicast, for some seconds, for programs that may be peers because their multicast scouting is off."""
        if self._scout is not None and world().monotonic() > self._until:
            self.close()
        if self._new and self._scout is None:
            self._new = False
            self._until = world().monotonic() + _SCOUT_SECONDS
            config = zenoh.Config.from_json5(json.dumps({"scouting": {"multicast": _MULTICAST}}))
            scout: Callable[..., Any] = world().zenoh.scout  # whose type hints lack the form with a callback
            with contextlib.suppress(zenoh.ZError):  # a machine without multicast, on which nobody is found
                self._scout = scout(self._answered, "peer", config)

    def close(self) -> None:
        """End the scouting, if there is one."""
        if self._scout is not None:
            self._scout.stop()
            self._scout = None

    def _connected(self, side: str, event: zenoh.TransportEvent) -> None:
        """Tell a peer at a side that does not allow them."""
        program = (side, str(event.transport.zid))
        if event.kind != zenoh.SampleKind.PUT or event.transport.whatami != zenoh.WhatAmI.PEER:
            return
        if program not in self._programs and not self._lines.is_full:  # each once, however often it connects
            self._programs.add(program)
            self.add(
                f"the program {program[1]} at side {side} is in mode peer: such programs find each other past the wire, so "
                'the wire has no verdict; connect it with mode "client", or switch its multicast scouting off and set '
                f"side.{side}.peers = true"
            )

    def _scouted(self, side: str, event: zenoh.TransportEvent) -> None:
        """Note the peers of a side that allows them, for `update`."""
        program = str(event.transport.zid)
        if event.kind != zenoh.SampleKind.PUT:
            self._allowed.pop(program, None)
        elif event.transport.whatami == zenoh.WhatAmI.PEER:
            self._allowed[program] = side
            self._new = True

    def _answered(self, hello: zenoh.Hello) -> None:
        """Tell a program that answers multicast scouting, if it is at a side."""
        side = self._allowed.pop(str(hello.zid), None)
        if side is not None:
            self.add(
                f"the program {hello.zid} at side {side} answers multicast scouting, although side.{side}.peers = true says that "
                "its scouting is off: programs find it past the wire, so the wire has no verdict; set "
                "scouting/multicast/enabled = false in its configuration"
            )


_PROBE_SECONDS = 2.0  # after which a probe that was sent, or heard, says nothing any more
_NONCE_BYTES = 16


@final
class Neighbours:
    """Watches which programs are connected to the sides, and reports changes."""

    def __init__(
        self,
        sides: Mapping[str, SideSession],
        states: Sequence[RunningLink],
        tell: Callable[[str], None],
        bypasses: Bypasses,
    ) -> None:
        self._sides, self._states, self._tell, self._bypasses = sides, states, tell, bypasses
        self._told: set[tuple[str, str, str]] = set()
        self._heard: dict[tuple[str, str], float] = {}
        self._probes = {name: f"@evedrop/{world().token(8).hex()}/{at}" for at, name in enumerate(sides)}
        self._sent: dict[bytes, tuple[str, float]] = {}
        """Number in a probe → the side at which it was sent, and when."""
        self._subscribers = [
            side.session.declare_subscriber(
                PROBES, partial(self._note_probe, name), allowed_origin=zenoh.Locality.REMOTE
            )
            for name, side in sides.items()
        ]

    def update(self) -> None:
        """Look again; cut the links between sides that are joined outside the wire, and restore those no longer joined."""
        programs, routers = {}, {}
        for name, side in self._sides.items():
            transports = side.session.info.transports()
            programs[name] = {str(first.zid) for first in transports if first.whatami != zenoh.WhatAmI.ROUTER}
            routers[name] = {str(first.zid) for first in transports if first.whatami == zenoh.WhatAmI.ROUTER}
        if sum(map(bool, routers.values())) > 1:
            self._probe()
        joined_sides = set()
        for first, second in combinations(self._sides, 2):
            ends = {self._sides[first].zid, self._sides[second].zid}
            joined = (routers[first] | ends) & routers[second] | routers[first] & ends
            if not joined and routers[first] and routers[second] and self._passes(first, second):
                joined = routers[first] | routers[second]
            for state in self._states:
                if {state.link.source, state.link.target} == {first, second}:
                    state.looped = bool(joined)
            if joined:
                joined_sides.add((f"router{'s' if len(joined) > 1 else ''} {', '.join(sorted(joined))}", first, second))
            joined_sides |= {(f"program {zid}", first, second) for zid in programs[first] & programs[second]}
        for who, first, second in sorted(joined_sides - self._told):
            (self._bypasses.add if who.startswith("router") else self._tell)(_sentence(who, first, second))
        for who, first, second in sorted(self._told - joined_sides):
            self._tell(
                f"messages no longer pass between the sides {first} and {second} through the {who}; the links between them go on"
                if who.startswith("router")
                else f"the {who} is no longer connected to the sides {first} and {second}"
            )
        self._told = joined_sides

    def _probe(self) -> None:
        """Send a probe at each side. Those of the last seconds still count: on a busy machine they are slow."""
        now = world().monotonic()
        self._sent = {nonce: sent for nonce, sent in self._sent.items() if sent[1] > now - _PROBE_SECONDS}
        for name, side in self._sides.items():
            nonce = world().token(_NONCE_BYTES)
            self._sent[nonce] = (name, now)
            side.session.put(self._probes[name], nonce)

    def _note_probe(self, name: str, sample: zenoh.Sample) -> None:
        """Take a probe that was heard at a side."""
        if len(sample.payload) != _NONCE_BYTES:
            return
        source, _ = self._sent.get(sample.payload.to_bytes(), (name, 0.0))
        if source != name:
            self._heard[source, name] = world().monotonic()

    def _passes(self, first: str, second: str) -> bool:
        """Whether messages pass between two sides outside the wire, in either direction."""
        since = world().monotonic() - _PROBE_SECONDS
        return any(self._heard.get(way, 0.0) > since for way in ((first, second), (second, first)))


def _sentence(who: str, a: str, b: str) -> str:
    if who.startswith("router"):
        return (
            f"messages pass between the sides {a} and {b} outside the wire, through the {who}, so they would go round; the "
            "links between these sides carry nothing (dropped as looped) until this way is gone"
        )
    return (
        f"the {who} is connected to the sides {a} and {b}: it gets a message from both, and its own messages come back to "
        "it; connect it to one side"
    )
