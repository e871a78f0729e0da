"""Notices ways past a wire: programs in mode peer, which find each other without it, and routers that join two sides.

A wire past which programs could have spoken has no verdict, because its journal does not tell what they got.

Source: docs/wire.md, what programs need.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import final

import zenoh

from evedrop.wire.side import SideSession

MOST = 20
"""The bypasses that are told one by one: programs that connect again and again must not fill the history."""


@final
class Bypasses:
    """The bypasses of a running wire. Threads may call its methods at the same time."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        """tell: for a line about each bypass."""
        self._tell = tell
        self._told = 0
        self._programs: set[tuple[str, str]] = set()
        self._lock = threading.Lock()
        self._listeners: list[object] = []  # Zenoh undeclares those that nobody holds

    def watch(self, sides: Iterable[SideSession]) -> None:
        """Notice programs in mode peer from now on, and those that are there, at sides whose file does not allow them."""
        self._listeners += [
            side.session.info.declare_transport_events_listener(self._listener(side.name), history=True)
            for side in sides
            if not side.side.peers
        ]

    def add(self, line: str) -> None:
        """Tell a bypass; of more than MOST, only that there are more."""
        with self._lock:
            self._told += 1
            at = self._told
        if at <= MOST:
            self._tell(line)
        elif at == MOST + 1:
            self._tell(f"there were more than {MOST} ways past the wire; further ones are not listed")

    def _listener(self, side: str) -> Callable[[zenoh.TransportEvent], None]:
        def changed(event: zenoh.TransportEvent) -> None:
            program = (side, str(event.transport.zid))
            if event.kind != zenoh.SampleKind.PUT or event.transport.whatami != zenoh.WhatAmI.PEER:
                return
            if program not in self._programs:  # each once, however often it connects
                self._programs.add(program)
                self.add(
                    f"the program {program[1]} at side {side} is in mode peer: such programs find each other past the wire, so "
                    'the wire has no verdict; connect it with mode "client", or switch its multicast scouting off and set '
                    f"side.{side}.peers = true"
                )

        return changed
